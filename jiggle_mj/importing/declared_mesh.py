"""The mesh that recording.toml declares: measured triangles, or the sheet's continuation beyond the view."""

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from ..errors import RecordingError
from ..mesh_checks import check_mesh
from ..observation import DeclaredMesh
from ..sheet_triangulation import CLEARANCE, SheetPlane, extend, fill_outline, triangulate
from .data_folder import DataFolder
from .faces import read_faces
from .recording_toml import Extension, Margin, MeasuredRecording
from .sheet_outline import sheet_outline

MAX_EDGE_SPACINGS = 2.5
"""Longest edge of a triangle that is not declared [spacings]: it bridges one missing row of points, but not two."""


def declared_mesh(
    folder: DataFolder, given: MeasuredRecording, rest: Float[np.ndarray, "n 3"], notes: list[str]
) -> DeclaredMesh | None:
    """Return the mesh that recording.toml declares; None where it declares none.

    Raises:
        RecordingError: faces cannot be read, or the continuation does not fit the points.
        MeshError: the triangles are not one sheet.
    """
    if given.faces is None and given.extension is None and given.margin is None:
        return None
    rows, faces = np.flatnonzero(np.isfinite(rest).all(axis=1)), None
    if given.faces is not None:
        rows, faces = _seen_faces(rest, read_faces(folder, given, rest, notes))
        check_mesh(rest[rows], faces)
    if given.extension is not None:
        return _extended(rest, rows, faces, given.extension)
    if given.margin is not None:
        return _with_margin(rest, rows, faces, given.margin)
    assert faces is not None
    return DeclaredMesh(vertices=rest[rows], faces=faces, track_id=rows)


def _seen_faces(
    rest: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, "g 3"]]:
    """Return the rows with triangles, and the triangles renumbered to them; those with an unseen corner are dropped."""
    if faces.size == 0 or faces.min() < 0 or faces.max() >= len(rest):
        check_mesh(rest, faces)
    faces = faces[np.isfinite(rest[faces]).all(axis=(1, 2))]
    rows, renumbered = np.unique(faces, return_inverse=True)
    return rows, renumbered.reshape(faces.shape)


def _extended(
    rest: Float[np.ndarray, "n 3"],
    rows: Int[np.ndarray, " m"],
    faces: Int[np.ndarray, "f 3"] | None,
    extension: Extension,
) -> DeclaredMesh:
    """Return the measured points and their continuation, triangulated anew in the orientation of the measured faces."""
    plane = SheetPlane.through(rest[rows], extension.axis)
    flat = plane.flatten(rest[rows])
    begin, end = sorted((plane.along(extension.begin), plane.along(extension.end)))
    added = extend(flat, begin=begin, end=end, spacing=extension.spacing)
    vertices = np.concatenate([rest[rows], plane.raise_up(added)])
    spacing = max(extension.spacing, spacing_of(flat))
    new_faces = _triangulated(plane, np.concatenate([flat, added]), spacing, rest[rows], faces)
    held = None
    if extension.held_beyond is not None:
        held = plane.beyond(vertices, extension.held_beyond)
        if not held.any():
            raise RecordingError(
                f"[mesh.extend] held_beyond = {extension.held_beyond} lies outside the sheet, which reaches from "
                f"{extension.begin} to {extension.end}."
            )
    check_mesh(vertices, new_faces)
    track = np.concatenate([rows, np.full(len(added), -1)])
    return DeclaredMesh(vertices=vertices, faces=new_faces, track_id=track, held=held)


def _with_margin(
    rest: Float[np.ndarray, "n 3"],
    rows: Int[np.ndarray, " m"],
    faces: Int[np.ndarray, "f 3"] | None,
    margin: Margin,
) -> DeclaredMesh:
    """Return the measured points and the sheet around them, triangulated anew in the orientation of given faces."""
    plane = SheetPlane.through(rest[rows])
    flat = plane.flatten(rest[rows])
    spacing = spacing_of(flat) if margin.spacing is None else margin.spacing
    outline = sheet_outline(plane, flat, margin, spacing=spacing_of(flat))
    added = fill_outline(flat, outline=outline, spacing=spacing, clearance=CLEARANCE * max(spacing, spacing_of(flat)))
    if not len(added):
        raise RecordingError(f"[mesh] margin or outline adds no vertex at a spacing of {spacing:.3g} m; lower spacing.")
    new_faces = _triangulated(plane, np.concatenate([flat, added]), max(spacing, spacing_of(flat)), rest[rows], faces)
    vertices = np.concatenate([rest[rows], plane.raise_up(added)])
    track = np.concatenate([rows, np.full(len(added), -1)])
    used, renumbered = np.unique(new_faces, return_inverse=True)
    new_faces = renumbered.reshape(-1, 3)
    check_mesh(vertices[used], new_faces)
    return DeclaredMesh(vertices=vertices[used], faces=new_faces, track_id=track[used])


def spacing_of(flat: Float[np.ndarray, "m 2"]) -> float:
    """Return the median distance between nearest neighbours [m]."""
    return float(np.median(KDTree(flat).query(flat, k=2)[0][:, 1]))


def _triangulated(
    plane: SheetPlane,
    flat: Float[np.ndarray, "v 2"],
    spacing: float,
    measured: Float[np.ndarray, "m 3"],
    faces: Int[np.ndarray, "f 3"] | None,
) -> Int[np.ndarray, "g 3"]:
    """Return triangles of vertices in the plane, in the orientation of the measured faces where there are any."""
    new_faces = triangulate(flat, MAX_EDGE_SPACINGS * spacing)
    if faces is not None and _upward(plane, measured, faces) < 0:
        return new_faces[:, ::-1].copy()
    return new_faces


def _upward(plane: SheetPlane, vertices: Float[np.ndarray, "m 3"], faces: Int[np.ndarray, "f 3"]) -> float:
    """Return twice the triangles' signed area, positive where they face along the plane's upward axis [m^2]."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return float((np.cross(b - a, c - a) @ plane.axes[2]).sum())
