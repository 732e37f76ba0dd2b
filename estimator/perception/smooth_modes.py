"""The largest modes of a smooth field over points.

With the covariance K_ij = exp(-(|a_i - a_j| / length)^p / p), which is Gaussian for p = 2, an orthonormal Q that
roughly spans the largest eigenvectors, and B = K Q,

    B (Q^T B)^-1 B^T = V Lambda V^T

is the Nystroem approximation of K. It is never above K, so what the modes lack is a covariance too, and it is exact
where Q spans the eigenvectors [Tropp, Yurtsever, Udell, Cevher 2017, doi:10.1137/17M1111590]. The first Q is
interpolated from the eigenvectors of few landmarks, each weighted by the number of points near it; every further one
is V. B takes the kernel of all points, made in blocks of rows: n points take O(n^2) time and O(n) memory.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from scipy.linalg import cholesky, eigh, solve_triangular

MAX_LANDMARKS = 1000
"""Most landmarks: their eigenvectors take 0.4 s on two cores. With as many points or fewer, the points are it."""
COARSENING = 1.05
"""Factor by which the landmarks' cells grow until there are few enough."""
SPARE_MODES = 45
"""Modes beyond those asked for, which take the error of the interpolation."""
MAX_PASSES = 4
"""Most passes over the kernel of all points."""
MIN_GAIN = 1e-4
"""Growth of the modes' variance by a pass below which another one changes nothing [1]."""
BLOCK_ENTRIES = 4_000_000
"""Entries of the kernel that are made at once, which bounds the memory to 32 MB."""
MIN_EIGENVALUE = 1e-10
"""Smallest eigenvalue of a mode [largest eigenvalue]: below it is rounding."""
Kernel = Callable[[Float[np.ndarray, "a 3"], Float[np.ndarray, "b 3"]], Float[np.ndarray, "a b"]]
"""Covariance of the field between two sets of places."""


def smooth_modes(
    points: Float[np.ndarray, "n 3"], length: float, count: int, *, exponent: float = 2.0
) -> Float[np.ndarray, "n m"]:
    """Return the largest modes of a smooth field of unit variance, scaled by the roots of their eigenvalues.

    The columns are orthogonal, in the order of their squared norms, which are the eigenvalues and sum to n over all
    modes. The same points give the same bits.

    Args:
        points: places [m].
        length: range of the field [m].
        count: largest number of modes; there are fewer where the kernel has a lower rank.
        exponent: p of the covariance, from 1 to 2.
    """

    def kernel(a: Float[np.ndarray, "a 3"], b: Float[np.ndarray, "b 3"]) -> Float[np.ndarray, "a b"]:
        return _kernel(a, b, length, exponent)

    landmarks, weight = _landmarks(points)
    count = min(count, len(landmarks))
    spare = min(count + SPARE_MODES, len(landmarks))
    root = np.sqrt(weight)
    among = root[:, None] * kernel(landmarks, landmarks) * root
    values, vectors = eigh(among, subset_by_index=(len(landmarks) - spare, len(landmarks) - 1))
    values, vectors = _ordered(values, vectors)
    if len(landmarks) == len(points):
        return vectors[:, :count] * np.sqrt(values[:count])
    modes, before = _times_kernel(kernel, points, landmarks, root[:, None] * vectors / values), 0.0
    for _ in range(MAX_PASSES):
        modes = _nystroem(kernel, points, np.linalg.qr(modes)[0])
        variance = float(np.sum(modes[:, :count] ** 2))
        if variance - before < MIN_GAIN * variance:
            break
        before = variance
    return modes[:, :count]


def _nystroem(
    kernel: Kernel, points: Float[np.ndarray, "n 3"], Q: Float[np.ndarray, "n k"]
) -> Float[np.ndarray, "n m"]:
    """Return V Lambda^1/2 of the Nystroem approximation for an orthonormal Q."""
    B = _times_kernel(kernel, points, points, Q)
    middle = Q.T @ B
    middle = (middle + middle.T) / 2 + MIN_EIGENVALUE * np.trace(middle) * np.eye(len(middle))
    half = solve_triangular(cholesky(middle, lower=True), B.T, lower=True).T
    _, vectors = _ordered(*np.linalg.eigh(half.T @ half))
    return half @ vectors


def _ordered(
    values: Float[np.ndarray, " k"], vectors: Float[np.ndarray, "n k"]
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "n m"]]:
    """Return eigenvalues above rounding and their eigenvectors, the largest first."""
    kept = np.flatnonzero(values > MIN_EIGENVALUE * values[-1])[::-1]
    return values[kept], vectors[:, kept]


def _landmarks(points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, " k"]]:
    """Return the centres of cells in which the points lie [m], and the number of points in each."""
    if len(points) <= MAX_LANDMARKS:
        return points, np.ones(len(points))
    low, size = points.min(axis=0), float(np.ptp(points, axis=0).max()) / np.sqrt(MAX_LANDMARKS)
    while True:
        cell = np.floor((points - low) / size).astype(int)
        _, which, number = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
        if len(number) <= MAX_LANDMARKS:
            break
        size *= COARSENING
    sums = np.array([np.bincount(which.ravel(), weights=column) for column in points.T])
    return (sums / number).T, number.astype(float)


def _kernel(
    a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "k 3"], length: float, exponent: float
) -> Float[np.ndarray, "n k"]:
    """Return the covariance of a smooth field of unit variance between two sets of places."""
    centre = b.mean(axis=0)
    a, b = (a - centre) / length, (b - centre) / length
    squared = np.maximum(np.sum(a**2, axis=1)[:, None] + np.sum(b**2, axis=1) - 2 * a @ b.T, 0.0)
    return np.exp(-(squared ** (exponent / 2)) / exponent)


def _times_kernel(
    kernel: Kernel, a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "k 3"], columns: Float[np.ndarray, "k m"]
) -> Float[np.ndarray, "n m"]:
    """Return the covariance between two sets of places times columns, without the whole of the covariance at once."""
    rows = max(1, BLOCK_ENTRIES // len(b))
    return np.concatenate([kernel(a[k : k + rows], b) @ columns for k in range(0, len(a), rows)])
