"""Errors of the measured and the believed positions against the true ones.

A particle's true position is that of the reference's material point nearest to it at rest (`truth_transfer`), so an
error of the estimator's rest mesh counts as an error in every frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jiggle_mj.estimate import Estimate, Sheet
from jiggle_mj.truth import Truth

from .truth_transfer import material_points


@dataclass(frozen=True, kw_only=True)
class Tracking:
    """Root mean square 3-D errors over the particles that were seen [m]; None, NaN in arrays, where none was seen."""

    rms: float | None
    """Error of the measured positions over all frames."""
    rms_estimate: float | None
    """Error of the believed positions of the same particles over all frames."""
    per_frame: Float[np.ndarray, " t"]
    """Error of the measured positions in each frame."""
    per_frame_estimate: Float[np.ndarray, " t"]
    """Error of the believed positions in each frame."""


def tracking(sheet: Sheet, estimates: Sequence[Estimate], truth: Truth) -> Tracking:
    """Return the errors of the particles seen in each frame, against the truth's frame of the same index."""
    frames = {frame.index: frame for frame in truth.frames}
    at_material_points = material_points(sheet.rest, truth)
    squared, squared_estimate = [], []
    for estimate in estimates:
        if estimate.index not in frames:
            squared.append(np.empty(0))
            squared_estimate.append(np.empty(0))
            continue
        true = at_material_points(frames[estimate.index].positions)
        seen = np.isfinite(true).all(axis=1) & np.isfinite(estimate.observed).all(axis=1)
        squared.append(np.sum((estimate.observed - true)[seen] ** 2, axis=1))
        squared_estimate.append(np.sum((estimate.positions - true)[seen] ** 2, axis=1))
    return Tracking(
        rms=_rms(np.concatenate([np.empty(0), *squared])),
        rms_estimate=_rms(np.concatenate([np.empty(0), *squared_estimate])),
        per_frame=np.array([_rms(each) for each in squared], dtype=float),
        per_frame_estimate=np.array([_rms(each) for each in squared_estimate], dtype=float),
    )


def _rms(squared: Float[np.ndarray, " m"]) -> float | None:
    return float(np.sqrt(squared.mean())) if len(squared) else None
