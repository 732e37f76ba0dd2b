"""`recording.toml`: the user's description of a folder of measured data. The format is in docs/RECORDINGS.md.

Checks keys and kinds of values only; `folder` compares them with the data files. Lengths are in metres except in the
data files, whose unit the description gives.
"""

import tomllib
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from .. import toml_kinds as kinds
from ..errors import RecordingError
from ..observation import Declaration
from ..recording.schemas import NS_PER_S
from ..toml_kinds import StrictTable
from .points.points_table import PointFiles, read_points_table

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
"""Metres in one unit of the data files."""
MAX_ROTATION_ERROR = 1e-6
"""Largest entry of R R^T - 1 of a rotation: the rounding of six decimals."""
DEFAULT_GRASP_RADIUS = 2e-3
"""Radius of the grip where none is given [m]; without effect where rows or vertices are declared held."""


@dataclass(frozen=True, kw_only=True)
class WorldFrame:
    """Transform of the data to the world: world = rotation @ data [m] + translation."""

    rotation: Float[np.ndarray, "3 3"]
    """Rotation matrix from the data to the world."""
    translation: Float[np.ndarray, " 3"]
    """Origin of the data in the world [m]."""


@dataclass(frozen=True, kw_only=True)
class Rows:
    """A choice of points by their row numbers."""

    rows: tuple[int, ...] = ()
    """Row numbers, where no file is given."""
    file: str | None = None
    """Text file of row numbers, separated by blanks or commas."""
    first: int = 0
    """Number of the first row."""


@dataclass(frozen=True, kw_only=True)
class GraspPath:
    """A straight pull by an instrument whose position was not measured."""

    start: Float[np.ndarray, " 3"]
    """Position of the tip at the rest frame, in the world [m]."""
    direction: Float[np.ndarray, " 3"]
    """Unit vector of the pull in the world."""
    step: float
    """Displacement from frame to frame [m]."""


@dataclass(frozen=True, kw_only=True)
class ReportedTool:
    """An instrument that reported its position, at times of its own."""

    tool: str
    """Name of the positions in the .npz, shape (reports, 3), in the unit and frame of the points."""
    times: str
    """Name of the reports' times in the .npz, shape (reports,), increasing [s]."""
    orientations: str | None
    """Name of the quaternions wxyz in the .npz, shape (reports, 4), in the frame of the points; None where the
    orientation is constant."""
    rows: Rows
    """Points that the instrument holds."""
    after: float
    """Time from the start of each run at which the jaws close; the sheet is at rest before [s]."""


@dataclass(frozen=True, kw_only=True)
class Extension:
    """Continuation of the sheet beyond the measured points, along an axis; stations are world coordinates [m]."""

    axis: Float[np.ndarray, " 3"]
    """Unit vector in the sheet."""
    begin: float
    """Station at which the sheet begins [m]."""
    end: float
    """Station at which the sheet ends [m]."""
    spacing: float
    """Spacing of the added vertices [m]."""
    held_beyond: float | None = None
    """Station beyond which the jaws hold the vertices [m]; None where no vertex is declared held."""


@dataclass(frozen=True, kw_only=True)
class MeasuredRecording:
    """Contents of a recording.toml."""

    name: str
    """Name of the recording."""
    source: str
    """Where the data come from; empty where not given."""
    unit: float
    """Metres in one unit of the data files."""
    period: int | None
    """Time from frame to frame [ns]; None where the frames have times."""
    noise_sd: float
    """Standard deviation of each coordinate's noise [m]."""
    points: PointFiles
    """The files of the tracked points."""
    frame: WorldFrame
    """Transform of the data to the world."""
    faces: str | None
    """Name of the triangles in the .npz, or a text file; None for no declared triangles."""
    first_vertex: int
    """Number of the first vertex in the triangles."""
    extension: Extension | None
    """Continuation of the sheet; None for none."""
    grasp: Rows | GraspPath | ReportedTool
    """What gives the position of the tool: grasped points, a straight path, or its own reports."""
    grasp_radius: float
    """Radius of the grip [m]."""
    attached: Rows | float | None
    """Truth for scoring: rows, or the station beyond which all is attached; None where the truth is unknown."""
    truth_details: dict[str, object]
    """Further entries for the truth file."""
    declaration: Declaration
    """The user's prior knowledge of the tissue."""


def read_recording_toml(path: Path) -> MeasuredRecording:
    """Read a recording.toml and return its contents.

    Raises:
        RecordingError: the file is missing or no TOML, a key is unknown or missing, or a value is of the wrong kind.
    """
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as failure:
        raise RecordingError(f"{path} cannot be read: {failure}.") from failure
    try:
        top = StrictTable(tomllib.loads(text), str(path))
    except tomllib.TOMLDecodeError as failure:
        raise RecordingError(f"{path} is not TOML: {failure}.") from failure
    return _recording(top)


def _recording(top: StrictTable) -> MeasuredRecording:
    unit = top.take("unit", kinds.text)
    if unit not in UNITS:
        raise RecordingError(f"{top.where} unit must be one of {', '.join(UNITS)}; got '{unit}'.")
    mesh, grasp = top.table("mesh", optional=True), top.table("grasp")
    truth, extend = top.table("truth", optional=True), mesh.table("extend", optional=True)
    points = read_points_table(top.table("points"))
    faces = mesh.take("faces", kinds.text, "none")
    recording = MeasuredRecording(
        name=top.take("name", kinds.text),
        source=top.take("source", kinds.text, ""),
        unit=UNITS[unit],
        period=round(top.take("period", kinds.positive) * NS_PER_S) if points.times is None else None,
        noise_sd=top.take("noise_sd", kinds.positive),
        points=points,
        frame=_frame(top.table("frame", optional=True)),
        faces=None if faces == "none" else faces,
        first_vertex=mesh.take("first_vertex", kinds.count, 0),
        extension=_extension(extend) if extend.given else None,
        grasp_radius=grasp.take("radius", kinds.positive, DEFAULT_GRASP_RADIUS),
        grasp=_grasp(grasp),
        attached=_attached(truth),
        truth_details=dict(truth.take("details", kinds.table, {})),
        declaration=parse_declaration_table(top.table("declaration", optional=True)),
    )
    for table in (mesh, extend, grasp, truth, top):
        table.refuse_unknown()
    if isinstance(recording.attached, float) and recording.extension is None:
        raise RecordingError(f"{truth.where} attached_beyond needs [mesh.extend], whose axis gives its direction.")
    if isinstance(recording.grasp, ReportedTool) and points.times is None:
        raise RecordingError(
            f"{grasp.where} tool has times, so the frames need times on the same clock: give [points] times."
        )
    return recording


def _frame(table: StrictTable) -> WorldFrame:
    rotation = np.array(table.take("rotation", kinds.matrix, np.eye(3).tolist()))
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=MAX_ROTATION_ERROR) or np.linalg.det(rotation) < 0:
        raise RecordingError(f"{table.where} rotation is not a rotation: {rotation.tolist()}.")
    translation = np.array(table.take("translation", kinds.vector, [0.0, 0.0, 0.0]))
    table.refuse_unknown()
    return WorldFrame(rotation=rotation, translation=translation)


def _extension(table: StrictTable) -> Extension:
    extension = Extension(
        axis=table.direction("axis"),
        begin=table.take("begin", kinds.number),
        end=table.take("end", kinds.number),
        spacing=table.take("spacing", kinds.positive),
        held_beyond=table.take("held_beyond", kinds.number, None),
    )
    if not extension.begin < extension.end:
        raise RecordingError(f"{table.where} begin must be below end; got {extension.begin}, {extension.end}.")
    return extension


def _grasp(table: StrictTable) -> Rows | GraspPath | ReportedTool:
    if "tool" in table.values:
        return ReportedTool(
            tool=table.take("tool", kinds.text),
            times=table.take("tool_times", kinds.text),
            orientations=table.take("tool_turns", kinds.text, None),
            rows=_required_rows(table),
            after=table.take("after", kinds.number, 0.0),
        )
    table.known |= {"tool", "tool_times", "tool_turns", "after"}
    if "start" in table.values:
        return GraspPath(
            start=np.array(table.take("start", kinds.vector)),
            direction=table.direction("direction"),
            step=table.take("step", kinds.number),
        )
    table.known |= {"start", "direction", "step"}
    return _required_rows(table)


def _required_rows(table: StrictTable) -> Rows:
    rows = _rows(table, "rows")
    if rows is None:
        raise RecordingError(f"{table.where} needs rows or rows_file, or start, direction and step.")
    return rows


def _attached(table: StrictTable) -> Rows | float | None:
    beyond, rows = table.take("attached_beyond", kinds.number, None), _rows(table, "attached_rows")
    if beyond is not None and rows is not None:
        raise RecordingError(f"{table.where} has both attached_beyond and attached_rows; give one.")
    return rows if beyond is None else float(beyond)


def _rows(table: StrictTable, name: str) -> Rows | None:
    rows, file = table.take(name, kinds.counts, None), table.take(f"{name}_file", kinds.text, None)
    first = table.take(f"{name}_first", kinds.count, 0)
    if rows is not None and file is not None:
        raise RecordingError(f"{table.where} has both {name} and {name}_file; give one.")
    return None if rows is None and file is None else Rows(rows=tuple(rows or ()), file=file, first=first)


def parse_declaration_table(table: StrictTable) -> Declaration:
    """Return the declaration in a `[declaration]` table.

    Raises:
        RecordingError: an unknown key, a value of the wrong kind, or one that `Declaration` refuses.
    """
    allowed: dict[str, Callable[[Any], Any]] = {f.name: kinds.number for f in fields(Declaration) if f.name != "mesh"}
    allowed |= {"gravity": kinds.vector, "bed": kinds.flag}
    values = {name: table.take(name, kind) for name, kind in allowed.items() if name in table.values}
    table.known |= set(allowed)
    table.refuse_unknown()
    if "gravity" in values:
        values["gravity"] = tuple(values["gravity"])
    try:
        return Declaration(**values)
    except ValueError as failure:
        raise RecordingError(f"{table.where} {failure}") from failure
