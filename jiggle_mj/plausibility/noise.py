"""Noise of measured points: from frames in which nothing moves, or from how a point strays from its neighbours.

Both are robust: the median absolute deviation, scaled to the standard deviation of a normal distribution.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

MAD_TO_SD = 1.4826
"""Standard deviation of a normal distribution [median absolute deviation]."""
N_NEIGHBOURS = 10
"""Neighbours of a point that predict its displacement: an affine field in a plane has 3 unknowns a coordinate."""
MAX_POINTS = 1000
"""Most points whose neighbours are compared, which bounds the time of a frame."""
CALM_QUANTILE = 0.25
"""Quantile over the frames that counts as the noise: in calm frames the field of displacements is smooth."""


def noise_of_difference(before: Float[np.ndarray, "n 3"], after: Float[np.ndarray, "n 3"]) -> float | None:
    """Return the standard deviation of a coordinate [m] from two frames without motion; None where none is seen twice.

    Args:
        before: positions [m], NaN where unseen.
        after: the same points in the next frame.
    """
    difference = (after - before)[np.isfinite(after - before).all(axis=1)]
    if not len(difference):
        return None
    difference = difference - np.median(difference, axis=0)
    return float(MAD_TO_SD * np.median(np.abs(difference)) / np.sqrt(2))


class NeighbourNoise:
    """Noise of a frame from each point's distance to where its neighbours' displacements put it.

    The displacement from the rest frame is predicted by an affine fit over the nearest points at rest. The residual
    holds the noise of two frames and the error of the fit.
    """

    def __init__(self, rest: Float[np.ndarray, "n 3"]) -> None:
        """Choose points and their neighbours at rest.

        Args:
            rest: positions [m], NaN where unseen.
        """
        self._rest, self._sds = rest, list[float]()
        seen = np.flatnonzero(np.isfinite(rest).all(axis=1))
        self._centres: Int[np.ndarray, " m"] = seen[:: max(1, len(seen) // MAX_POINTS)]
        if len(seen) <= N_NEIGHBOURS:
            self._centres = self._centres[:0]
            return
        nearest = np.asarray(KDTree(rest[seen]).query(rest[self._centres], k=N_NEIGHBOURS + 1)[1])
        self._neighbours = seen[nearest[:, 1:]]
        around = rest[self._neighbours] - rest[self._centres][:, None]
        size = np.linalg.norm(around, axis=2).max(axis=1)
        design = np.concatenate([np.ones((*around.shape[:2], 1)), around / np.maximum(size, 1e-300)[:, None, None]], 2)
        # The value of the fit at the centre is the first row of the pseudo-inverse, as the offsets are zero there.
        self._weights: Float[np.ndarray, "m k"] = np.linalg.pinv(design, rcond=0.05)[:, 0]
        self._inflation = np.sqrt(2 * (1 + np.sum(self._weights**2, axis=1)))

    def add(self, positions: Float[np.ndarray, "n 3"]) -> None:
        """Take one more frame of the same points [m]; rows behind them, of points that came later, are left out."""
        if not len(self._centres):
            return
        displacement = positions[: len(self._rest)] - self._rest
        predicted = np.einsum("mk,mkc->mc", self._weights, displacement[self._neighbours])
        residual = (displacement[self._centres] - predicted) / self._inflation[:, None]
        residual = residual[np.isfinite(residual).all(axis=1)]
        if len(residual):
            self._sds.append(float(MAD_TO_SD * np.median(np.abs(residual))))

    @property
    def sd(self) -> float | None:
        """Return the standard deviation of a coordinate in calm frames [m]; None before any frame."""
        return float(np.quantile(self._sds, CALM_QUANTILE)) if self._sds else None
