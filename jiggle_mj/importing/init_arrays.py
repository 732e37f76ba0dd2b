"""Guess by name and shape which arrays of an archive are times, runs, triangles and reports of the tool."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .clock import LIKELY_PERIOD, MAX_PERIOD
from .init_points import GuessedPoints
from .points.archives import read_array
from .points.headings import stated_unit
from .reports import MAX_AGE, MAX_OUTSIDE
from .units import LENGTH_UNITS, TIME_UNITS

TIME = re.compile(r"time|stamp|^ts?$|_t$|^t_|sec", re.IGNORECASE)
"""Names of times."""
TOOL = re.compile(r"tool|tip|tcp|gripper|effector|robot|tweezer|instrument|moving|jaw|psm", re.IGNORECASE)
"""Names of what a tool reports."""
TURN = re.compile(r"quat|turn|rot|orient", re.IGNORECASE)
"""Names of orientations."""
RUN = re.compile(r"run|grasp|trial|pull|episode", re.IGNORECASE)
"""Names of numbers of runs."""
FACE = re.compile(r"face|tri|cell|element", re.IGNORECASE)
"""Names of triangles."""
WHOLE = 1e-6
"""Difference from a whole number that is rounding [units of time]."""
TIME_SUFFIX = re.compile(r"_(s|ms|us|ns)$")
"""End of an array's name that states its unit of time."""


@dataclass(frozen=True, kw_only=True)
class GuessedArrays:
    """Arrays beside the positions; None for what the archive does not seem to have."""

    times: str | None
    """Times of the frames."""
    time_unit: str
    """Unit of the times."""
    why_time_unit: str
    """Why it is taken to be that one."""
    runs: str | None
    """Numbers of the runs."""
    faces: str | None
    """Triangles."""
    first_vertex: int
    """Number of the first vertex."""
    tool: str | None
    """Positions of the tool."""
    tool_times: str | None
    """Times of its reports."""
    tool_turns: str | None
    """Its orientations."""
    tool_unit: str | None
    """Unit of its positions where the name states one."""
    tool_time_unit: str | None
    """Unit of its times where it is not that of the frames."""
    clocks_apart: bool
    """Whether the reports, on their own clock, begin after the frames or end before them."""


def guess_arrays(folder: Path, points: GuessedPoints) -> GuessedArrays:
    """Return the arrays beside the positions."""
    archive, shapes, n_frames = folder / points.files.files[0], points.arrays, len(points.positions)

    def first(names: re.Pattern[str], *allowed: tuple[int, ...], but: re.Pattern[str] | None = None) -> str | None:
        """Return the first array of such a name and shape; -1 stands for any length."""
        for key, shape in shapes.items():
            fits = any(
                len(shape) == len(each) and all(a in (-1, b) for a, b in zip(each, shape, strict=True))
                for each in allowed
            )
            if fits and names.search(key) and not (but is not None and but.search(key)) and key != points.files.key:
                return key
        return None

    times = points.files.times or first(TIME, (n_frames,), but=TOOL)
    tool = first(TOOL, (-1, 3), (-1, 2), but=re.compile(f"{TIME.pattern}|{TURN.pattern}|{FACE.pattern}", re.I))
    runs = first(RUN, (n_frames,), but=TIME) if times is not None else None
    faces = first(FACE, (-1, 3), but=TOOL)
    tool_times = tool_turns = None
    if tool is not None:
        n_reports = shapes[tool][0]
        tool_times = next((key for key in shapes if TIME.search(key) and TOOL.search(key)), None)
        if tool_times is not None and (shapes[tool_times] != (n_reports,) or times is None):
            tool_times = None
        tool_turns = first(TURN, (n_reports, 4))
        if tool_times is None and n_reports != n_frames:
            tool = tool_turns = None
    frame_times = read_array(archive, times) if times is not None and points.times is None else points.times
    time_unit, why = ("s", "") if times is None or frame_times is None else _time_unit(times, frame_times)
    tool_time_unit, apart = time_unit, False
    if frame_times is not None and tool_times is not None:
        report_times = read_array(archive, tool_times)
        stated = TIME_SUFFIX.search(tool_times)
        tool_time_unit = time_unit if stated is None else stated[1]
        apart = _apart(frame_times, TIME_UNITS[time_unit], report_times, TIME_UNITS[tool_time_unit])
    tool_unit = None if tool is None else stated_unit(tool)
    return GuessedArrays(
        times=times,
        time_unit=time_unit,
        why_time_unit=why,
        runs=runs,
        faces=faces,
        first_vertex=0 if faces is None else min(1, max(0, int(read_array(archive, faces).min(initial=1)))),
        tool=tool,
        tool_times=tool_times,
        tool_turns=tool_turns,
        tool_time_unit=None if tool_time_unit == time_unit else tool_time_unit,
        clocks_apart=apart,
        tool_unit=tool_unit if tool_unit in LENGTH_UNITS else None,
    )


def _time_unit(name: str, times: np.ndarray) -> tuple[str, str]:
    """Return the unit of times, and why: the name states it, or the frames then come at a usual rate.

    Fractions are taken for seconds even where frames are slow: ms, us and ns are mostly counted in whole numbers.
    """
    median = float(np.median(np.diff(times.astype(np.longdouble))))
    stated = TIME_SUFFIX.search(name)
    if stated is not None:
        return stated[1], f"as the name {name} says; a frame every {_seconds(median, stated[1]):.3g} s"
    whole = bool(np.allclose(times.astype(float), np.round(times.astype(float)), rtol=0, atol=WHOLE))
    low, high = LIKELY_PERIOD if whole else (LIKELY_PERIOD[0], MAX_PERIOD)
    unit = next((unit for unit in TIME_UNITS if low <= _seconds(median, unit) <= high), "s")
    return unit, f"guessed: a frame every {_seconds(median, unit):.3g} s"


def _seconds(time: float, unit: str) -> float:
    return time * TIME_UNITS[unit] / TIME_UNITS["s"]


def _apart(frames: np.ndarray, frame_unit: int, reports: np.ndarray, report_unit: int) -> bool:
    """Return whether a tenth of the frames or more lie outside the reports, or the first frame does."""
    times = frames.astype(np.longdouble) * frame_unit
    first, last = (np.longdouble(reports[k]) * report_unit for k in (0, -1))
    outside = (times < first - MAX_AGE) | (times > last + MAX_AGE)
    return bool(outside[0] or outside.mean() > MAX_OUTSIDE)
