"""`recording.toml`: the user's description of a folder of measured data. The format is in docs/RECORDINGS.md.

Checks keys and kinds of values only; `folder` compares them with the data files. Lengths are in metres except in the
data files, whose unit the description gives.
"""

import json
import math
import os
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
from ..recording.stored_arrays import MAX_LENGTH_M
from ..toml_kinds import StrictTable
from .clock import MAX_PERIOD, MIN_PERIOD
from .data_folder import quoted
from .grasp_table import GraspTable, Rows, read_choice, read_grasps
from .points.points_table import PointFiles, read_points_table
from .points.text_lines import read_text
from .tool_force import GivenForce, read_force_table
from .units import LENGTH_UNITS, TIME_UNITS, unit_of

NOT_IN_TABLE = ("mesh", "effects")
"""Fields of a declaration that its table does not hold."""
MAX_ROTATION_ERROR = 2e-5
"""Largest entry of R R^T - 1 of a rotation: the rounding of five decimals."""
MAX_MARGIN_M = 10.0
"""Width of a margin [m]: no sheet that is estimated is larger."""
MAX_OUTLINE_POINTS = 1000
"""Corners that an outline may have."""


@dataclass(frozen=True, kw_only=True)
class WorldFrame:
    """Transform of the data to the world: world = rotation @ data [m] + translation."""

    rotation: Float[np.ndarray, "3 3"]
    """Rotation matrix from the data to the world."""
    translation: Float[np.ndarray, " 3"]
    """Origin of the data in the world [m]."""


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
class Margin:
    """Sheet beyond the view: up to a distance around the seen points, or up to an outline."""

    width: float | None
    """Width around the rectangle of the seen points [m]; None where an outline is given."""
    outline: Float[np.ndarray, "k 3"] | None
    """Corners of the sheet in the world [m], in turn; None where a width is given. z is NaN where it was left out."""
    spacing: float | None
    """Spacing of the added vertices [m]; None for that of the seen points."""


@dataclass(frozen=True, kw_only=True)
class Region:
    """A ball in the world."""

    at: Float[np.ndarray, " 3"]
    """Centre [m]."""
    radius: float
    """Radius [m]."""


@dataclass(frozen=True, kw_only=True)
class MeasuredRecording:
    """Contents of a recording.toml."""

    name: str
    """Name of the recording."""
    source: str
    """Where the data come from; empty where not given."""
    unit: float
    """Metres in one unit of the data files."""
    unit_name: str
    """That unit."""
    period: int | None
    """Time from frame to frame [ns]; None where the frames have times."""
    time_unit: int | None
    """Nanoseconds in one unit of the frames' times; None where it is not given, which means seconds."""
    noise_sd: float
    """Standard deviation of each coordinate's noise [m]."""
    smooth_sd: float
    """Standard deviation of the part of it that neighbours share [m]; 0 for none."""
    smooth_length: float | None
    """Distance over which they share it [m]; None for none."""
    points: PointFiles
    """The files of the tracked points."""
    frame: WorldFrame
    """Transform of the data to the world."""
    faces: str | None
    """Name of the triangles in the .npz, or a text file; None for no declared triangles."""
    first_vertex: int
    """Number of the first vertex in the triangles."""
    extension: Extension | None
    """Continuation of the sheet along an axis; None for none."""
    margin: Margin | None
    """Continuation of the sheet all around; None for none."""
    grasp: GraspTable
    """The grasps, and what gives the position of the tool."""
    force: GivenForce | None
    """The force on the tool; None where none was measured."""
    attached: Rows | Region | float | None
    """Truth for scoring: rows, a region, or the station beyond which all is attached; None where the truth is
    unknown."""
    truth_details: dict[str, object]
    """Further entries for the truth file."""
    declaration: Declaration
    """The user's prior knowledge of the tissue."""


def read_recording_toml(path: Path) -> MeasuredRecording:
    """Read a recording.toml and return its contents.

    Raises:
        RecordingError: the file is missing or no TOML, a key is unknown or missing, or a value is of the wrong kind.
    """
    if not os.path.lexists(path):
        raise RecordingError(
            f"{quoted(path)} is missing; it describes the data. Let 'jiggle-mj init {quoted(path.parent)}' write one, "
            "then check it."
        )
    text = read_text(path)
    try:
        top = StrictTable(tomllib.loads(text), str(path))
    except (ValueError, RecursionError) as failure:  # TOMLDecodeError, or a number of thousands of digits
        raise RecordingError(f"{path} is not TOML: {quoted(failure)}.") from failure
    return _recording(top)


def _noise(top: StrictTable) -> tuple[float, float, float | None]:
    """Return the noise of a coordinate, the part of it that neighbours share, and over which distance [m]."""
    if "point_sd" not in top.values:
        for key in ("smooth_sd", "smooth_length"):
            if key in top.values:
                raise RecordingError(
                    f"{top.where}: {key} needs point_sd, the noise that is independent from point to point, in place "
                    "of noise_sd, which is all noise together."
                )
        return top.take("noise_sd", kinds.positive), 0.0, None
    if "noise_sd" in top.values:
        raise RecordingError(f"{top.where}: noise_sd is all noise together, and point_sd a part of it; give one.")
    if "smooth_length" in top.values and "smooth_sd" not in top.values:
        raise RecordingError(f"{top.where}: smooth_length needs smooth_sd, the noise that neighbours share over it.")
    point_sd, smooth_sd = top.take("point_sd", kinds.positive), top.take("smooth_sd", kinds.not_negative, 0.0)
    length = top.take("smooth_length", kinds.positive) if smooth_sd else top.take("smooth_length", kinds.positive, None)
    return math.hypot(point_sd, smooth_sd), smooth_sd, length


def _recording(top: StrictTable) -> MeasuredRecording:
    unit = unit_of(top, "unit", LENGTH_UNITS)
    mesh, truth = top.table("mesh", optional=True), top.table("truth", optional=True)
    extend = mesh.table("extend", optional=True)
    points = read_points_table(top.table("points"))
    faces = mesh.take("faces", kinds.text, "none")
    noise_sd, smooth_sd, smooth_length = _noise(top)
    recording = MeasuredRecording(
        name=top.take("name", kinds.text),
        source=top.take("source", kinds.text, ""),
        unit=unit,
        unit_name=top.values["unit"],
        period=None if points.times is not None and "period" not in top.values else _period(top),
        time_unit=unit_of(top, "time_unit", TIME_UNITS) if "time_unit" in top.values else None,
        noise_sd=noise_sd,
        smooth_sd=smooth_sd,
        smooth_length=smooth_length,
        points=points,
        frame=_frame(top.table("frame", optional=True)),
        faces=None if faces == "none" else faces,
        first_vertex=mesh.take("first_vertex", kinds.count, 0),
        extension=_extension(extend) if extend.given else None,
        margin=_margin(mesh),
        grasp=read_grasps(top),
        force=read_force_table(top.table("force", optional=True)),
        attached=_attached(truth),
        truth_details=_details(truth),
        declaration=parse_declaration_table(top.table("declaration", optional=True)),
    )
    for table in (mesh, extend, truth, top):
        table.refuse_unknown()
    _refuse_contradictions(recording, str(top.where))
    return recording


def _refuse_contradictions(recording: MeasuredRecording, where: str) -> None:
    tool = recording.grasp.tool
    if recording.points.times is not None and recording.period is not None:
        raise RecordingError(
            f"{where} has both period and [points] times; the times say when the frames are: give one."
        )
    if isinstance(recording.attached, float) and recording.extension is None:
        raise RecordingError(f"{where} [truth] attached_beyond needs [mesh.extend], whose axis gives its direction.")
    if recording.extension is not None and recording.margin is not None:
        raise RecordingError(f"{where} has both [mesh.extend] and [mesh] margin or outline; give one.")
    if recording.period is not None and recording.time_unit is not None:
        raise RecordingError(f"{where} time_unit is that of [points] times, which is missing; period is in seconds.")
    if tool is not None and tool.times is not None and recording.points.times is None:
        raise RecordingError(
            f"{where} [grasp] tool has times, so the frames need times on the same clock: give [points] times."
        )


def _period(top: StrictTable) -> int:
    seconds = top.take("period", kinds.positive)
    if not MIN_PERIOD <= seconds <= MAX_PERIOD:
        raise RecordingError(
            f"{top.where} period is {seconds:g} s; from {MIN_PERIOD:g} to {MAX_PERIOD:g} s is allowed: is it in ms?"
        )
    return round(seconds * NS_PER_S)


def _margin(mesh: StrictTable) -> Margin | None:
    margin = Margin(
        width=mesh.take("margin", _width, None),
        outline=mesh.take("outline", _outline, None),
        spacing=mesh.take("spacing", kinds.positive, None),
    )
    if margin.width is not None and margin.outline is not None:
        raise RecordingError(f"{mesh.where} has both margin and outline; give one.")
    if margin.width is None and margin.outline is None:
        if margin.spacing is not None:
            raise RecordingError(f"{mesh.where} spacing is that of added vertices: give margin or outline as well.")
        return None
    return margin


def _width(value: Any) -> float:
    width = kinds.positive(value)
    if width > MAX_MARGIN_M:
        raise TypeError(f"a number of m above 0 and up to {MAX_MARGIN_M:g}")
    return width


def _outline(value: Any) -> Float[np.ndarray, "k 3"]:
    kind = f"a list of 3 to {MAX_OUTLINE_POINTS} corners, all [x, y] or all [x, y, z]"
    if not isinstance(value, list) or not 3 <= len(value) <= MAX_OUTLINE_POINTS:
        raise TypeError(kind)
    lengths = {len(corner) if isinstance(corner, list) else 0 for corner in value}
    if lengths not in ({2}, {3}):
        raise TypeError(kind)
    corners = np.array([[kinds.number(number) for number in corner] for corner in value])
    if np.abs(corners).max() > MAX_LENGTH_M:
        raise TypeError(f"{kind}, within {MAX_LENGTH_M:g} m of the origin")
    return corners if lengths == {3} else np.column_stack([corners, np.full(len(corners), np.nan)])


def _details(truth: StrictTable) -> dict[str, object]:
    details = dict(truth.take("details", kinds.table, {}))
    try:
        json.dumps(details, allow_nan=False)
    except (TypeError, ValueError, RecursionError) as failure:
        raise RecordingError(f"{truth.where} details must hold texts and finite numbers: {quoted(failure)}.") from (
            failure
        )
    return details


def _frame(table: StrictTable) -> WorldFrame:
    rotation = np.array(table.take("rotation", kinds.matrix, np.eye(3).tolist()))
    if (
        not np.allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=MAX_ROTATION_ERROR)
        or np.linalg.det(rotation) < 0
    ):
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


def _attached(table: StrictTable) -> Rows | Region | float | None:
    beyond, rows = table.take("attached_beyond", kinds.number, None), read_choice(table, "attached_rows")
    at, within = table.take("attached_at", kinds.vector, None), table.take("attached_within", kinds.positive, None)
    if (beyond is not None) + (rows is not None) + (at is not None) > 1:
        raise RecordingError(f"{table.where} has several of attached_beyond, attached_rows and attached_at; give one.")
    if (at is None) != (within is None):
        raise RecordingError(f"{table.where} attached_at and attached_within need each other.")
    if at is not None and within is not None:
        return Region(at=np.array(at), radius=within)
    return rows if beyond is None else float(beyond)


def parse_declaration_table(table: StrictTable) -> Declaration:
    """Return the declaration in a `[declaration]` table.

    Raises:
        RecordingError: an unknown key, a value of the wrong kind, or one that `Declaration` refuses.
    """
    allowed: dict[str, Callable[[Any], Any]] = {field.name: kinds.number for field in fields(Declaration)}
    allowed = {name: kind for name, kind in allowed.items() if name not in NOT_IN_TABLE}
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
