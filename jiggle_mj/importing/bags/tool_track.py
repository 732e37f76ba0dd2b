"""The tip of the tool in the world over time: from a topic of poses, or from a frame of /tf.

Between two reports the position is interpolated linearly and the orientation along the shortest rotation; all reports
are kept for the recording.
"""

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, Self

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation, Slerp

from ...camera import matrix_from_quaternion
from ...errors import RecordingError
from ...observation import ToolReport
from ...recording.reader import PAIRING_TOLERANCE_NS
from .stamps import TopicTimes
from .transforms import TransformTree, frame_name, parse_ros_pose

MAX_REPORT_AGE = 100_000_000
"""Longest time from a report to a frame that it speaks for [ns]; twice that between two reports around it."""
NO_ROTATION = SimpleNamespace(w=1.0, x=0.0, y=0.0, z=0.0)
"""Orientation of a tool whose reports have none."""


@dataclass(frozen=True, kw_only=True)
class ToolTrack:
    """The reports of the tool."""

    times: Int[np.ndarray, " n"]
    """Times of the reports, increasing [ns]."""
    positions: Float[np.ndarray, "n 3"]
    """Positions of the tip in the world [m]."""
    quats_wxyz: Float[np.ndarray, "n 4"]
    """Orientations in the world."""
    origins: Float[np.ndarray, "n 3"]
    """Where the origin of each report's own frame is in the world [m]."""
    n_dropped: int
    """Number of reports that are no pose, or whose frame /tf does not know at their time."""
    why_dropped: str = ""
    """Why the last of them was; empty where nothing says it."""
    rotates: bool = True
    """Whether the reports have orientations; else the tool keeps that of their frame."""

    @classmethod
    def from_messages(cls, messages: list[Any], times: TopicTimes, tree: TransformTree, world: str) -> Self:
        """Return the track of `PoseStamped` or `TransformStamped` messages.

        Raises:
            RecordingError: no message is a pose that /tf joins to the world.
        """
        found: list[tuple[int, np.ndarray, np.ndarray, np.ndarray]] = []
        failure, dropped = None, 0
        parts = [_parts(message) for message in messages]
        rotates = any(any((rotation.w, rotation.x, rotation.y, rotation.z)) for _, rotation in parts)
        for number in times.order:
            message, stamp, (position, rotation) = messages[number], times.stamps[number], parts[number]
            try:
                pose = parse_ros_pose(position, rotation if rotates else NO_ROTATION, times.topic)
                T = tree.T_world(frame_name(message.header.frame_id) or world, world, stamp, times.topic)
            except RecordingError as reason:
                failure, dropped = reason, dropped + 1
                continue
            found.append((stamp, *_in_world(T, *pose), T[:3, 3].copy()))
        if not found:
            raise failure or RecordingError(f"{times.topic} holds no pose.")
        stamps, positions, quats, origins = zip(*found, strict=True)
        return cls(
            times=np.array(stamps, np.int64),
            positions=np.array(positions),
            quats_wxyz=np.array(quats),
            origins=np.array(origins),
            n_dropped=dropped,
            why_dropped=str(failure or ""),
            rotates=rotates,
        )

    @classmethod
    def from_frame(cls, name: str, tree: TransformTree, world: str) -> Self:
        """Return the track of a frame of /tf, with a report at each message of a moving frame between it and the world.

        Raises:
            RecordingError: /tf does not join the frame to the world, or it does not move.
        """
        track, dropped = tree.over_time(frame_name(name), world, f"the tool 'tf:{name}'")
        return cls(
            times=track.times,
            positions=track.positions,
            quats_wxyz=track.quats_wxyz,
            origins=track.positions,
            n_dropped=dropped,
        )

    def scaled(self, factor: float) -> Self:
        """Return the track in another unit of the reported positions; /tf is in metres, and a frame of it stays.

        Args:
            factor: metres in the unit; 1 for none.
        """
        if factor == 1:
            return self
        return replace(self, positions=self.origins + factor * (self.positions - self.origins))

    def at(self, time: int) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 4"]]:
        """Return position [m] and orientation wxyz at a time [ns].

        Raises:
            RecordingError: no report is near enough.
        """
        after = int(np.searchsorted(self.times, time))
        if after < len(self.times) and self.times[after] == time:
            return self.positions[after], self.quats_wxyz[after]
        before = after - 1
        if before >= 0 and after < len(self.times) and self.times[after] - self.times[before] <= 2 * MAX_REPORT_AGE:
            span = int(self.times[after] - self.times[before])
            share = (time - int(self.times[before])) / span
            position = (1 - share) * self.positions[before] + share * self.positions[after]
            ends = Rotation.from_quat(self.quats_wxyz[before : after + 1], scalar_first=True)
            return position, Slerp([0.0, 1.0], ends)(share).as_quat(scalar_first=True)
        if before >= 0 and time - self.times[before] <= MAX_REPORT_AGE:
            return self.positions[before], self.quats_wxyz[before]
        raise RecordingError(f"no tool pose within {MAX_REPORT_AGE // 1_000_000} ms")

    def between(self, begin: int, end: int, origin: int) -> tuple[ToolReport, ...]:
        """Return the reports between two frames [ns], with times from an origin [ns]."""
        # `Recording` would take a report just after a frame for the frame's own.
        inside = (self.times > begin + PAIRING_TOLERANCE_NS) & (self.times < end)
        return tuple(
            ToolReport(time=int(time) - origin, position=position)
            for time, position in zip(self.times[inside], self.positions[inside], strict=True)
        )


def _parts(message: Any) -> tuple[Any, Any]:
    """Return position and orientation of a `PoseStamped` or `TransformStamped`."""
    if hasattr(message, "pose"):
        return message.pose.position, message.pose.orientation
    return message.transform.translation, message.transform.rotation


def _in_world(
    T: Float[np.ndarray, "4 4"], position: Float[np.ndarray, " 3"], quat_wxyz: Float[np.ndarray, " 4"]
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 4"]]:
    """Return a pose in the world, bit by bit the given one where its frame is the world."""
    if np.array_equal(T, np.eye(4)):
        return position, quat_wxyz
    R = T[:3, :3] @ matrix_from_quaternion(quat_wxyz)
    return T[:3, :3] @ position + T[:3, 3], Rotation.from_matrix(R).as_quat(scalar_first=True)
