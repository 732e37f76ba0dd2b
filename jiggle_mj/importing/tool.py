"""Where the tool is in each frame of measured data: at the grasped points, on a stated path, or as it reported.

Between two reports it is taken to have gone straight; nothing else is filled in.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation, Slerp

from ..errors import RecordingError
from ..observation import UNTURNED, ToolReport, ToolState
from .declaration import GraspPath, MeasuredRecording, ReportedTool, Rows
from .point_files import read_npz, read_rows


@dataclass(frozen=True, kw_only=True)
class Reports:
    """Of an instrument."""

    times: Int[np.ndarray, " r"]
    """[ns], from the first frame."""
    positions: Float[np.ndarray, "r 3"]
    """World [m]."""
    turns: Slerp
    """Orientations in the world by time [ns]."""
    after: int
    """How long each run shows the sheet at rest [ns]."""

    def between(self, begin: int, end: int) -> tuple[ToolReport, ...]:
        """Those within an open interval [ns]."""
        inside = (self.times > begin) & (self.times < end)
        return tuple(
            ToolReport(time=int(time), position=position)
            for time, position in zip(self.times[inside], self.positions[inside], strict=True)
        )

    def at(self, time: int) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 4"]]:
        """Position [m] and orientation, w first, at a time [ns]."""
        now = np.clip(time, self.times[0], self.times[-1])
        position = np.array([np.interp(now, self.times, self.positions[:, k]) for k in range(3)])
        return position, self.turns(now).as_quat(scalar_first=True)


@dataclass(frozen=True, kw_only=True)
class Tool:
    """As recording.toml says."""

    said: MeasuredRecording
    rest: Float[np.ndarray, "n 3"]
    """First frame, world [m]."""
    held: Int[np.ndarray, " h"] = field(default_factory=lambda: np.empty(0, int))
    """Points that are named as grasped."""
    reports: Reports | None = None

    @classmethod
    def read(
        cls, folder: Path, said: MeasuredRecording, rest: Float[np.ndarray, "n 3"], *, name: str, origin: float
    ) -> "Tool":
        """From the data.

        Args:
            folder: where they are.
            said: of them.
            rest: first frame, world [m].
            name: of that frame.
            origin: its time, where frames have times [s].

        Raises:
            RecordingError: rows or arrays that are none; none of the grasped points is seen at rest.
        """
        grasp = said.grasp
        if isinstance(grasp, GraspPath):
            return cls(said=said, rest=rest)
        rows = grasp.rows if isinstance(grasp, ReportedTool) else grasp
        held = read_rows(folder, rows, len(rest), "grasp")
        if not np.isfinite(rest[held]).all(axis=1).any():
            raise RecordingError(
                f"the rest frame {name} shows none of the {len(held)} grasped points, so where the tool began is "
                "unknown; choose another rest, or state the path in [grasp]."
            )
        reports = _reports(folder, said, grasp, origin) if isinstance(grasp, ReportedTool) else None
        return cls(said=said, rest=rest, held=held, reports=reports)

    def unknown(self, positions: Float[np.ndarray, "n 3"]) -> bool:
        """Whether nothing says where it is in a frame."""
        if self.reports is not None or not len(self.held):
            return False
        return not np.isfinite(positions[self.held] - self.rest[self.held]).all(axis=1).any()

    def state(self, *, step: int, time: int, run: int, began: int, positions: Float[np.ndarray, "n 3"]) -> ToolState:
        """In one frame.

        Args:
            step: frames after the one at rest.
            time: [ns].
            run: number of the run, from 1.
            began: when it began [ns].
            positions: of the points, world [m].
        """
        grasp, turn, closed = self.said.grasp, UNTURNED, True
        if self.reports is not None:
            tip, turn = self.reports.at(time)
            closed = time - began >= self.reports.after
        elif isinstance(grasp, GraspPath):
            tip = grasp.start + step * grasp.step * grasp.direction
        else:
            moved = np.nanmean(positions[self.held] - self.rest[self.held], axis=0)
            tip = np.nanmean(self.rest[self.held], axis=0) + moved
        return ToolState(
            position=tip,
            quat_wxyz=turn,
            closed=closed,
            grasp=run if closed else run - 1,
            radius=self.said.grasp_radius,
            held_tracks=tuple(self.held.tolist()),
            by_points=isinstance(grasp, Rows),
        )


def _reports(folder: Path, said: MeasuredRecording, grasp: ReportedTool, origin: float) -> Reports:
    archive, frame = folder / said.points.files[0], said.frame
    seconds, positions = read_npz(archive, grasp.times), read_npz(archive, grasp.tool)
    count = len(seconds)
    if positions.shape != (count, 3) or count < 2 or not (np.diff(seconds) > 0).all():
        raise RecordingError(
            f"{archive}: {grasp.tool} must have shape (reports, 3) and {grasp.times} (reports,), rising; they have "
            f"{positions.shape} and {seconds.shape}."
        )
    turns = np.tile(UNTURNED, (count, 1)) if grasp.turns is None else read_npz(archive, grasp.turns)
    if turns.shape != (count, 4):
        raise RecordingError(f"{archive}: {grasp.turns} must have shape ({count}, 4), w first; it has {turns.shape}.")
    times = np.round((seconds - origin) * 1e9).astype(np.int64)
    return Reports(
        times=times,
        positions=positions * said.unit @ frame.rotation.T + frame.translation,
        turns=Slerp(times, Rotation.from_matrix(frame.rotation) * Rotation.from_quat(turns, scalar_first=True)),
        after=round(grasp.after * 1e9),
    )
