"""The estimator's own mesh: triangles over rest positions, with the edges, hinges and areas that the energy needs.

Built once from the first observation (or a declared mesh) in numpy; knows no stiffness and no forces.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int
from scipy.spatial import Delaunay

from jiggle_mj.errors import MeshError
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

    def __post_init__(self) -> None:
        """Refuse what no energy can be written for."""
        check_mesh(self.rest, self.faces)

    @property
    def n(self) -> int:
        """Number of particles."""
        return len(self.rest)

    @cached_property
    def edges(self) -> Int[np.ndarray, "e 2"]:
        """Each edge once, lower index first."""
        return np.unique(np.sort(self._half_edges[:, :2], axis=1), axis=0)

    @cached_property
    def hinges(self) -> Int[np.ndarray, "h 4"]:
        """Inner edges (first two vertices) with the two vertices opposite to them."""
        half = self._half_edges
        half = np.column_stack([np.sort(half[:, :2], axis=1), half[:, 2]])
        half = half[np.lexsort(half.T[::-1])]
        twin = np.flatnonzero(np.all(half[:-1, :2] == half[1:, :2], axis=1))
        return np.column_stack([half[twin, :2], half[twin, 2], half[twin + 1, 2]])

    @cached_property
    def face_area(self) -> Float[np.ndarray, " f"]:
        """[m^2]."""
        a, b, c = np.moveaxis(self.rest[self.faces], 1, 0)
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)

    @cached_property
    def particle_area(self) -> Float[np.ndarray, " n"]:
        """A third of each adjoining triangle [m^2]."""
        return np.bincount(self.faces.ravel(), np.repeat(self.face_area / 3, 3), minlength=self.n)

    @cached_property
    def spacing(self) -> float:
        """Median edge length [m]."""
        return float(np.median(np.linalg.norm(self.rest[self.edges[:, 0]] - self.rest[self.edges[:, 1]], axis=1)))

    @cached_property
    def adjacency(self) -> sp.csr_matrix:
        """Particles that share an edge or a hinge: the pattern of the energy's Hessian."""
        pairs = [self.hinges[:, [a, b]] for a in range(4) for b in range(a)]
        return pattern(self.n, np.concatenate([self.edges, *pairs]))

    @property
    def _half_edges(self) -> Int[np.ndarray, "h 3"]:
        """Directed edges of every face with the opposite vertex."""
        f = self.faces
        return np.concatenate([f[:, [0, 1, 2]], f[:, [1, 2, 0]], f[:, [2, 0, 1]]])


def pattern(n: int, pairs: Int[np.ndarray, "m 2"]) -> sp.csr_matrix:
    """Symmetric n x n boolean pattern with the given pairs and the diagonal."""
    i, j = np.concatenate([pairs, pairs[:, ::-1], np.repeat(np.arange(n)[:, None], 2, axis=1)]).T
    return sp.csr_matrix((np.ones(len(i), dtype=bool), (i, j)), shape=(n, n))


def triangulate(points: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, "f 3"]:
    """Delaunay triangles of a nearly flat cloud, seen along its thinnest direction and facing up.

    Long slivers along the outline are peeled off: a face is dropped while it is on the outline and its longest edge
    exceeds 1.8 times the median.

    Raises:
        MeshError: fewer than three points, or points on a line.
    """
    if len(points) < 3:
        raise MeshError(f"a sheet needs at least 3 points; got {len(points)}.")
    centred = points - points.mean(axis=0)
    _, stretch, axes = np.linalg.svd(centred, full_matrices=False)
    if stretch[1] < 1e-6 * stretch[0]:
        raise MeshError("the points lie on a line; a sheet needs two directions.")
    if np.linalg.det(axes) < 0:
        axes[1] *= -1
    if axes[2, 2] < 0:
        axes[1:] *= -1
    flat = centred @ axes[:2].T
    faces = Delaunay(flat).simplices
    corners = flat[faces]
    (a, b), (c, d) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    faces = np.where((a * d < b * c)[:, None], faces[:, [0, 2, 1]], faces)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    limit, keep = 1.8 * np.median(longest), np.ones(len(faces), dtype=bool)
    while True:
        edges = np.sort(np.concatenate([faces[keep][:, [0, 1]], faces[keep][:, [1, 2]], faces[keep][:, [2, 0]]]), axis=1)
        _, inverse, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
        outer = (count[inverse.ravel()] == 1).reshape(3, -1).any(axis=0)
        drop = np.flatnonzero(keep)[outer & (longest[keep] > limit)]
        if not len(drop):
            return faces[keep].astype(np.int64)
        keep[drop] = False
