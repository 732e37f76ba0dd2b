"""Guess from how points move which are held, and how large their noise is."""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from ..plausibility.held_motion import N_LEADERS

MOST_HELD = 12
"""Points that are guessed to be held, at most."""
HELD_SHARE = 0.8
"""Displacement from which a point is guessed to be held, as a share of that of the leading points."""
FIRST_SHARE = 0.3
"""The pull has begun where the leading points have moved by this share of their largest displacement."""
N_NEIGHBOURS = 6
"""Neighbours with which a point's displacement is compared."""
MAD_TO_SD = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
MIN_NOISE_SHARE = 1e-4
"""Least noise, as a share of the sheet's extent: points that were smoothed tremble less than they err."""


def guess_held(frames: Float[np.ndarray, "t n 3"]) -> Int[np.ndarray, " h"]:
    """Return the points that move most at the beginning of a pull, one cluster of them.

    Args:
        frames: of one run, the first at rest.
    """
    moved = np.linalg.norm(frames - frames[0], axis=2)
    leading = np.sort(np.nan_to_num(moved), axis=1)[:, -min(N_LEADERS, moved.shape[1]) :].mean(axis=1)
    at = int(np.argmax(leading >= FIRST_SHARE * leading.max())) if leading.max() > 0 else len(frames) - 1
    moved_then = np.nan_to_num(moved[at])
    level = HELD_SHARE * np.sort(moved_then)[-min(N_LEADERS, len(moved_then)) :].mean()
    order = np.argsort(-moved_then, kind="stable")
    seen = np.flatnonzero(np.isfinite(frames[0]).all(axis=1))
    candidates = order[(moved_then[order] >= level) & np.isin(order, seen)][:MOST_HELD]
    spacing = float(np.median(KDTree(frames[0][seen]).query(frames[0][seen], k=2)[0][:, 1]))
    centre = np.median(frames[0][candidates], axis=0)
    near = np.linalg.norm(frames[0][candidates] - centre, axis=1) <= spacing * np.sqrt(MOST_HELD)
    return np.sort(candidates[near] if near.any() else candidates[:1])


def guess_noise(frames: Float[np.ndarray, "t n 3"]) -> float:
    """Return the standard deviation of a coordinate, in the unit of the frames.

    The smaller of two estimates: how positions bend in time (second differences), and how a point's displacement
    differs from the mean of its neighbours'. Motion adds to the first, strain to the second.
    """
    extent = float(np.nanmax(np.nanmax(frames[0], axis=0) - np.nanmin(frames[0], axis=0)))
    planar = bool(np.nanmax(np.abs(frames[:, :, 2])) == 0)
    axes = slice(0, 2) if planar else slice(0, 3)
    estimates = [_rough(frames[:, :, axes])]
    if len(frames) >= 3:
        bend = frames[:-2, :, axes] - 2 * frames[1:-1, :, axes] + frames[2:, :, axes]
        estimates.append(MAD_TO_SD * _median(np.abs(bend)) / np.sqrt(6))
    finite = [estimate for estimate in estimates if np.isfinite(estimate)]
    return max([MIN_NOISE_SHARE * extent, min(finite, default=0.0)])


def _rough(frames: Float[np.ndarray, "t n c"]) -> float:
    seen = np.flatnonzero(np.isfinite(frames[0]).all(axis=1))
    k = min(N_NEIGHBOURS, len(seen) - 1)
    near = np.asarray(KDTree(frames[0][seen]).query(frames[0][seen], k=k + 1)[1])[:, 1:]
    moved = (frames - frames[0])[1:, seen]
    stray = moved - moved[:, near].mean(axis=2)
    # A displacement holds the noise of two frames, and the neighbours' mean adds a k-th.
    return MAD_TO_SD * _median(np.abs(stray)) / np.sqrt(2 * (1 + 1 / k))


def _median(values: Float[np.ndarray, "..."]) -> float:
    """Return the median of the values that are known; NaN where none is."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else np.nan
