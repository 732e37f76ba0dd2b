"""How far the measured and the believed positions are from the true ones, and what the attachments truly bore.

A particle's true position is that of the reference's material point nearest to it at rest (`carrying`), so an error of
the estimator's rest mesh counts as an error in every frame. The mean boundary energy is over all vertices of the
reference, attached or not, with anchors at rest: U = 1/n sum_i 1/2 b*_i |x_i - a_i|^2. Welds store no energy that a
camera could see and are left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jiggle_mj.estimate import Estimate, Sheet
from jiggle_mj.truth import Truth

from .truth_transfer import barycentric_weights


@dataclass(frozen=True, kw_only=True)
class Tracking:
    """Root mean square 3-D errors over the particles that were seen [m]; None, NaN in arrays, where none could be."""

    rms: float | None
    """Of the measured positions, over all frames."""
    rms_estimate: float | None
    """Of the believed positions of the same particles."""
    per_frame: Float[np.ndarray, " t"]
    """Of the measured positions."""
    per_frame_estimate: Float[np.ndarray, " t"]


def tracking(sheet: Sheet, estimates: Sequence[Estimate], truth: Truth) -> Tracking:
    """Errors of the particles seen in each frame, against the truth's frame of the same index."""
    frames = {frame.index: frame for frame in truth.frames}
    corners, weights = barycentric_weights(sheet.rest, truth.rest, truth.faces)
    squared, squared_estimate = [], []
    for estimate in estimates:
        if estimate.index not in frames:
            squared.append(np.empty(0))
            squared_estimate.append(np.empty(0))
            continue
        true = np.einsum("mk,mkd->md", weights, frames[estimate.index].positions[corners])
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
