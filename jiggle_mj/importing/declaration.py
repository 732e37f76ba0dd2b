"""`recording.toml`: what the user says of a folder of measured data. The format is in docs/RECORDINGS.md.

Checks keys and kinds only; whether the files bear it out is found in `importing`. Lengths are in metres except in the
data files themselves, whose unit the file declares.
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
from ..toml_kinds import StrictTable

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}


@dataclass(frozen=True, kw_only=True)
class PointFiles:
    """Where the tracked points are."""

    files: tuple[str, ...]
    """Names or patterns, in the order of time; one .npz holds all frames."""
    key: str | None = None
    """Array of the .npz, shape (frames, points, 3)."""
    times: str | None = None
    """Array of the .npz, shape (frames,): when each was taken [s]; None for one every period."""
    runs: str | None = None
    """Array of the .npz, shape (frames,): whole numbers that change where another grasp begins; None for one grasp."""
    columns: tuple[int, ...] = (0, 1, 2)
    """Columns of x, y, z in a text file, from 0."""
    rest: int = 0
    """Number of the rest frame among all, from 0; it is written first."""


@dataclass(frozen=True, kw_only=True)
class WorldFrame:
    """world = rotation @ given + translation, after the unit."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, " 3"]
    """[m]."""


@dataclass(frozen=True, kw_only=True)
class Rows:
    """Some of the points, by number."""

    rows: tuple[int, ...] = ()
    file: str | None = None
    """Numbers separated by blanks or commas."""
    first: int = 0
    """The number that means the first row."""


@dataclass(frozen=True, kw_only=True)
class GraspPath:
    """A straight pull by an instrument that nobody measured."""

    start: Float[np.ndarray, " 3"]
    """Tip at the rest frame, world [m]."""
    direction: Float[np.ndarray, " 3"]
    """Of unit length."""
    step: float
    """Advance from frame to frame [m]."""


@dataclass(frozen=True, kw_only=True)
class ReportedTool:
    """An instrument that reported where it was, at times of its own."""

    tool: str
    """Array of the .npz, shape (reports, 3), in the points' unit and frame."""
    times: str
    """Array of the .npz, shape (reports,), rising [s]."""
    turns: str | None
    """Array of the .npz, shape (reports, 4): quaternions, w first, in the points' frame; None where it never turns."""
    rows: Rows
    """Points that it holds."""
    after: float
    """How long each run shows the sheet at rest before the jaws count as closed [s]."""


@dataclass(frozen=True, kw_only=True)
class Extension:
    """How far the sheet goes on beyond the measured points, along an axis; stations are world coordinates [m]."""

    axis: Float[np.ndarray, " 3"]
    """Of unit length, in the sheet."""
    begin: float
    end: float
    spacing: float
    """[m]."""
    held_beyond: float | None = None
    """Vertices farther out than this station are in the grip."""


@dataclass(frozen=True, kw_only=True)
class MeasuredRecording:
    """All that a recording.toml says."""

    name: str
    source: str
    unit: float
    """Metres in one unit of the data."""
    period: int | None
    """Time from frame to frame [ns]; None where the points have times."""
    noise_sd: float
    """Stated standard deviation of each coordinate [m]."""
    points: PointFiles
    frame: WorldFrame
    faces: str | None
    """Key of the .npz, or a text file; None for none."""
    first_vertex: int
    """The number that means the first vertex in the faces."""
    extension: Extension | None
    grasp: Rows | GraspPath | ReportedTool
    grasp_radius: float
    """[m]."""
    attached: Rows | float | None
    """Truth for scoring: rows, or the station beyond which all is attached; None where nothing is known."""
    truth_details: dict[str, object]
    declaration: Declaration


def read_recording_toml(path: Path) -> MeasuredRecording:
    """Read a recording.toml.

    Raises:
        RecordingError: missing, not TOML, an unknown or missing key, a value of the wrong kind.
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
    points = _points(top.table("points"))
    faces = mesh.take("faces", kinds.text, "none")
    recording = MeasuredRecording(
        name=top.take("name", kinds.text),
        source=top.take("source", kinds.text, ""),
        unit=UNITS[unit],
        period=round(top.take("period", kinds.positive) * 1e9) if points.times is None else None,
        noise_sd=top.take("noise_sd", kinds.positive),
        points=points,
        frame=_frame(top.table("frame", optional=True)),
        faces=None if faces == "none" else faces,
        first_vertex=mesh.take("first_vertex", kinds.count, 0),
        extension=_extension(extend) if extend.given else None,
        grasp_radius=grasp.take("radius", kinds.positive, 2e-3),
        grasp=_grasp(grasp),
        attached=_attached(truth),
        truth_details=dict(truth.take("details", kinds.table, {})),
        declaration=_declaration(top.table("declaration", optional=True)),
    )
    for table in (mesh, extend, grasp, truth, top):
        table.refuse_unknown()
    if isinstance(recording.attached, float) and recording.extension is None:
        raise RecordingError(f"{truth.where} attached_beyond needs [mesh.extend], whose axis it is counted along.")
    if isinstance(recording.grasp, ReportedTool) and points.times is None:
        raise RecordingError(f"{grasp.where} tool has times, so the points must have some: give [points] times.")
    return recording


def _points(table: StrictTable) -> PointFiles:
    points = PointFiles(
        files=table.take("files", kinds.texts),
        key=table.take("key", kinds.text, None),
        columns=tuple(table.take("columns", kinds.counts, (0, 1, 2))),
        times=table.take("times", kinds.text, None),
        runs=table.take("runs", kinds.text, None),
        rest=table.take("rest", kinds.count, 0),
    )
    table.refuse_unknown()
    if not points.files or len(points.columns) != 3:
        raise RecordingError(f"{table.where} needs at least one file, and three columns for x, y, z.")
    if (points.key is not None) != points.files[0].endswith(".npz"):
        raise RecordingError(f"{table.where} key names the array of an .npz, and only that; files are {points.files}.")
    if points.key is None and (points.times or points.runs):
        raise RecordingError(f"{table.where} times and runs name arrays of an .npz; files are {points.files}.")
    if points.times and points.rest:
        raise RecordingError(f"{table.where} rest must be 0 where frames have times; got {points.rest}.")
    if points.runs and not points.times:
        raise RecordingError(f"{table.where} runs needs times.")
    return points


def _frame(table: StrictTable) -> WorldFrame:
    rotation = np.array(table.take("rotation", kinds.matrix, np.eye(3).tolist()))
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) or np.linalg.det(rotation) < 0:
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
            turns=table.take("tool_turns", kinds.text, None),
            rows=_some_rows(table),
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
    return _some_rows(table)


def _some_rows(table: StrictTable) -> Rows:
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


def _declaration(table: StrictTable) -> Declaration:
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
