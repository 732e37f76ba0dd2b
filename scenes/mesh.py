"""Triangulations of the sheet, and the checks that any of them must pass.

`equilateral` rows are a triangular lattice: equal triangles, offset rows, straight edges; `unstructured`
jitters its inner vertices and triangulates them anew [Delaunay]. Regular right-triangle grids are left out on purpose:
their bending stiffness depends on the pattern.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay

from jiggle_mj.errors import MeshError

JITTER = 0.22
"""Largest displacement of an inner vertex of the unstructured mesh, in edge lengths."""


@dataclass(frozen=True, kw_only=True)
class Triangulation:
    """A flat sheet at rest, triangles counter-clockwise seen from above."""

    vertices: Float[np.ndarray, "n 2"]
    """Tissue coordinates [m]."""
    faces: Int[np.ndarray, "f 3"]

    def vertex_areas(self) -> Float[np.ndarray, " n"]:
        """A third of the triangles around each vertex [m^2]."""
        areas = np.zeros(len(self.vertices))
        np.add.at(areas, self.faces, (triangle_areas(self.vertices, self.faces) / 3)[:, None])
        return areas


def triangle_areas(vertices: Float[np.ndarray, "n 2"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, " f"]:
    """Signed areas, positive counter-clockwise [m^2]."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return 0.5 * ((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]))


def lattice(size: tuple[float, float], spacing: float) -> Float[np.ndarray, "n 2"]:
    """Offset rows over a rectangle around the origin, its corners and edges included [m]."""
    columns = max(round(size[0] / spacing), 2)
    dx = size[0] / columns
    rows = max(round(size[1] / (dx * np.sqrt(0.75))), 2)
    even = np.linspace(-size[0] / 2, size[0] / 2, columns + 1)
    odd = np.concatenate([even[:1], (even[1:] + even[:-1]) / 2, even[-1:]])
    heights = np.linspace(-size[1] / 2, size[1] / 2, rows + 1)
    return np.concatenate([[(x, y) for x in (odd if row % 2 else even)] for row, y in enumerate(heights)])


def triangulate(vertices: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "f 3"]:
    """Delaunay triangles, counter-clockwise, without the flat ones that collinear edges leave."""
    faces = Delaunay(vertices).simplices.astype(np.int64)
    areas = triangle_areas(vertices, faces)
    faces[areas < 0] = faces[areas < 0][:, ::-1]
    return faces[np.abs(areas) > 1e-3 * np.median(np.abs(areas))]


def build_sheet(*, size: tuple[float, float], spacing: float, kind: str, seed: int) -> Triangulation:
    """A rectangular sheet [m]; `kind` is `equilateral` or `unstructured`, `seed` draws the latter."""
    vertices = lattice(size, spacing)
    if kind == "unstructured":
        inner = np.all(np.abs(vertices) < np.array(size) / 2 - 1e-9, axis=1)
        draw = np.random.default_rng(seed).uniform(-1.0, 1.0, (int(inner.sum()), 2))
        vertices[inner] += JITTER * spacing * draw / np.sqrt(2.0)
    sheet = Triangulation(vertices=vertices, faces=triangulate(vertices))
    check_sheet(sheet.vertices, sheet.faces)
    return sheet


def check_sheet(vertices: Float[np.ndarray, "n 2"], faces: Int[np.ndarray, "f 3"]) -> None:
    """Refuse a mesh that no shell can be made of.

    Raises:
        MeshError: a triangle names a missing vertex, has no area or is inverted, an edge belongs to more than two
            triangles, a vertex to none, or the sheet falls into pieces.
    """
    n = len(vertices)
    if not np.isfinite(vertices).all():
        raise MeshError(f"vertex {int(np.argwhere(~np.isfinite(vertices))[0, 0])} is not finite.")
    if faces.size == 0 or faces.min() < 0 or faces.max() >= n:
        raise MeshError(f"triangles must name vertices 0 to {n - 1}; got {len(faces)} triangles outside that range.")
    areas = triangle_areas(vertices, faces)
    longest = np.max([np.linalg.norm(vertices[faces[:, k]] - vertices[faces[:, k - 1]], axis=1) for k in range(3)], 0)
    flat = np.flatnonzero(np.abs(areas) <= 1e-3 * longest**2)
    if flat.size:
        raise MeshError(
            f"{flat.size} degenerate triangles, the first is {flat[0]} with vertices {faces[flat[0]].tolist()} and area "
            f"{areas[flat[0]]:.3g} m^2: merge its vertices or move them apart."
        )
    inverted = np.flatnonzero(areas < 0)
    if inverted.size:
        raise MeshError(
            f"{inverted.size} inverted triangles, the first is {inverted[0]} with vertices "
            f"{faces[inverted[0]].tolist()}: list the vertices counter-clockwise seen from above."
        )
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    if count.max() > 2:
        raise MeshError(f"edge {unique[count.argmax()].tolist()} belongs to {count.max()} triangles; at most 2 can meet.")
    graph = coo_matrix((np.ones(len(unique)), unique.T), shape=(n, n))
    pieces, label = connected_components(graph, directed=False)
    if pieces > 1:
        sizes = np.bincount(label).tolist()
        raise MeshError(f"the sheet is in {pieces} pieces of {sizes} vertices; it must be one connected piece.")
