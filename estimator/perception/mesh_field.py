"""Smooth fields over the mesh: interpolation of unmeasured values, and local derivatives.

The fill minimises sum_i c_i |f_i - m_i|^2 + stiffness |L f|^2 with the umbrella Laplacian L and confidences c_i: it
follows confident measurements and continues them linearly. It is independent of images and mechanics.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.linalg import splu

MIN_CONFIDENCE = 1e-6
"""Confidence that is added everywhere, so that the fill has a solution where nothing was measured; it then tends to
0."""


class MeshField:
    """Fields over one triangle mesh."""

    def __init__(self, uv: Float[np.ndarray, "n 2"], faces: Int[np.ndarray, "f 3"]):
        n = len(uv)
        pairs = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])), axis=0)
        i, j = np.concatenate([pairs, pairs[:, ::-1]]).T
        adjacency = csr_array((np.ones(len(i)), (i, j)), shape=(n, n))
        degree = adjacency.sum(axis=1)
        self._mean = diags_array(1 / degree) @ adjacency
        laplacian = diags_array(np.ones(n)) - self._mean
        self._roughness = csc_array(laplacian.T @ laplacian)
        self._neighbours = np.full((n, int(degree.max())), -1)
        place = np.arange(len(adjacency.indices)) - np.repeat(adjacency.indptr[:-1], np.diff(adjacency.indptr))
        self._neighbours[np.repeat(np.arange(n), np.diff(adjacency.indptr)), place] = adjacency.indices
        self._uv = uv
        self._gradient = _gradient(uv, i, j)

    def fill(
        self,
        measured: Float[np.ndarray, "n k"],
        confidence: Float[np.ndarray, " n"] | Bool[np.ndarray, " n"],
        *,
        stiffness: float = 0.1,
    ) -> Float[np.ndarray, "n k"]:
        """Return the smooth field that follows `measured` where `confidence` is above 0; NaN there is not allowed.

        `stiffness` weighs smoothness against a measurement of confidence 1.
        """
        trust = np.asarray(confidence, float) + MIN_CONFIDENCE
        target = np.where(np.asarray(confidence, bool)[:, None], measured, 0.0)
        system = csc_array(diags_array(trust) + stiffness * self._roughness)
        factor = splu(system, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        return factor.solve(np.asarray(confidence, float)[:, None] * target)

    def repaired(
        self, values: Float[np.ndarray, "n k"], known: Bool[np.ndarray, " n"], *, max_stray: float
    ) -> tuple[Float[np.ndarray, "n k"], Bool[np.ndarray, " n"]]:
        """Return the values where they are known and agree with their neighbours, a smooth fill elsewhere, and where.

        Args:
            values: anything finite where unknown.
            known: where they were measured.
            max_stray: largest distance from the median of the known neighbours, in the unit of the values.
        """
        usable = known & (self.stray(values, known) < max_stray)
        return np.where(usable[:, None], values, self.fill(values, usable)), usable

    def dilated(self, chosen: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Return the chosen particles and those that share an edge with one."""
        return chosen | ((self._neighbours >= 0) & chosen[self._neighbours]).any(axis=1)

    def stray(self, values: Float[np.ndarray, "n k"], known: Bool[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return each value's distance from its known neighbours' median; inf where it or all of them are unknown."""
        return self._from_median(values, values[self._neighbours], known)

    def off_trend(self, values: Float[np.ndarray, "n 2"], known: Bool[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return each value's distance from the median of its neighbours' linear continuations; inf as in `stray`.

        A neighbour's value is continued to the particle by the neighbour's own derivative.
        """
        step = self._uv[:, None, :] - self._uv[self._neighbours]
        continued = values[self._neighbours] + np.einsum("nmij,nmj->nmi", self.jacobian(values)[self._neighbours], step)
        return self._from_median(values, continued, known)

    def _from_median(
        self, values: Float[np.ndarray, "n k"], around: Float[np.ndarray, "n m k"], known: Bool[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        """Return the distance of each value from the median of the known values `around` it."""
        usable = (self._neighbours >= 0) & known[self._neighbours]
        count = usable.sum(axis=1)
        ordered = np.sort(np.where(usable[..., None], around, np.inf), axis=1)
        rows = np.arange(len(values))
        median = (
            ordered[rows, np.maximum(count - 1, 0) // 2] + ordered[rows, np.minimum(count // 2, ordered.shape[1] - 1)]
        ) / 2
        comparable = known & (count > 0)
        return np.where(comparable, np.linalg.norm(values - np.where(comparable[:, None], median, 0), axis=1), np.inf)

    def jacobian(self, values: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2 2"]:
        """Return the derivative of values by first-image pixels, by least squares over each particle's neighbours."""
        return np.stack([gradient @ values for gradient in self._gradient], axis=-1)


def _gradient(uv: Float[np.ndarray, "n 2"], i: np.ndarray, j: np.ndarray) -> tuple[csr_array, csr_array]:
    """Return two sparse matrices that map values at the particles to their derivatives by u and v.

    Least squares over the neighbours j of i: g_i = (sum_j s s^T)^-1 sum_j s (f_j - f_i), s = uv_j - uv_i.
    """
    n, step = len(uv), uv[j] - uv[i]
    normal = np.zeros((n, 2, 2))
    np.add.at(normal, i, step[:, :, None] * step[:, None, :])
    weight = np.einsum("mij,mj->mi", np.linalg.inv(normal)[i], step)
    along_u, along_v = (
        csr_array((np.concatenate([w, -w]), (np.concatenate([i, i]), np.concatenate([j, i]))), shape=(n, n))
        for w in weight.T
    )
    return along_u, along_v
