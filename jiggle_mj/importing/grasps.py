"""Grasps of measured data: which frames each covers, when its jaws close, and which points it holds."""

import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ..errors import RecordingError
from ..recording.schemas import NS_PER_S
from .clock import FrameClock
from .data_folder import DataFolder
from .grasp_table import GivenGrasp, NearPlace
from .point_files import read_rows
from .recording_toml import MeasuredRecording
from .reports import Reports


@dataclass(frozen=True, kw_only=True)
class GraspSpan:
    """One grasp: consecutive frames of one run under one table of recording.toml."""

    number: int
    """Number of the grasp, from 1."""
    what: str
    """The table and the run, for errors."""
    given: GivenGrasp
    """The table."""
    frames: tuple[int, int]
    """First frame, and the one after the last."""
    closing: int | None
    """Frame from which the jaws are closed; None where they never close."""
    held: Int[np.ndarray, " h"]
    """Rows of the held points; empty where the radius decides over the vertices of a declared mesh."""

    def is_closed(self, frame: int) -> bool:
        """Return whether the jaws are closed in a frame of this grasp."""
        return self.closing is not None and frame >= self.closing


def read_grasps(
    folder: DataFolder,
    given: MeasuredRecording,
    frames: Float[np.ndarray, "t n 3"],
    *,
    names: list[str],
    numbers: list[int],
    clock: FrameClock,
    reports: Reports | None,
    vertices: Float[np.ndarray, "v 3"] | None,
) -> tuple[GraspSpan, ...]:
    """Return the grasps in the order of time.

    Args:
        folder: folder of the data files.
        given: contents of the recording.toml.
        frames: positions of the points in the world [m], the rest frame first.
        names: names of the frames.
        numbers: number of each frame in the data, from 0.
        clock: times and runs of the frames.
        reports: reports of the instrument; None without one.
        vertices: vertices of the declared mesh [m]; None without one.

    Raises:
        RecordingError: rows are not those of the data, a grasp covers no frame, two cover one, or nothing is held.
    """
    tables, cover = given.grasp.grasps, np.full(len(frames), -1)
    for index, table in enumerate(tables):
        inside = np.array([_covers(table, clock, frame, numbers[frame]) for frame in range(len(frames))], bool)
        if not inside.any():
            span = clock.times[-1] / NS_PER_S
            raise RecordingError(
                f"{table.where} covers no frame: there are frames 0 to {len(frames) - 1}, over {span:.6g} s from the "
                f"first frame, and runs {clock.names_runs}."
            )
        twice = np.flatnonzero(inside & (cover >= 0))
        if len(twice):
            raise RecordingError(
                f"{table.where} and {tables[cover[twice[0]]].where} both cover {names[twice[0]]}; a frame belongs to "
                "one grasp: change run, begin and end, or frames."
            )
        cover[inside] = index
    grasps: list[GraspSpan] = []
    for begin, end in _stretches(cover, np.array(clock.runs)):
        table = tables[cover[begin]]
        run = f", run {clock.run_values[begin]}" if len(set(clock.runs)) > 1 else ""
        closing = _closing(table, clock, begin, end)
        held = np.empty(0, int)
        if closing is not None:
            held = _held(folder, table, frames, closing, names, clock, reports, vertices)
        number = len(grasps) + 1
        grasps.append(
            GraspSpan(
                number=number, what=table.where + run, given=table, frames=(begin, end), closing=closing, held=held
            )
        )
    _refuse_open(grasps, clock)
    return tuple(grasps)


def _covers(table: GivenGrasp, clock: FrameClock, frame: int, number: int) -> bool:
    if table.run is not None:
        return clock.run_values[frame] == table.run
    if table.frames is not None:
        return table.frames[0] <= number <= table.frames[1]
    seconds = clock.times[frame] / NS_PER_S
    return (table.begin is None or seconds >= table.begin) and (table.end is None or seconds < table.end)


def _stretches(cover: Int[np.ndarray, " t"], runs: Int[np.ndarray, " t"]) -> list[tuple[int, int]]:
    """Return begin and end of each stretch of frames under one table, in one run."""
    edges = np.flatnonzero((np.diff(cover) != 0) | (np.diff(runs) != 0)) + 1
    limits = [0, *edges.tolist(), len(cover)]
    return [(begin, end) for begin, end in itertools.pairwise(limits) if cover[begin] >= 0]


def _closing(table: GivenGrasp, clock: FrameClock, begin: int, end: int) -> int | None:
    after = round(table.after * NS_PER_S)
    return next((k for k in range(begin, end) if clock.times[k] - clock.times[begin] >= after), None)


def _refuse_open(grasps: list[GraspSpan], clock: FrameClock) -> None:
    for grasp in grasps:
        if grasp.closing is None:
            begin, end = grasp.frames
            span = (clock.times[end - 1] - clock.times[begin]) / NS_PER_S
            raise RecordingError(
                f"{grasp.what}: the jaws never close: after is {grasp.given.after:g} s, and the frames of this grasp "
                f"last {span:.3g} s; lower after."
            )


def _held(
    folder: DataFolder,
    table: GivenGrasp,
    frames: Float[np.ndarray, "t n 3"],
    closing: int,
    names: list[str],
    clock: FrameClock,
    reports: Reports | None,
    vertices: Float[np.ndarray, "v 3"] | None,
) -> Int[np.ndarray, " h"]:
    if not isinstance(table.held, NearPlace):
        held = read_rows(folder, table.held, frames.shape[1], table.where)
    else:
        centre = table.held.at
        if centre is None:
            assert reports is not None
            centre = reports.at(clock.times[closing])[0]
        distance = np.linalg.norm(frames[closing] - centre, axis=1)
        held = np.flatnonzero(distance <= table.radius)
        if reports is not None and vertices is not None:
            nearest = np.linalg.norm(vertices - centre, axis=1).min()
            if table.held.at is None and nearest <= table.radius:
                return np.empty(0, int)
        if not np.isfinite(distance).any():
            raise RecordingError(
                f"{table.where} holds nothing: {names[closing]}, in which the jaws close, shows no point; choose "
                "another after, or other frames."
            )
        if not len(held):
            raise RecordingError(
                f"{table.where} holds nothing: in {names[closing]} no point lies within the radius of "
                f"{table.radius * 1e3:.3g} mm around {np.round(centre, 4).tolist()} m; the nearest is "
                f"{np.nanmin(distance) * 1e3:.3g} mm away."
            )
    if not np.isfinite(frames[0][held]).all(axis=1).any():
        raise RecordingError(
            f"{table.where}: the rest frame {names[0]} shows none of the {len(held)} grasped points, so the first "
            "position of the tool is unknown; choose another rest, or give the path in [grasp]."
        )
    return held
