"""Position of the tool in each frame of measured data: at the grasped points, on a given path, or from its reports."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ..observation import IDENTITY_WXYZ, ToolReport, ToolState
from .clock import FrameClock
from .data_folder import DataFolder
from .grasp_checks import refuse_wrong_grasps
from .grasps import GraspSpan, read_grasps
from .recording_toml import MeasuredRecording
from .reports import Reports, read_reports


@dataclass(frozen=True, kw_only=True)
class Tool:
    """The tool of measured data, as recording.toml describes it."""

    given: MeasuredRecording
    """Contents of the recording.toml."""
    rest: Float[np.ndarray, "n 3"]
    """Positions of the points in the first frame, in the world [m]."""
    steps: list[int]
    """Number of each frame, counted from the rest frame."""
    clock: FrameClock
    """Times and runs of the frames."""
    grasps: tuple[GraspSpan, ...]
    """The grasps; none on a path."""
    reports: Reports | None
    """Reports of the instrument; None where it has none."""

    @classmethod
    def read(
        cls,
        folder: DataFolder,
        given: MeasuredRecording,
        frames: Float[np.ndarray, "t n 3"],
        *,
        names: list[str],
        steps: list[int],
        clock: FrameClock,
        vertices: Float[np.ndarray, "v 3"] | None,
    ) -> "Tool":
        """Read the tool from the data files.

        Args:
            folder: folder of the data files.
            given: contents of the recording.toml.
            frames: positions of the points in the world [m], the rest frame first.
            names: names of the frames.
            steps: number of each frame, counted from the rest frame.
            clock: times and runs of the frames.
            vertices: vertices of the declared mesh [m]; None without one.

        Raises:
            RecordingError: rows or arrays are missing or malformed, no grasped point is seen at rest, or the tool
                does not hold the named points.
        """
        reports = None if given.grasp.tool is None else read_reports(folder, given, given.grasp.tool, clock)
        grasps: tuple[GraspSpan, ...] = ()
        if given.grasp.path is None:
            numbers = [step + given.points.rest for step in steps]
            grasps = read_grasps(
                folder,
                given,
                frames,
                names=names,
                numbers=numbers,
                clock=clock,
                reports=reports,
                vertices=vertices,
            )
            refuse_wrong_grasps(given, frames, grasps, reports, clock)
        return cls(given=given, rest=frames[0], steps=steps, clock=clock, grasps=grasps, reports=reports)

    @property
    def n_held(self) -> int:
        """Return the number of points that are held at some time."""
        return len(np.unique(np.concatenate([np.empty(0, int), *(grasp.held for grasp in self.grasps)])))

    @property
    def notes(self) -> list[str]:
        """Return a line for each grasp that declares no points as held."""
        return [
            f"{grasp.what} holds the mesh's vertices within {grasp.given.radius * 1e3:.3g} mm of the tool"
            for grasp in self.grasps
            if not len(grasp.held)
        ]

    def why_unknown(self, frame: int, positions: Float[np.ndarray, "n 3"]) -> str | None:
        """Return why the tool's position in a frame is unknown; None where it is known."""
        if self.reports is not None:
            return None if self.reports.covers(self.clock.times[frame]) else "the tool reports at other times only"
        if self.given.grasp.path is not None:
            return None
        held = self._held(frame)
        seen = np.isfinite(positions[held] - self.rest[held]).all(axis=1).any()
        return None if seen else "no grasped point seen"

    def reported(self, begin: int, end: int) -> tuple[ToolReport, ...]:
        """Return the reports within an open interval [ns]."""
        return () if self.reports is None else self.reports.between(begin, end)

    def state(self, frame: int, positions: Float[np.ndarray, "n 3"]) -> ToolState:
        """Return the state of the tool in one frame.

        Args:
            frame: number of the frame, the rest frame first.
            positions: positions of the points in the world [m].
        """
        table, quat_wxyz = self.given.grasp, IDENTITY_WXYZ
        if self.reports is not None:
            tip, quat_wxyz = self.reports.at(self.clock.times[frame])
        elif table.path is not None:
            tip = table.path.start + self.steps[frame] * table.path.step * table.path.direction
        else:
            held = self._held(frame)
            displacement = np.nanmean(positions[held] - self.rest[held], axis=0)
            tip = np.nanmean(self.rest[held], axis=0) + displacement
        if table.path is not None:
            closed, number, radius, tracks = True, self.clock.runs[frame], table.path_radius, ()
        else:
            closed, number, radius, tracks = self._grip(frame)
        return ToolState(
            position=tip,
            quat_wxyz=quat_wxyz,
            closed=closed,
            grasp=number,
            radius=radius,
            held_tracks=tracks,
            by_points=self.reports is None and table.path is None,
        )

    def _grip(self, frame: int) -> tuple[bool, int, float, tuple[int, ...]]:
        """Return whether the jaws are closed, the number of the grasp, its radius, and the held tracks."""
        grasp = self._grasp(frame)
        within = grasp.frames[0] <= frame < grasp.frames[1]
        closed = within and grasp.is_closed(frame)
        ended = grasp.frames[1] <= frame
        number = grasp.number if closed or ended else grasp.number - 1
        return closed, number, grasp.given.radius, tuple(grasp.held.tolist())

    def _grasp(self, frame: int) -> GraspSpan:
        """Return the grasp of a frame, the next one where the jaws are open, or the last."""
        return next((grasp for grasp in self.grasps if frame < grasp.frames[1]), self.grasps[-1])

    def _held(self, frame: int) -> Int[np.ndarray, " h"]:
        return self._grasp(frame).held
