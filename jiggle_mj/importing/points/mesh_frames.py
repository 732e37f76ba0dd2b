"""Frames of tracked points in meshes and clouds, one PLY, OBJ or PCD a frame."""

from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from ...errors import RecordingError
from ..data_folder import quoted
from .file_kinds import refuse_many
from .measured import Measured
from .mesh_files import read_obj, read_ply
from .missing_rule import AXES
from .pcd import read_pcd
from .points_table import PointFiles

OBJ_COLUMNS = (1, 2, 3)
"""Columns of x, y and z in the line of a vertex of an OBJ; naming them changes nothing."""


def read_mesh_frames(paths: list[Path], kind: Literal["ply", "obj", "pcd"], points: PointFiles) -> Measured:
    """Return the vertices of meshes, or the points of clouds.

    Raises:
        RecordingError: a file is damaged, the files differ in their number of points, or a key of text files is given.
    """
    columns = None if kind == "obj" and points.columns == OBJ_COLUMNS else points.columns
    if columns is not None or points.displacements or points.format or points.separator or points.decimal:
        raise RecordingError(
            f"{paths[0]} is read as {kind.upper()}, whose vertices are the points: leave out columns, displacements, "
            "format, separator and decimal."
        )
    rule = None if points.missing is None or points.missing.column is None else points.missing.column
    if rule is not None and rule not in AXES:
        raise RecordingError(f"[points] missing names '{quoted(rule)}'; in {kind.upper()} files it may name x, y or z.")
    first = _vertices(paths[0], kind)
    refuse_many(len(paths), len(first))
    frames = [first, *(_vertices(path, kind) for path in paths[1:])]
    for path, frame in zip(paths, frames, strict=True):
        if len(frame) != len(frames[0]):
            raise RecordingError(
                f"the frames differ in their number of points: {paths[0].name} has {len(frames[0])}, {path.name} has "
                f"{len(frame)}; vertex i must be the same point in every file."
            )
    positions = np.stack(frames)
    return Measured(
        positions=positions,
        rule_values=None if rule is None else positions[:, :, AXES.index(rule)],
        names=[path.name for path in paths],
        notes=[f"points are the vertices of {len(paths)} {kind.upper()} files"],
    )


def _vertices(path: Path, kind: Literal["ply", "obj", "pcd"]) -> Float[np.ndarray, "n 3"]:
    if kind == "pcd":
        return read_pcd(path)
    return (read_ply(path) if kind == "ply" else read_obj(path)).vertices
