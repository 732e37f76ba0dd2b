"""The tables `[grasp]` and `[[grasp]]` of recording.toml: what the jaws hold, when, and what gives the tool's position.

Checks kinds of values only; `grasps` and `tool` compare them with the data.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from .. import toml_kinds as kinds
from ..errors import RecordingError
from ..toml_kinds import StrictTable
from .units import LENGTH_UNITS, TIME_UNITS, unit_of

DEFAULT_GRASP_RADIUS = 2e-3
"""Radius of the grip where none is given [m]; without effect where rows or vertices are declared held."""
NEAR_TOOL = "near tool"
"""Value of `rows` that means: the points within the radius of the tool when the jaws close."""
START_TOGETHER = "start together"
"""Value of `tool_clock_offset` that means: the first report belongs to the first frame."""
MAX_SECONDS = 9e9
"""Largest time in seconds that nanoseconds in 64 bits hold: clocks that count from 1970 are below it."""
TOOL_KEYS = ("tool", "tool_times", "tool_turns", "tool_unit", "tool_time_unit", "tool_clock_offset")
"""Keys of the one tool; several `[[grasp]]` may repeat them."""
PATH_KEYS = ("start", "direction", "step")
"""Keys of a straight pull."""
HELD_KEYS = ("rows", "rows_file", "rows_first", "at")
"""Keys that say which points are held."""
WHEN_KEYS = ("run", "begin", "end", "frames")
"""Keys that say which part of the recording a grasp covers."""


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
class NearPlace:
    """A choice of points: those within the grip's radius when it closes."""

    at: Float[np.ndarray, " 3"] | None
    """Centre of the grip in the world [m]; None for the position of the tool."""


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
    """Name of the positions in the .npz, shape (reports, 3), or (reports, 2) in the plane z = 0, in the frame of the
    points."""
    times: str | None
    """Name of the reports' times in the .npz, shape (reports,), increasing; None for one report a frame."""
    orientations: str | None
    """Name of the quaternions wxyz in the .npz, shape (reports, 4), in the frame of the points; None where the
    orientation is constant."""
    unit: float | None
    """Metres in one unit of the positions; None for the unit of the points."""
    time_unit: int | None
    """Nanoseconds in one unit of the times; None for the unit of the frames' times."""
    clock_offset: float | None
    """What is added to a report's time to get the frames' time [s]; None where the first report belongs to the first
    frame."""


@dataclass(frozen=True, kw_only=True)
class GivenGrasp:
    """One grasp: what is held, and when."""

    held: Rows | NearPlace
    """The points that are held."""
    radius: float
    """Radius of the grip [m]."""
    after: float
    """Time from the begin at which the jaws close; the sheet is at rest before [s]."""
    run: int | None = None
    """Value of the array `runs` in the frames of this grasp; None for all runs, or for a time or frames."""
    begin: float | None = None
    """Begin [s] from the first frame; None for no limit."""
    end: float | None = None
    """End [s] from the first frame, exclusive; None for no limit."""
    frames: tuple[int, int] | None = None
    """First and last frame of this grasp, counted from 0 as the files are; None for a run, a time or all."""
    where: str
    """Name of the table, for errors."""

    @property
    def covers_all(self) -> bool:
        """Return whether the grasp covers the whole recording."""
        return all(limit is None for limit in (self.run, self.begin, self.end, self.frames))


@dataclass(frozen=True, kw_only=True)
class GraspTable:
    """All grasps of a recording, and the tool."""

    grasps: tuple[GivenGrasp, ...]
    """The grasps, as they are listed; empty where a path is given."""
    path: GraspPath | None
    """The straight pull; None for none."""
    tool: ReportedTool | None
    """The instrument's reports; None where the grasped points, or the path, give its position."""
    path_radius: float = DEFAULT_GRASP_RADIUS
    """Radius of the grip on a path [m]."""


def read_grasps(top: StrictTable) -> GraspTable:
    """Return the contents of `[grasp]`, or of all `[[grasp]]`.

    Raises:
        RecordingError: a key is unknown or missing, a value is of the wrong kind, or two contradict each other.
    """
    tables = _tables(top)
    if len(tables) == 1 and "start" in tables[0].values:
        return _path(tables[0])
    grasps, tool = tuple(_grasp(table) for table in tables), _tool(tables)
    for table, grasp in zip(tables, grasps, strict=True):
        table.known |= {*TOOL_KEYS, *PATH_KEYS}
        table.refuse_unknown()
        path_key = next((key for key in PATH_KEYS if key in table.values), None)
        if path_key is not None:
            raise RecordingError(
                f"{table.where} {path_key} is that of a straight pull, which has start, direction and step in the one "
                "[grasp], and no held points."
            )
        if len(tables) > 1 and grasp.covers_all:
            raise RecordingError(
                f"{table.where} needs run, begin and end, or frames: there are {len(tables)} grasps, and each needs "
                "its part of the recording."
            )
        if tool is None and isinstance(grasp.held, NearPlace) and grasp.held.at is None:
            raise RecordingError(
                f'{table.where} rows = "{NEAR_TOOL}" needs tool, the array of its positions; or give at = [x, y, z].'
            )
    return GraspTable(grasps=grasps, path=None, tool=tool)


def _tables(top: StrictTable) -> list[StrictTable]:
    given = top.values.get("grasp")
    if not isinstance(given, list):
        return [top.table("grasp")]
    top.known.add("grasp")
    if not given or not all(isinstance(item, dict) for item in given):
        raise RecordingError(f"{top.where} grasp must be a table, or several [[grasp]].")
    where = top.where.partition(" [")[0]
    return [StrictTable(item, f"{where} [[grasp]] number {number}") for number, item in enumerate(given, start=1)]


def _path(table: StrictTable) -> GraspTable:
    path = GraspPath(
        start=np.array(table.take("start", kinds.vector)),
        direction=table.direction("direction"),
        step=table.take("step", kinds.number),
    )
    radius = table.take("radius", kinds.positive, DEFAULT_GRASP_RADIUS)
    other = next((key for key in (*HELD_KEYS, *WHEN_KEYS, *TOOL_KEYS, "after") if key in table.values), None)
    if other is not None:
        raise RecordingError(
            f"{table.where} has both start, of a straight pull, and {other}, of held points or a tool that reported; "
            "give one of both."
        )
    table.refuse_unknown()
    return GraspTable(grasps=(), path=path, tool=None, path_radius=radius)


def _grasp(table: StrictTable) -> GivenGrasp:
    grasp = GivenGrasp(
        held=_held(table),
        radius=table.take("radius", kinds.positive, DEFAULT_GRASP_RADIUS),
        after=table.take("after", _duration, 0.0),
        run=table.take("run", _integer, None),
        begin=table.take("begin", kinds.number, None),
        end=table.take("end", kinds.number, None),
        frames=table.take("frames", _frame_range, None),
        where=table.where,
    )
    timed = grasp.begin is not None or grasp.end is not None
    if (grasp.run is not None) + timed + (grasp.frames is not None) > 1:
        raise RecordingError(f"{table.where} has several of run, begin and end, and frames; give one.")
    if grasp.begin is not None and grasp.end is not None and not grasp.begin < grasp.end:
        raise RecordingError(f"{table.where} begin must be below end; got {grasp.begin}, {grasp.end}.")
    return grasp


def _held(table: StrictTable) -> Rows | NearPlace:
    at = table.take("at", kinds.vector, None)
    near_tool = table.values.get("rows") == NEAR_TOOL
    rows = None if near_tool else read_choice(table, "rows")
    if near_tool:
        table.known |= {"rows", "rows_file", "rows_first"}
    if (at is not None) + near_tool + (rows is not None) != 1:
        raise RecordingError(
            f'{table.where} needs one of rows, rows_file, at = [x, y, z] with radius, rows = "{NEAR_TOOL}"; or start, '
            "direction and step."
        )
    if rows is not None:
        return rows
    if "radius" not in table.values:
        raise RecordingError(f"{table.where} needs radius [m], within which points are held.")
    return NearPlace(at=None if at is None else np.array(at))


def read_choice(table: StrictTable, name: str) -> Rows | None:
    """Return the rows under a key, or in the file under it; None where neither is given.

    Raises:
        RecordingError: both are given, or a value is of the wrong kind.
    """
    rows, file = table.take(name, kinds.counts, None), table.take(f"{name}_file", kinds.text, None)
    first = table.take(f"{name}_first", kinds.count, 0)
    if rows is not None and file is not None:
        raise RecordingError(f"{table.where} has both {name} and {name}_file; give one.")
    return None if rows is None and file is None else Rows(rows=tuple(rows or ()), file=file, first=first)


def _tool(tables: list[StrictTable]) -> ReportedTool | None:
    """Return the tool that the tables describe; what one says, another may repeat, but not change."""
    merged: dict[str, Any] = {}
    for table in tables:
        for key in TOOL_KEYS:
            value = table.values.get(key)
            # NaN differs from itself; it is refused as a value below.
            if value is not None and merged.setdefault(key, value) != value and value == value:
                raise RecordingError(f"{table.where} {key} differs from that of another grasp; there is one tool.")
    if not merged:
        return None
    table = StrictTable(merged, tables[0].where)
    offset = table.take("tool_clock_offset", _offset, 0.0)
    return ReportedTool(
        tool=table.take("tool", kinds.text),
        times=table.take("tool_times", kinds.text, None),
        orientations=table.take("tool_turns", kinds.text, None),
        unit=None if "tool_unit" not in merged else unit_of(table, "tool_unit", LENGTH_UNITS),
        time_unit=None if "tool_time_unit" not in merged else unit_of(table, "tool_time_unit", TIME_UNITS),
        clock_offset=offset,
    )


def _offset(value: Any) -> float | None:
    if value == START_TOGETHER:
        return None
    allowed = f'a number of at most {MAX_SECONDS:g} [s], or "{START_TOGETHER}"'
    try:
        seconds = kinds.number(value)
    except TypeError as failure:
        raise TypeError(allowed) from failure
    if abs(seconds) > MAX_SECONDS:
        raise TypeError(allowed)
    return seconds


def _duration(value: Any) -> float:
    seconds = kinds.not_negative(value)
    if seconds > MAX_SECONDS:
        raise TypeError(f"a number from 0 to {MAX_SECONDS:g} [s]")
    return seconds


def _integer(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError("a whole number, as in the array of runs")
    return value


def _frame_range(value: Any) -> tuple[int, int]:
    if not isinstance(value, list) or len(value) != 2 or kinds.counts(value)[0] > value[1]:
        raise TypeError("two whole numbers from 0, the first and the last frame")
    return value[0], value[1]
