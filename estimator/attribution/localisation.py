"""Where and when a fit has large residuals, and what they correlate with: for a person to look at, not to decide by."""

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.stats import spearmanr

from .gauss_newton import Fitted
from .problem import Problem

MIN_PAIRS = 3
"""Smallest number of pairs with a rank correlation: of two it is always 1 or -1."""


def localisation(fitted: Fitted) -> dict[str, Any]:
    """Return a fit's residuals by frame and by particle, and rank correlations with possible causes.

    Returns:
        frames: index, grasp, time [s], rms [m]; particles: rest [m] and mean residual, observed minus predicted [m],
        null where never observed, P(attached) and whether that is more than a half, and whether the jaws held it in any
        of the frames; rank_correlation: Spearman's correlation of the residual's length, over frames and particles,
        with each regressor.
    """
    problem = fitted.problem
    frames, rest = list(fitted.equations), np.asarray(problem.history.rest)
    residual = np.full((len(frames), len(rest), 3), np.nan)
    for row, k in zip(residual, frames, strict=True):
        frame = problem.history.frames[k].frame
        counted = np.asarray(frame.counted)
        row[counted] = (np.asarray(frame.y) - fitted.point.seen[k])[counted]
    seen = np.asarray(np.isfinite(residual).all(axis=2))
    ever = np.asarray(seen.any(axis=0))
    distance, total = np.linalg.norm(residual, axis=2), np.nansum(residual, axis=0)
    mean = np.divide(total, seen.sum(axis=0)[:, None], where=ever[:, None], out=np.zeros_like(rest))
    return {
        "frames": [
            {
                "index": problem.history.frames[k].index,
                "grasp": problem.history.frames[k].grasp,
                "time_s": problem.history.frames[k].time,
                "rms_m": float(np.sqrt(np.nanmean(row**2))) if np.isfinite(row).any() else None,
            }
            for k, row in zip(frames, distance, strict=True)
        ],
        "particles": {
            "rest_m": rest.tolist(),
            "mean_residual_m": [one.tolist() if known else None for one, known in zip(mean, ever, strict=True)],
            "p_attached": fitted.probability.tolist(),
            "attached": fitted.attached.tolist(),
            "held": np.any([np.asarray(problem.history.frames[k].frame.held) for k in frames], axis=0).tolist(),
        },
        "correlates_with": {
            name: _rank_correlation(distance, values) for name, values in _regressors(problem, fitted, frames).items()
        },
    }


def _regressors(problem: Problem, fitted: Fitted, frames: list[int]) -> dict[str, Float[np.ndarray, "frames n"]]:
    """Return what might cause a residual, for each particle in each frame."""
    history, rest = problem.history, np.asarray(problem.history.rest)
    states = fitted.point.states[frames]
    moved = states - rest[None]
    before = np.stack([np.asarray(history.context(k, fitted.point.states).before) for k in frames])
    spread = np.ones(len(rest))[None]
    held = np.stack([np.asarray(history.frames[k].frame.held) for k in frames])
    grip = np.stack([rest[one].mean(axis=0) if one.any() else np.full(3, np.nan) for one in held])
    return {
        "height": moved[:, :, 2],
        "displacement from rest": np.linalg.norm(moved, axis=2),
        "step since the previous frame": np.linalg.norm(states - before, axis=2),
        "downward step": (before - states)[:, :, 2],
        "distance to the grip": np.linalg.norm(rest[None] - grip[:, None], axis=2),
        "time since the jaws closed": np.array([history.frames[k].closed for k in frames])[:, None] * spread,
        "time since the start": np.array([history.frames[k].time for k in frames])[:, None] * spread,
        "attachment": np.broadcast_to(fitted.point.s[None], moved.shape[:2]),
    }


def _rank_correlation(distance: Float[np.ndarray, "f n"], values: Float[np.ndarray, "f n"]) -> float | None:
    """Return the correlation where both are known; None if that is too little, or the values are all the same."""
    both = np.isfinite(distance) & np.isfinite(values)
    if both.sum() < MIN_PAIRS or np.ptp(values[both]) == 0:
        return None
    return float(np.asarray(spearmanr(distance[both], values[both]))[0])
