"""A tracker's drift: a random walk of the shift of observed positions that neighbours share.

A tracker follows a point from frame to frame, so that what it errs by in one frame it errs by in the next. The
amplitudes w of the smooth fields of the noise are, in frame k,

    w_k = w_(k-1) + step,    step ~ N(0, v I)

with a variance v for each frame of the recording, from w = 0 at rest. The walk is eliminated frame by frame of a grasp,
as a Kalman filter does it [Kalman 1960, doi:10.1115/1.3662552], and what is known of it from all frames is that of the
smoother [Rauch, Tung and Striebel 1965, doi:10.2514/3.3166]. Grasps are taken to be independent.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class Eliminated(NamedTuple):
    """Quadratic forms without the walk."""

    square: Float[np.ndarray, "k k"]
    """Inner products of the other columns."""
    log_det: float
    """ln |I + S^T M S|, with M what the frames say of the walk and S S^T its prior covariance."""


class Known(NamedTuple):
    """What the frames say of the walk in each, with amplitudes z of the other columns: N(-mean z, covariance)."""

    mean: Float[np.ndarray, "t m k"]
    """Slope of minus the mean by z."""
    covariance: Float[np.ndarray, "t m m"]
    """Covariance."""


class _Step(NamedTuple):
    """One frame of the filter."""

    before: Float[np.ndarray, "m m"]
    """Covariance of the walk by the frames before."""
    mean: Float[np.ndarray, "m k"]
    """Minus its mean by this frame too."""
    covariance: Float[np.ndarray, "m m"]
    """Its covariance by this frame too."""


def without_walk(
    own: Float[np.ndarray, "t m m"], beside: Float[np.ndarray, "t m k"], variances: Float[np.ndarray, " t"]
) -> Eliminated:
    """Return what the walk takes from the inner products of the other columns, a matrix that is not positive.

    Args:
        own: inner products of the walk's columns in each frame.
        beside: those of the walk's columns and the others.
        variances: of the walk's step to each frame.
    """
    _, square, log_det = _filtered(own, beside, variances)
    return Eliminated(square=square, log_det=log_det)


def known_walk(
    own: Float[np.ndarray, "t m m"], beside: Float[np.ndarray, "t m k"], variances: Float[np.ndarray, " t"]
) -> Known:
    """Return what all frames say of the walk in each; for arguments see `without_walk`."""
    steps, _, _ = _filtered(own, beside, variances)
    mean, covariance = [steps[-1].mean], [steps[-1].covariance]
    for now, after in zip(steps[-2::-1], steps[:0:-1], strict=True):
        gain = np.linalg.solve(after.before, now.covariance).T
        mean.append(now.mean + gain @ (mean[-1] - now.mean))
        covariance.append(now.covariance + gain @ (covariance[-1] - after.before) @ gain.T)
    return Known(mean=np.array(mean[::-1]), covariance=np.array(covariance[::-1]))


def _filtered(
    own: Float[np.ndarray, "t m m"], beside: Float[np.ndarray, "t m k"], variances: Float[np.ndarray, " t"]
) -> tuple[list[_Step], Float[np.ndarray, "k k"], float]:
    """Return each frame of the filter, what is eliminated from the inner products, and the log determinant."""
    m, k = beside.shape[1:]
    mean, covariance, square, log_det = np.zeros((m, k)), np.zeros((m, m)), np.zeros((k, k)), 0.0
    steps = list[_Step]()
    for M, b, v in zip(own, beside, variances, strict=True):
        before = covariance + v * np.eye(m)
        root = _cholesky(before)
        inner = _cholesky(np.eye(m) + root.T @ M @ root)
        log_det += 2 * float(np.sum(np.log(np.diagonal(inner))))
        half = np.linalg.solve(inner, root.T)
        covariance = half.T @ half
        off = M @ mean
        slope = half @ (b - off)
        crossed = mean.T @ b
        square += mean.T @ off - crossed - crossed.T - slope.T @ slope
        mean = mean + half.T @ slope
        steps.append(_Step(before=before, mean=mean, covariance=covariance))
    return steps, square, log_det


def _cholesky(matrix: Float[np.ndarray, "m m"]) -> Float[np.ndarray, "m m"]:
    """Return the lower Cholesky factor; NaN where there is none."""
    try:
        return np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return np.full(matrix.shape, np.nan)
