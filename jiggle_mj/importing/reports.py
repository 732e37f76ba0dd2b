"""Reports of an instrument on the clock of the frames. Between two reports the position is interpolated linearly."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Shaped
from scipy.spatial.transform import Rotation, Slerp

from ..errors import RecordingError
from ..observation import IDENTITY_WXYZ, ToolReport
from ..recording.schemas import NS_PER_S
from .clock import LIKELY_PERIOD, FrameClock, absolute_times
from .data_folder import DataFolder
from .grasp_table import START_TOGETHER, ReportedTool
from .points.archives import read_array
from .points.measured import in_space
from .recording_toml import MeasuredRecording
from .units import TIME_UNITS

MAX_AGE = 100_000_000
"""Time before the first and after the last report for which that report still holds [ns], as a recording's reader has
it for poses."""
MAX_OUTSIDE = 0.1
"""Share of frames outside the reports above which the clocks are taken to differ; fewer are left out and named."""
FAR_SPANS, FEW_SPANS = 100, 5
"""Spans of the frames within which reports are in the right unit of time: a robot reports for some time before and
after the frames, or not quite to their ends. Units differ by 1000, so that one fits at most."""
MIN_INSIDE = 2
"""Reports at the time of the frames up to which the tool moves on one straight line: with times of a unit that is too
large, all but the first come after the last frame."""


@dataclass(frozen=True, kw_only=True)
class Reports:
    """Reports of an instrument."""

    times: Int[np.ndarray, " r"]
    """Times of the reports, from the first frame [ns]."""
    positions: Float[np.ndarray, "r 3"]
    """Reported positions in the world [m]."""
    orientations: Slerp
    """Orientation in the world by time [ns]."""

    def between(self, begin: int, end: int) -> tuple[ToolReport, ...]:
        """Return the reports within an open interval [ns]."""
        inside = (self.times > begin) & (self.times < end)
        return tuple(
            ToolReport(time=int(time), position=position)
            for time, position in zip(self.times[inside], self.positions[inside], strict=True)
        )

    def covers(self, time: int) -> bool:
        """Return whether a time [ns] lies within the reports."""
        return bool(self.times[0] - MAX_AGE <= time <= self.times[-1] + MAX_AGE)

    def at(self, time: int) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 4"]]:
        """Return position [m] and orientation wxyz at a time [ns]."""
        clipped = np.clip(time, self.times[0], self.times[-1])
        position = np.array([np.interp(clipped, self.times, self.positions[:, k]) for k in range(3)])
        return position, self.orientations(clipped).as_quat(scalar_first=True)


def read_reports(folder: DataFolder, given: MeasuredRecording, tool: ReportedTool, clock: FrameClock) -> Reports:
    """Return the reports of the tool on the frames' clock, in the world.

    Raises:
        RecordingError: an array is missing or of another shape, times do not increase, or the frames lie outside the
            reports.
    """
    archive, frame = folder / given.points.files[0], given.frame
    given_positions = read_array(archive, tool.tool)
    count = len(clock.times) if tool.times is None else len(np.atleast_1d(read_array(archive, tool.times)))
    if given_positions.shape not in ((count, 3), (count, 2)) or count < 2:
        owner = f"{tool.times} (reports,), at least two" if tool.times is not None else "one report a frame"
        raise RecordingError(
            f"{archive}: {tool.tool} must have shape (reports, 3) and {owner}; it has {given_positions.shape}, for "
            f"{count} times. Without tool_times there is one report a frame."
        )
    positions = in_space(given_positions.astype(float)[np.newaxis])[0]
    if not np.isfinite(positions).all():
        bad = int(np.flatnonzero(~np.isfinite(positions).all(axis=1))[0])
        raise RecordingError(f"{archive}: {tool.tool} must be finite; report {bad} (from 0) is not: leave it out.")
    times = _times(read_array(archive, tool.times) if tool.times is not None else None, given, tool, clock)
    unit = given.unit if tool.unit is None else tool.unit
    rotations = Rotation.from_matrix(frame.rotation) * _turns(folder, given, tool, count)
    reports = Reports(
        times=times,
        positions=positions * unit @ frame.rotation.T + frame.translation,
        orientations=Slerp(times, rotations),
    )
    _refuse_outside(reports, tool, clock)
    return reports


def _times(
    given_times: Shaped[np.ndarray, "..."] | None, given: MeasuredRecording, tool: ReportedTool, clock: FrameClock
) -> Int[np.ndarray, " r"]:
    if given_times is None:
        return np.array(clock.times, np.int64)
    if given_times.ndim != 1:
        raise RecordingError(f"{tool.times} must have shape (reports,); it has {given_times.shape}.")
    unit = tool.time_unit or given.time_unit or NS_PER_S
    absolute = absolute_times(given_times, unit, f"the tool's times {tool.times} (reports,)")
    if tool.clock_offset is None:
        shift = -absolute[0]
    else:
        shift = round(tool.clock_offset * NS_PER_S) - clock.origin
    times = [time + shift for time in absolute]
    _refuse_unit(times, unit, tool, clock)
    limit = np.iinfo(np.int64).max // 4
    if max(-times[0], times[-1]) > limit:
        raise RecordingError(_apart(times, tool, clock))
    return np.array(times, np.int64)


def _refuse_unit(times: list[int], unit: int, tool: ReportedTool, clock: FrameClock) -> None:
    """Refuse times that last as long as the frames in another unit, and in theirs far longer, or far shorter.

    Raises:
        RecordingError: names that unit.
    """
    span, frames = times[-1] - times[0], clock.times[-1]
    inside = sum(0 <= time <= frames for time in times)
    if not frames or (span >= frames / FAR_SPANS and inside > MIN_INSIDE):
        return
    shortest = round(LIKELY_PERIOD[0] * NS_PER_S) * (len(times) - 1)
    likely = [
        name
        for name, each in TIME_UNITS.items()
        if max(frames / FEW_SPANS, shortest) <= span * each / unit <= FAR_SPANS * frames
    ]
    stated = next(name for name, each in TIME_UNITS.items() if each == unit)
    if likely and stated not in likely:
        raise RecordingError(
            f"the tool's times {tool.times} in {stated} last {span / NS_PER_S:.4g} s, and the frames "
            f'{frames / NS_PER_S:.4g} s: give tool_time_unit = "{likely[0]}", and tool_clock_offset if the clocks '
            "differ."
        )


def _turns(folder: DataFolder, given: MeasuredRecording, tool: ReportedTool, count: int) -> Rotation:
    if tool.orientations is None:
        return Rotation.from_quat(np.tile(IDENTITY_WXYZ, (count, 1)), scalar_first=True)
    archive = folder / given.points.files[0]
    quaternions = read_array(archive, tool.orientations).astype(float)
    if quaternions.shape != (count, 4):
        raise RecordingError(
            f"{archive}: {tool.orientations} must have shape ({count}, 4), w first; it has {quaternions.shape}."
        )
    length = np.linalg.norm(quaternions, axis=1)
    bad = np.flatnonzero(~(np.isfinite(length) & (length > 0)))
    if len(bad):
        raise RecordingError(
            f"{archive}: {tool.orientations} must be finite quaternions that are not zero; report {bad[0]} (from 0) is "
            f"{quaternions[bad[0]].tolist()}: leave it out, or drop tool_turns."
        )
    return Rotation.from_quat(quaternions, scalar_first=True)


def _refuse_outside(reports: Reports, tool: ReportedTool, clock: FrameClock) -> None:
    outside = [number for number, time in enumerate(clock.times) if not reports.covers(time)]
    if not outside:
        return
    if outside[0] == 0 or len(outside) > MAX_OUTSIDE * len(clock.times):
        raise RecordingError(_apart(reports.times.tolist(), tool, clock))


def _apart(times: list[int], tool: ReportedTool, clock: FrameClock) -> str:
    first, last = times[0] / NS_PER_S, times[-1] / NS_PER_S
    cure = (0.0 if tool.clock_offset is None else tool.clock_offset) - first
    if -MAX_AGE <= times[0] <= MAX_AGE:
        return (
            f"the tool's reports end after {last:.6g} s, the frames after {clock.times[-1] / NS_PER_S:.6g} s; both "
            "begin together: leave out the frames without reports, or correct tool_clock_offset or tool_time_unit."
        )
    return (
        f"the tool's reports span {first:.10g} to {last:.10g} s from the first frame, the frames 0 to "
        f"{clock.times[-1] / NS_PER_S:.6g} s: they do not overlap as they must. Give tool_clock_offset, what is added "
        f"to a report's time to get the frames' [s] ({cure:.10g}, or \"{START_TOGETHER}\", if the first report "
        "belongs to the first frame), or tool_time_unit."
    )
