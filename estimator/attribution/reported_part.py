"""Figures of the part that chose no effect: the error of each prediction, over all, by frame and on the sheet."""

from typing import Any

import numpy as np
from jaxtyping import Float

from .close_loop import Closed
from .dataset import Dataset
from .grasped_frames import Timed
from .held_out import HeldOut, rms
from .trivial_predictions import TRIVIAL, trivial_predictions

RESOLUTION = 8
"""Decimals of positions that are written [m]: 10 nm."""


def reported_part(closed: Closed, dataset: Dataset) -> dict[str, Any]:
    """Return the figures of the part that chose no effect; None, or no frame, without one.

    Returns:
        RMS [m], mean negative log likelihood and coverage of each prediction; `frames`, index, time [s] and RMS of
        each; `shown`, the frames of median and of largest error after, with observed and predicted positions.
    """
    before, after = closed.reported or (None, None)
    predictions = {"before": before, "after": after, "with_remainder": closed.with_remainder}
    figures: dict[str, Any] = {}
    for when, found in predictions.items():
        figures[f"{when}_rms_m"] = None if found is None else found.rms
        figures[f"{when}_nll"] = None if found is None else found.nll
        figures[f"{when}_coverage_90"] = None if found is None else found.coverage_90
    if after is None:
        return figures | dict.fromkeys(f"{name}_rms_m" for name in TRIVIAL) | {"frames": [], "shown": []}
    of_part = [timed for timed in dataset.frames if timed.part == dataset.frames[-1].part]
    residuals = {when: _by_frame(found, of_part) for when, found in predictions.items() if found is not None}
    trivial = trivial_predictions(dataset.frames, of_part[0].part)
    figures |= {f"{name}_rms_m": rms(np.concatenate(trivial[name])) for name in TRIVIAL}
    shown = [(k, {when: found[k] for when, found in residuals.items()}) for k in median_and_worst(residuals["after"])]
    return figures | {
        "frames": [
            {"index": timed.index, "time_s": timed.time}
            | {f"{name}_rms_m": _rms(found[k]) for name, found in (residuals | trivial).items()}
            for k, timed in enumerate(of_part)
        ],
        "shown": [_positions(of_part[k], found) for k, found in shown],
    }


def median_and_worst(residuals: list[Float[np.ndarray, "_m 3"]]) -> list[int]:
    """Return which residuals have the median (of an even number the lower one) and the largest RMS; one if it is both.

    Frames without an observed particle count in neither.
    """
    errors = {k: rms(one) for k, one in enumerate(residuals) if len(one)}
    ranked = sorted(errors, key=lambda k: errors[k])
    return list(dict.fromkeys([ranked[(len(ranked) - 1) // 2], ranked[-1]])) if ranked else []


def _by_frame(found: HeldOut, frames: list[Timed]) -> list[Float[np.ndarray, "_m 3"]]:
    """Return the residuals of each frame."""
    return np.split(found.residual, np.cumsum([int(timed.frame.counted.sum()) for timed in frames])[:-1])


def _positions(timed: Timed, residuals: dict[str, Float[np.ndarray, "_m 3"]]) -> dict[str, Any]:
    """Return the observed and predicted positions of a frame [m], null where not observed or held."""
    counted, y = np.asarray(timed.frame.counted), np.asarray(timed.frame.y)
    every: dict[str, Any] = {"index": timed.index, "time_s": timed.time}
    for name, apart in {"observed": 0.0, **residuals}.items():
        positions = np.full(y.shape, np.nan)
        positions[counted] = y[counted] - apart
        every[f"{name}_m"] = [np.round(x, RESOLUTION).tolist() if known else None
                              for x, known in zip(positions, counted, strict=True)]  # fmt: skip
    return every


def _rms(residual: Float[np.ndarray, "m 3"]) -> float | None:
    return rms(residual) if len(residual) else None
