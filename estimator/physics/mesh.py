"""The estimator's own mesh: triangles over rest positions, with the edges, hinges and areas that the energy needs.

Built once from the first observation (or a declared mesh) in numpy; it has no stiffness and no forces.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float, Int

from jiggle_mj.mesh_checks import check_mesh


@dataclass(frozen=True)
class SheetMesh:
    """A triangulated sheet at rest.

    Raises:
        MeshError: degenerate or inverted triangles, an index out of range, or several pieces.
    """

    rest: Float[np.ndarray, "n 3"]
    """Rest positions [m]."""
    faces: Int[np.ndarray, "f 3"]
    """Particles of each triangle."""

    def __post_init__(self) -> None:
        """Check that an energy can be written for the mesh."""
        check_mesh(self.rest, self.faces)

    @property
    def n(self) -> int:
        """Return the number of particles."""
        return len(self.rest)

    @cached_property
    def edges(self) -> Int[np.ndarray, "e 2"]:
        """Return each edge once, lower index first."""
        return np.unique(np.sort(self._half_edges[:, :2], axis=1), axis=0)

    @cached_property
    def hinges(self) -> Int[np.ndarray, "h 4"]:
        """Return the inner edges (first two vertices) with the two vertices opposite to them."""
        half = self._half_edges
        half = np.column_stack([np.sort(half[:, :2], axis=1), half[:, 2]])
        half = half[np.lexsort(half.T[::-1])]
        twin = np.flatnonzero(np.all(half[:-1, :2] == half[1:, :2], axis=1))
        return np.column_stack([half[twin, :2], half[twin, 2], half[twin + 1, 2]])

    @cached_property
    def border_edges(self) -> tuple[Int[np.ndarray, "e 2"], Int[np.ndarray, " e"]]:
        """Return the edges of the outline, each in the order of its triangle, and these triangles."""
        half = self._half_edges[:, :2]
        _, first, count = np.unique(np.sort(half, axis=1), axis=0, return_index=True, return_counts=True)
        outer = first[count == 1]
        return half[outer], outer % len(self.faces)

    @cached_property
    def border(self) -> Bool[np.ndarray, " n"]:
        """Return which particles lie on the sheet's edge."""
        on_edge = np.zeros(self.n, dtype=bool)
        on_edge[self.border_edges[0]] = True
        return on_edge

    @cached_property
    def face_area(self) -> Float[np.ndarray, " f"]:
        """Return the area of each triangle [m^2]."""
        a, b, c = np.moveaxis(self.rest[self.faces], 1, 0)
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)

    @cached_property
    def particle_area(self) -> Float[np.ndarray, " n"]:
        """Return each particle's area: a third of every adjoining triangle [m^2]."""
        return np.bincount(self.faces.ravel(), np.repeat(self.face_area / 3, 3), minlength=self.n)

    @cached_property
    def spacing(self) -> float:
        """Return the median edge length [m]."""
        return float(np.median(np.linalg.norm(self.rest[self.edges[:, 0]] - self.rest[self.edges[:, 1]], axis=1)))

    @cached_property
    def adjacency(self) -> sp.csr_matrix:
        """Return which particles share an edge or a hinge: the pattern of the energy's Hessian."""
        pairs = [self.hinges[:, [a, b]] for a in range(4) for b in range(a)]
        return pattern(self.n, np.concatenate([self.edges, *pairs]))

    @property
    def _half_edges(self) -> Int[np.ndarray, "h 3"]:
        """Return the directed edges of every face with the opposite vertex."""
        f = self.faces
        return np.concatenate([f[:, [0, 1, 2]], f[:, [1, 2, 0]], f[:, [2, 0, 1]]])


def pattern(n: int, pairs: Int[np.ndarray, "m 2"]) -> sp.csr_matrix:
    """Return the symmetric n x n boolean pattern with the given pairs and the diagonal."""
    return symmetric(n, np.concatenate([pairs, np.repeat(np.arange(n)[:, None], 2, axis=1)]))


def symmetric(n: int, pairs: Int[np.ndarray, "m 2"]) -> sp.csr_matrix:
    """Return the symmetric n x n boolean pattern with the given pairs alone."""
    i, j = np.concatenate([pairs, pairs[:, ::-1]]).T
    return sp.csr_matrix((np.ones(len(i), dtype=bool), (i, j)), shape=(n, n))


def neighbour_table(near: sp.csr_matrix) -> Int[np.ndarray, "n p"]:
    """Return the columns of each row of a pattern, in ascending order, padded with -1."""
    near = near.sorted_indices()
    degree = np.diff(near.indptr)
    table = np.full((len(degree), degree.max()), -1)
    place = np.arange(len(near.indices)) - np.repeat(near.indptr[:-1], degree)
    table[np.repeat(np.arange(len(degree)), degree), place] = near.indices
    return table


def reverse_places(table: Int[np.ndarray, "n p"]) -> Int[np.ndarray, "n p"]:
    """Return each particle's place in the rows of its neighbours, of a symmetric `neighbour_table`.

    Entries for the padding have no meaning.
    """
    return np.argmax(table[table] == np.arange(len(table))[:, None, None], axis=2)


def farthest_points(points: Float[np.ndarray, "n 3"], count: int) -> Int[np.ndarray, " _count"]:
    """Return indices of up to `count` points by farthest-point sampling, the first the one farthest from the mean."""
    chosen = [int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    nearest = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)
