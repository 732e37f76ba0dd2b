"""Declared triangles of measured data, whose corners are rows of the points.

The vertices of a mesh file need not be in the order of the points: they are matched by place where they are not.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, Shaped
from scipy.spatial import KDTree

from ..errors import RecordingError
from .data_folder import DataFolder
from .points.archives import read_array
from .points.file_kinds import file_kind
from .points.mesh_files import MeshFile, read_obj, read_ply
from .points.text_lines import read_lines
from .points.text_table import TextTable
from .recording_toml import MeasuredRecording

MAX_MATCH_SPACINGS = 0.5
"""Distance of a vertex from its point, in spacings of the vertices: beyond it another vertex may be nearer."""
SAME_ORDER_SHARE = 0.9
"""Share of the points that are so near to the vertex of their own number where the order is the same."""
MAX_EDGE_ERROR = 0.1
"""Relative difference of lengths, up to one scale, by which the median edge of a mesh is still that of the points."""
FAR_EDGE_SHARE, FAR_EDGE_POINTS = 0.25, 30
"""Share of the sheet's diagonal that the median edge of so many points or more cannot have: points at random have a
third."""
LARGEST_NUMBER = 2**31
"""Vertex number above which a number is none."""


def read_faces(
    folder: DataFolder, given: MeasuredRecording, rest: Float[np.ndarray, "n 3"], notes: list[str]
) -> Int[np.ndarray, "f 3"]:
    """Return the declared triangles by the points' rows, from 0.

    Args:
        folder: folder of the data files.
        given: contents of the recording.toml; its `faces` name an array of the points' archive, a text file, an .npy,
            or a PLY or OBJ mesh, which itself says how it counts its vertices.
        rest: positions of the points at rest, in the world [m].
        notes: receives a line where vertices are matched by place.

    Raises:
        RecordingError: the array or file is missing or malformed, or its corners are not the points.
    """
    assert given.faces is not None
    archive = folder / given.points.files[0] if given.points.key is not None else None
    if archive is not None and not (folder / given.faces).is_file():
        faces = _whole(read_array(archive, given.faces), f"{archive}: {given.faces}") - given.first_vertex
        return _refuse_far(rest, faces, given)
    path = folder / given.faces
    kind = file_kind(path)
    if kind in ("ply", "obj"):
        mesh = read_ply(path) if kind == "ply" else read_obj(path)
        vertices = mesh.vertices * given.unit @ given.frame.rotation.T + given.frame.translation
        return _by_rows(path, MeshFile(vertices=vertices, faces=mesh.faces), rest, notes)
    if kind == "text":
        table = TextTable.open(read_lines(path), columns=None, given=(None, None), known=None)
        if table.width != 3:
            raise RecordingError(f"{path} has {table.width} columns; faces are three vertex numbers a row.")
        numbers = table.read((0, 1, 2))
    else:
        numbers = read_array(path, None)
    return _refuse_far(rest, _whole(numbers, str(path)) - given.first_vertex, given)


def _whole(table: Shaped[np.ndarray, "..."], where: str) -> Int[np.ndarray, "f 3"]:
    whole = table.ndim == 2 and table.shape[1] == 3 and np.isfinite(table).all() and (table == np.round(table)).all()
    if not whole or (np.abs(table.astype(np.float64)) > LARGEST_NUMBER).any():
        raise RecordingError(f"{where} must hold faces, three whole numbers a row; it has shape {table.shape}.")
    return table.astype(np.int64)


def _by_rows(path: Path, mesh: MeshFile, rest: Float[np.ndarray, "n 3"], notes: list[str]) -> Int[np.ndarray, "f 3"]:
    """Return the triangles of a mesh by the points' rows; triangles at vertices that are not seen at rest are left out.

    Raises:
        RecordingError: the mesh has no triangles, or its vertices are not the points.
    """
    vertices, faces = mesh.vertices, mesh.faces
    if not len(faces):
        raise RecordingError(f"{path} has no faces; [mesh] faces needs triangles.")
    if faces.min() < 0 or faces.max() >= len(vertices) or not np.isfinite(vertices).all():
        raise RecordingError(f"{path}: a face names a vertex that is not among its {len(vertices)}, or is not finite.")
    seen = np.flatnonzero(np.isfinite(rest).all(axis=1))
    spacing = float(np.median(KDTree(vertices).query(vertices, k=2)[0][:, 1])) if len(vertices) > 1 else 0.0
    farthest = MAX_MATCH_SPACINGS * spacing
    if len(vertices) == len(rest):
        apart = np.linalg.norm(vertices[seen] - rest[seen], axis=1)
        if np.quantile(apart, SAME_ORDER_SHARE) <= farthest:
            return faces
    distance, nearest = KDTree(vertices).query(rest[seen])
    matched = len(np.unique(nearest)) == len(seen) and float(np.max(distance)) <= farthest
    if not matched and len(vertices) == len(rest) and _same_edges(vertices, rest, faces):
        return faces
    if not matched or len(vertices) > len(rest):
        raise RecordingError(
            f"{path} has {len(vertices)} vertices, which are not the {len(rest)} points: the farthest point is "
            f"{np.max(distance):.3g} m from any, and at most {farthest:.3g} m, half a spacing, is a match. Vertex i "
            "must be row i, or lie where one point is at rest, in the same unit and frame."
        )
    notes.append(f"vertices of {path.name} are matched to the points by place, {np.max(distance):.2g} m apart at most")
    row = np.full(len(vertices), -1)
    row[nearest] = seen
    by_rows = row[faces]
    return by_rows[(by_rows >= 0).all(axis=1)]


def _same_edges(
    vertices: Float[np.ndarray, "n 3"], rest: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]
) -> bool:
    """Return whether the edges have the lengths that they have between the points, up to one scale: another frame."""
    theirs, ours = _edges(vertices, faces), _edges(rest, faces)
    both = np.isfinite(ours) & (theirs > 0)
    scale = float(np.median(ours[both] / theirs[both])) if both.any() else 0.0
    return scale > 0 and bool(np.median(np.abs(ours[both] / theirs[both] / scale - 1)) < MAX_EDGE_ERROR)


def _refuse_far(
    rest: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"], given: MeasuredRecording
) -> Int[np.ndarray, "f 3"]:
    """Return triangles, which must not join points that are far apart; numbers out of range are for the mesh's check.

    Raises:
        RecordingError: the median edge is a large share of the sheet.
    """
    if len(faces) and faces.max() == len(rest) and faces.min() > 0:
        raise RecordingError(
            f"[mesh] faces '{given.faces}' number the vertices up to {faces.max() + given.first_vertex}, with "
            f"{len(rest)} points: they probably count from {given.first_vertex + 1}; give first_vertex = "
            f"{given.first_vertex + 1} in [mesh]."
        )
    if len(rest) < FAR_EDGE_POINTS or not len(faces) or faces.min() < 0 or faces.max() >= len(rest):
        return faces
    finite = rest[np.isfinite(rest).all(axis=1)]
    diagonal, edges = float(np.linalg.norm(np.ptp(finite, axis=0))), _edges(rest, faces)
    edges = edges[np.isfinite(edges)]
    if len(edges) and np.median(edges) > FAR_EDGE_SHARE * diagonal:
        raise RecordingError(
            f"[mesh] faces '{given.faces}' join points that are far apart: half of the edges are longer than "
            f"{np.median(edges):.3g} m on a sheet of {diagonal:.3g} m. Are the rows of the points those that the faces "
            f"number, from first_vertex = {given.first_vertex}?"
        )
    return faces


def _edges(points: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]) -> Float[np.ndarray, " e"]:
    """Return the lengths of the triangles' edges."""
    corners = points[faces]
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).ravel()
