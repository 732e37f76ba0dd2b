"""Triangulations of the sheet, and the checks that each of them must pass.

`equilateral` is a triangular lattice with straight edges, its rows offset by half a triangle. `unstructured` jitters
the inner vertices of that lattice and triangulates them again (Delaunay, by scipy). There is no grid of right
triangles: its bending stiffness depends on the pattern.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import Delaunay

from jiggle_mj.errors import MeshError
from jiggle_mj.mesh_checks import check_mesh

JITTER = 0.22
"""Largest displacement of an inner vertex of the unstructured mesh, in edge lengths."""
MINIMUM_HEIGHT = 0.1
"""Smallest height of a triangle over its longest edge; needles make the shell's stiffness ill-conditioned."""
ROW_HEIGHT = np.sqrt(0.75)
"""Height of an equilateral triangle over its edge."""
BOUNDARY_MARGIN = 1e-9
"""Distance from the rectangle's edge up to which a vertex lies on it [m]; rounding is smaller."""
FLAT_AREA = 1e-3
"""Share of the median area below which a triangle is flat: Delaunay leaves such triangles on collinear edges."""


@dataclass(frozen=True, kw_only=True)
class Triangulation:
    """A flat sheet at rest, triangles counter-clockwise seen from above."""

    vertices: Float[np.ndarray, "n 2"]
    """Tissue coordinates [m]."""
    faces: Int[np.ndarray, "f 3"]
    """Vertices of each triangle."""

    def vertex_areas(self) -> Float[np.ndarray, " n"]:
        """Return a third of the area of the triangles around each vertex [m^2]."""
        areas = np.zeros(len(self.vertices))
        np.add.at(areas, self.faces, (triangle_areas(self.vertices, self.faces) / 3)[:, None])
        return areas

    def outline(self) -> Bool[np.ndarray, " n"]:
        """Return which vertices lie on the outer edge: on an edge that belongs to one triangle only."""
        edges = np.sort(self.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        single, times = np.unique(edges, axis=0, return_counts=True)
        return np.isin(np.arange(len(self.vertices)), single[times == 1])


def triangle_areas(vertices: Float[np.ndarray, "n 2"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, " f"]:
    """Return the signed area of each triangle, positive if counter-clockwise [m^2]."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return 0.5 * ((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]))


def lattice(size: tuple[float, float], spacing: float) -> Float[np.ndarray, "n 2"]:
    """Return offset rows of points over a rectangle around the origin, including its corners and edges [m]."""
    columns = max(round(size[0] / spacing), 2)
    dx = size[0] / columns
    rows = max(round(size[1] / (dx * ROW_HEIGHT)), 2)
    even = np.linspace(-size[0] / 2, size[0] / 2, columns + 1)
    odd = np.concatenate([even[:1], (even[1:] + even[:-1]) / 2, even[-1:]])
    heights = np.linspace(-size[1] / 2, size[1] / 2, rows + 1)
    return np.concatenate([[(x, y) for x in (odd if row % 2 else even)] for row, y in enumerate(heights)])


def triangulate(vertices: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "f 3"]:
    """Return the Delaunay triangles, counter-clockwise, without the flat ones on collinear edges."""
    faces = Delaunay(vertices).simplices.astype(np.int64)
    areas = triangle_areas(vertices, faces)
    faces[areas < 0] = faces[areas < 0][:, ::-1]
    return faces[np.abs(areas) > FLAT_AREA * np.median(np.abs(areas))]


def build_sheet(*, size: tuple[float, float], spacing: float, kind: str, seed: int) -> Triangulation:
    """Return a rectangular sheet [m]; `kind` is `equilateral` or `unstructured`, `seed` draws the latter.

    Raises:
        MeshError: the size and spacing give a triangle that `check_sheet` refuses.
    """
    vertices = lattice(size, spacing)
    if kind == "unstructured":
        inner = np.all(np.abs(vertices) < np.array(size) / 2 - BOUNDARY_MARGIN, axis=1)
        draw = np.random.default_rng(seed).uniform(-1.0, 1.0, (int(inner.sum()), 2))
        vertices[inner] += JITTER * spacing * draw / np.sqrt(2.0)
    sheet = Triangulation(vertices=vertices, faces=triangulate(vertices))
    check_sheet(sheet.vertices, sheet.faces)
    return sheet


def check_sheet(vertices: Float[np.ndarray, "n 2"], faces: Int[np.ndarray, "f 3"]) -> None:
    """Refuse a mesh that MuJoCo cannot use as a shell: `check_mesh`, and no slender or inverted triangles.

    Raises:
        MeshError: the mesh is refused; the message names the first triangle at fault.
    """
    check_mesh(np.column_stack([vertices, np.zeros(len(vertices))]), faces)
    areas = triangle_areas(vertices, faces)
    inverted = np.flatnonzero(areas < 0)
    if inverted.size:
        raise MeshError(
            f"{inverted.size} inverted triangles, the first is {inverted[0]} with vertices "
            f"{faces[inverted[0]].tolist()}: list the vertices counter-clockwise seen from above."
        )
    edges = np.stack([vertices[faces[:, k]] - vertices[faces[:, k - 1]] for k in range(3)])
    height = 2 * areas / np.linalg.norm(edges, axis=2).max(axis=0) ** 2
    if height.min() < MINIMUM_HEIGHT:
        worst = int(height.argmin())
        raise MeshError(
            f"triangle {worst} with vertices {faces[worst].tolist()} is degenerate: its height is {height[worst]:.3g} "
            f"of its longest edge, at least {MINIMUM_HEIGHT} is needed; merge its vertices or move them apart."
        )
