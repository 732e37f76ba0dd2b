"""Position of the tool in each frame of measured data: at the grasped points, on a given path, or from its reports.

Between two reports the position is interpolated linearly; nothing else is filled in.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation, Slerp

from ..errors import RecordingError
from ..observation import IDENTITY_WXYZ, ToolReport, ToolState
from ..recording.schemas import NS_PER_S
from .data_folder import DataFolder
from .declaration import GraspPath, MeasuredRecording, ReportedTool, Rows
from .point_files import read_rows
from .points.archives import read_array


@dataclass(frozen=True, kw_only=True)
class Reports:
    """Reports of an instrument."""

    times: Int[np.ndarray, " r"]
    """Times of the reports, from the first frame [ns]."""
    positions: Float[np.ndarray, "r 3"]
    """Reported positions in the world [m]."""
    orientations: Slerp
    """Orientation in the world by time [ns]."""
    after: int
    """Time from the start of each run at which the jaws close [ns]."""

    def between(self, begin: int, end: int) -> tuple[ToolReport, ...]:
        """Return the reports within an open interval [ns]."""
        inside = (self.times > begin) & (self.times < end)
        return tuple(
            ToolReport(time=int(time), position=position)
            for time, position in zip(self.times[inside], self.positions[inside], strict=True)
        )

    def at(self, time: int) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 4"]]:
        """Return position [m] and orientation wxyz at a time [ns]."""
        clipped = np.clip(time, self.times[0], self.times[-1])
        position = np.array([np.interp(clipped, self.times, self.positions[:, k]) for k in range(3)])
        return position, self.orientations(clipped).as_quat(scalar_first=True)


@dataclass(frozen=True, kw_only=True)
class Tool:
    """The tool of measured data, as recording.toml describes it."""

    given: MeasuredRecording
    """Contents of the recording.toml."""
    rest: Float[np.ndarray, "n 3"]
    """Positions of the points in the first frame, in the world [m]."""
    held: Int[np.ndarray, " h"] = field(default_factory=lambda: np.empty(0, int))
    """Rows of the grasped points; empty where a path is given."""
    reports: Reports | None = None
    """Reports of the instrument; None where it has none."""

    @classmethod
    def read(
        cls, folder: DataFolder, given: MeasuredRecording, rest: Float[np.ndarray, "n 3"], *, name: str, origin: float
    ) -> "Tool":
        """Read the tool from the data files.

        Args:
            folder: folder of the data files.
            given: contents of the recording.toml.
            rest: positions of the points in the first frame, in the world [m].
            name: name of that frame.
            origin: time of that frame on the clock of the data [s].

        Raises:
            RecordingError: rows or arrays are missing or malformed, or no grasped point is seen at rest.
        """
        grasp = given.grasp
        if isinstance(grasp, GraspPath):
            return cls(given=given, rest=rest)
        rows = grasp.rows if isinstance(grasp, ReportedTool) else grasp
        held = read_rows(folder, rows, len(rest), "grasp")
        if not np.isfinite(rest[held]).all(axis=1).any():
            raise RecordingError(
                f"the rest frame {name} shows none of the {len(held)} grasped points, so the first position of the "
                "tool is unknown; choose another rest, or give the path in [grasp]."
            )
        reports = _reports(folder, given, grasp, origin) if isinstance(grasp, ReportedTool) else None
        return cls(given=given, rest=rest, held=held, reports=reports)

    def is_unknown(self, positions: Float[np.ndarray, "n 3"]) -> bool:
        """Return whether the tool's position in a frame is unknown: no grasped point is seen."""
        if self.reports is not None or not len(self.held):
            return False
        return not np.isfinite(positions[self.held] - self.rest[self.held]).all(axis=1).any()

    def state(self, *, step: int, time: int, run: int, began: int, positions: Float[np.ndarray, "n 3"]) -> ToolState:
        """Return the state of the tool in one frame.

        Args:
            step: number of frames after the rest frame.
            time: time of the frame [ns].
            run: number of the run, from 1.
            began: time at which the run began [ns].
            positions: positions of the points in the world [m].
        """
        grasp, quat_wxyz, closed = self.given.grasp, IDENTITY_WXYZ, True
        if self.reports is not None:
            tip, quat_wxyz = self.reports.at(time)
            closed = time - began >= self.reports.after
        elif isinstance(grasp, GraspPath):
            tip = grasp.start + step * grasp.step * grasp.direction
        else:
            displacement = np.nanmean(positions[self.held] - self.rest[self.held], axis=0)
            tip = np.nanmean(self.rest[self.held], axis=0) + displacement
        return ToolState(
            position=tip,
            quat_wxyz=quat_wxyz,
            closed=closed,
            grasp=run if closed else run - 1,
            radius=self.given.grasp_radius,
            held_tracks=tuple(self.held.tolist()),
            by_points=isinstance(grasp, Rows),
        )


def _reports(folder: DataFolder, given: MeasuredRecording, grasp: ReportedTool, origin: float) -> Reports:
    archive, frame = folder / given.points.files[0], given.frame
    seconds, positions = read_array(archive, grasp.times), read_array(archive, grasp.tool)
    count = len(seconds)
    if positions.shape != (count, 3) or count < 2 or not (np.diff(seconds) > 0).all():
        raise RecordingError(
            f"{archive}: {grasp.tool} must have shape (reports, 3) and {grasp.times} (reports,), increasing; they have "
            f"{positions.shape} and {seconds.shape}."
        )
    quaternions = np.tile(IDENTITY_WXYZ, (count, 1))
    if grasp.orientations is not None:
        quaternions = read_array(archive, grasp.orientations)
    if quaternions.shape != (count, 4):
        raise RecordingError(
            f"{archive}: {grasp.orientations} must have shape ({count}, 4), w first; it has {quaternions.shape}."
        )
    times = np.round((seconds - origin) * NS_PER_S).astype(np.int64)
    return Reports(
        times=times,
        positions=positions * given.unit @ frame.rotation.T + frame.translation,
        orientations=Slerp(
            times, Rotation.from_matrix(frame.rotation) * Rotation.from_quat(quaternions, scalar_first=True)
        ),
        after=round(grasp.after * NS_PER_S),
    )
