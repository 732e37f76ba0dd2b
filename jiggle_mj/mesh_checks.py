"""Checks that a triangle mesh is one sheet on which a membrane can be computed.

Checks connectivity and areas, and that the sheet at rest is not folded: seen from above, no triangle faces down. Does
not check the quality of angles, which the solvers tolerate.
"""

import numpy as np
from jaxtyping import Float, Int, Shaped
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from .errors import MeshError

MINIMUM_RELATIVE_AREA = 1e-6
"""Twice a triangle's area over its longest edge squared, below which it has no usable normal in float32."""
STEEP_COSINE = 0.2
"""Cosine between a triangle's normal and the sheet's below which the triangle stands on edge."""
MAX_STEEP_SHARE = 0.05
"""Share of triangles on edge that a rough sheet may have."""
MAX_LISTED_SHEETS = 5
"""How many disconnected sheets an error lists with their sizes."""


def check_mesh(vertices: Shaped[np.ndarray, "..."], faces: Shaped[np.ndarray, "..."]) -> None:
    """Refuse a mesh that is not one consistently oriented sheet of triangles with area.

    Args:
        vertices: positions [m]; must have shape (n, 3).
        faces: vertex numbers of each triangle, from 0; must be integers of shape (f, 3).

    Raises:
        MeshError: no triangles, wrong shapes, vertices that are not finite, vertex numbers out of range, a vertex
            twice in one triangle, a triangle without area, triangles that overlap or are turned over against their
            neighbours, edges of three triangles, vertices without a triangle, several pieces.
    """
    vertices, faces = np.asarray(vertices), np.asarray(faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise MeshError(f"mesh vertices must have shape (n, 3); got {vertices.shape}.")
    if faces.ndim != 2 or faces.shape[1] != 3 or not np.issubdtype(faces.dtype, np.integer):
        raise MeshError(f"mesh faces must be integers of shape (f, 3); got {faces.dtype} {faces.shape}.")
    if len(faces) == 0:
        raise MeshError("the mesh has no triangles.")
    _check_indices(len(vertices), faces)
    if not np.isfinite(vertices).all():
        bad = int(np.flatnonzero(~np.isfinite(vertices).all(axis=1))[0])
        raise MeshError(f"mesh vertex {bad} is not finite: {vertices[bad].tolist()}; leave unseen vertices out.")
    _check_areas(vertices, faces)
    _check_orientation(faces)
    _check_one_piece(len(vertices), faces)


def check_unfolded(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"], *, above: Float[np.ndarray, " 3"]
) -> None:
    """Refuse a rest shape that does not lie open when seen along the normal of its best-fit plane, `above`.

    Raises:
        MeshError: a triangle faces against the others, or more than `MAX_STEEP_SHARE` of them stand on edge: the sheet
            is folded, or touches itself.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    upright = normals @ above * np.sign(np.sum(normals @ above))
    flipped, steep = int(np.sum(upright < 0)), int(np.sum(np.abs(upright) < STEEP_COSINE))
    if flipped or steep > MAX_STEEP_SHARE * len(faces):
        raise MeshError(
            f"the sheet at rest is folded: seen along its normal, {flipped} of {len(faces)} triangles are turned over "
            f"and {steep} stand on edge. Spread the tissue before the first grasp, or declare a mesh of it spread."
        )


def _check_indices(n_vertices: int, faces: Int[np.ndarray, "f 3"]) -> None:
    outside = np.flatnonzero(((faces < 0) | (faces >= n_vertices)).any(axis=1))
    if outside.size:
        raise MeshError(
            f"mesh triangle {outside[0]} is {faces[outside[0]].tolist()}; vertex numbers must lie in "
            f"0..{n_vertices - 1} (counted from 0)."
        )
    ordered = np.sort(faces, axis=1)
    repeated = np.flatnonzero((ordered[:, 1:] == ordered[:, :-1]).any(axis=1))
    if repeated.size:
        raise MeshError(
            f"mesh triangle {repeated[0]} is degenerate: it names a vertex twice, {faces[repeated[0]].tolist()}."
        )


def _check_areas(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]) -> None:
    corners = vertices[faces]
    edges = corners - np.roll(corners, 1, axis=1)
    longest = (edges**2).sum(axis=2).max(axis=1)
    twice_area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    flat = np.flatnonzero(~(twice_area > MINIMUM_RELATIVE_AREA * longest))
    if flat.size:
        raise MeshError(
            f"mesh triangle {flat[0]} is degenerate: area {0.5 * twice_area[flat[0]]:.3g} m^2 with a longest edge of "
            f"{np.sqrt(longest[flat[0]]):.3g} m; {flat.size} of {len(faces)} triangles have no area."
        )


def _check_orientation(faces: Int[np.ndarray, "f 3"]) -> None:
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    owner = np.tile(np.arange(len(faces)), 3)
    _, undirected_count = np.unique(np.sort(directed, axis=1), axis=0, return_counts=True)
    if undirected_count.max() > 2:
        raise MeshError(f"a mesh edge belongs to {undirected_count.max()} triangles; a sheet has at most 2 at an edge.")
    _, first, inverse, count = np.unique(directed, axis=0, return_index=True, return_inverse=True, return_counts=True)
    if count.max() > 1:
        doubled = int(np.flatnonzero(count > 1)[0])
        second = np.flatnonzero(inverse.reshape(-1) == doubled)[1]
        raise MeshError(
            f"mesh triangles {owner[first[doubled]]} and {owner[second]} are inverted against each other along the "
            f"edge {directed[second].tolist()}; all triangles must run the same way round."
        )


def _check_one_piece(n_vertices: int, faces: Int[np.ndarray, "f 3"]) -> None:
    unused = np.setdiff1d(np.arange(n_vertices), faces)
    if unused.size:
        raise MeshError(f"mesh vertex {unused[0]} belongs to no triangle ({unused.size} of {n_vertices} do not).")
    rows, columns = faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(n_vertices, n_vertices))
    pieces, label = connected_components(graph, directed=False)
    if pieces > 1:
        sizes = np.bincount(label).tolist()[:MAX_LISTED_SHEETS]
        raise MeshError(f"the mesh has {pieces} disconnected sheets, of {sizes} vertices; give one sheet.")
