"""The tree of coordinate frames of a bag: /tf and /tf_static, looked up at a time.

A frame is one of three: it stands still, it trembles by less than `MAX_TREMBLE_M` and `MAX_TREMBLE_RAD` (the noise of
an encoder or of a calibration that is published again and again), which counts as standing still at its mean, or it
moves. Between two messages a moving frame is interpolated. Conventions: REP-105; a leading slash of ROS 1 is dropped.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation, Slerp

from ...errors import RecordingError
from ...recording.schemas import refuse_bad_pose
from .bag_paths import listed

MAX_TREMBLE_M = 2e-4
"""Largest distance of a still frame from its mean position [m]: the noise of a measured point."""
MAX_TREMBLE_RAD = 2e-3
"""Largest rotation of a still frame from its mean [rad]: 0.2 mm at a working distance of 0.1 m."""
MAX_DISTANCE = 1e6
"""Largest coordinate of a pose [m]: beyond any map, and below where squares overflow."""
MAX_TRANSFORM_GAP = 500_000_000
"""Longest time between two messages of a moving frame over which it is interpolated [ns]."""


@dataclass(frozen=True, kw_only=True)
class FrameMotion:
    """How far a frame strays from its mean pose in its parent."""

    distance: float
    """Largest distance [m]."""
    angle: float
    """Largest rotation [rad]."""

    @property
    def still(self) -> bool:
        """Return whether the frame at most trembles."""
        return self.distance <= MAX_TREMBLE_M and self.angle <= MAX_TREMBLE_RAD


@dataclass(frozen=True, kw_only=True)
class FrameTrack:
    """The poses of one frame in its parent."""

    parent: str
    """Name of the parent frame."""
    times: Int[np.ndarray, " n"]
    """Stamps, increasing [ns]."""
    positions: Float[np.ndarray, "n 3"]
    """Positions in the parent [m]."""
    quats_wxyz: Float[np.ndarray, "n 4"]
    """Orientations in the parent."""

    def mean(self) -> Float[np.ndarray, "4 4"]:
        """Return the mean pose; that of the first message bit by bit where all are equal."""
        T = np.eye(4)
        quats = Rotation.from_quat(self.quats_wxyz, scalar_first=True)
        equal = (self.quats_wxyz == self.quats_wxyz[0]).all() and (self.positions == self.positions[0]).all()
        T[:3, :3] = quats[0].as_matrix() if equal else quats.mean().as_matrix()
        T[:3, 3] = self.positions[0] if equal else self.positions.mean(axis=0)
        return T

    def motion(self) -> FrameMotion:
        """Return how far the frame strays from its mean."""
        mean = self.mean()
        rotations = Rotation.from_matrix(mean[:3, :3]).inv() * Rotation.from_quat(self.quats_wxyz, scalar_first=True)
        distances = np.linalg.norm(self.positions - mean[:3, 3], axis=1)
        return FrameMotion(distance=float(distances.max()), angle=float(rotations.magnitude().max()))

    def stray(self, place: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " n"]:
        """Return how far each pose moves a place from where the mean pose has it [m].

        Args:
            place: in the parent [m].
        """
        T = self.mean()
        inside = T[:3, :3].T @ (place - T[:3, 3])
        moved = Rotation.from_quat(self.quats_wxyz, scalar_first=True).apply(inside) + self.positions
        return np.linalg.norm(moved - place, axis=1)

    def at(self, time: int, name: str) -> Float[np.ndarray, "4 4"]:
        """Return the pose at a time [ns], interpolated between the two nearest messages.

        Raises:
            RecordingError: the messages around the time are more than `MAX_TRANSFORM_GAP` away.
        """
        after = int(np.searchsorted(self.times, time))
        nearest = [k for k in (after - 1, after) if 0 <= k < len(self.times)]
        gap = max(abs(int(self.times[k]) - time) for k in nearest) if nearest else MAX_TRANSFORM_GAP + 1
        if after < len(self.times) and self.times[after] == time:
            nearest, gap = [after], 0
        if gap > MAX_TRANSFORM_GAP:
            raise RecordingError(f"/tf has no pose of the moving frame '{name}' around {time} ns")
        T = np.eye(4)
        if len(nearest) == 1:
            T[:3, :3] = Rotation.from_quat(self.quats_wxyz[nearest[0]], scalar_first=True).as_matrix()
            T[:3, 3] = self.positions[nearest[0]]
            return T
        before = after - 1
        share = (time - int(self.times[before])) / int(self.times[after] - self.times[before])
        ends = Rotation.from_quat(self.quats_wxyz[before : after + 1], scalar_first=True)
        T[:3, :3] = Slerp([0.0, 1.0], ends)(share).as_matrix()
        T[:3, 3] = (1 - share) * self.positions[before] + share * self.positions[after]
        return T


class TransformTree:
    """All frames of a bag, by name."""

    def __init__(self) -> None:
        self._samples: dict[str, list[tuple[int, Float[np.ndarray, " 3"], Float[np.ndarray, " 4"]]]] = {}
        self._parents: dict[str, str] = {}
        self._tracks: dict[str, FrameTrack] = {}
        self._means: dict[str, Float[np.ndarray, "4 4"] | None] = {}
        self._refused: dict[str, list[str]] = {}

    def add(self, transform: Any, time: int) -> None:
        """Add one `geometry_msgs/TransformStamped` at a time [ns]; one that is no pose is left out, as tf2 does.

        Raises:
            RecordingError: a frame with two parents.
        """
        child, parent = frame_name(transform.child_frame_id), frame_name(transform.header.frame_id)
        known = self._parents.setdefault(child, parent)
        if known != parent:
            raise RecordingError(
                f"/tf gives the frame '{child}' two parents, '{known}' and '{parent}'; a frame has one. Record without "
                "one of the two publishers."
            )
        try:
            pose = parse_ros_pose(transform.transform.translation, transform.transform.rotation, f"/tf of '{child}'")
        except RecordingError as failure:
            self._refused.setdefault(child, []).append(str(failure))
            return
        self._samples.setdefault(child, []).append((time, *pose))

    def left_out(self) -> list[str]:
        """Return what was left out, one sentence for each frame."""
        return [f"{reasons[0]}; {len(reasons)} such messages are left out" for reasons in self._refused.values()]

    @property
    def names(self) -> set[str]:
        """Return the names of all frames."""
        return set(self._parents) | set(self._parents.values())

    def root(self, name: str) -> str:
        """Return the frame at the root of the tree that a frame belongs to.

        Raises:
            RecordingError: the frames form a circle.
        """
        passed = {name}
        while name in self._parents:
            name = self._parents[name]
            if name in passed:
                raise RecordingError(f"/tf is a circle: the frame '{name}' is its own parent.")
            passed.add(name)
        return name

    def track(self, name: str) -> FrameTrack:
        """Return the poses of a frame that /tf names, by time; of two at one time the first.

        Raises:
            RecordingError: all of its messages were left out.
        """
        if name not in self._tracks:
            if name not in self._samples:
                raise RecordingError(f"{self._refused[name][0]}; so are all its messages.")
            samples = sorted(self._samples[name], key=lambda sample: sample[0])
            times, first = np.unique(np.array([time for time, _, _ in samples], np.int64), return_index=True)
            self._tracks[name] = FrameTrack(
                parent=self._parents[name],
                times=times,
                positions=np.array([samples[k][1] for k in first]),
                quats_wxyz=np.array([samples[k][2] for k in first]),
            )
        return self._tracks[name]

    def moving(self, name: str, world: str) -> list[tuple[str, FrameMotion]]:
        """Return the frames between a frame and the world that move, each with how far."""
        chain = self._chain(name, world, "/tf")
        motions = [(each, self.track(each).motion()) for each in chain]
        return [(each, motion) for each, motion in motions if not motion.still]

    def over_time(self, name: str, world: str, where: str) -> tuple[FrameTrack, int]:
        """Return the poses of a frame in the world at each message of a moving frame between them.

        The number is that of messages at which another moving frame between them has no pose.

        Raises:
            RecordingError: /tf does not join them, or no frame between them moves.
        """
        times = [self.track(each).times for each, _ in self.moving(name, world)]
        poses: dict[int, Float[np.ndarray, "4 4"]] = {}
        failure = RecordingError(f"{where}: its frame '{name}' does not move on /tf; is it the right frame?")
        every = np.unique(np.concatenate([*times, np.empty(0, np.int64)])).tolist()
        for time in every:
            try:
                poses[time] = self.T_world(name, world, time, where)
            except RecordingError as reason:
                failure = reason
        if not poses:
            raise failure
        T = np.array(list(poses.values()))
        track = FrameTrack(
            parent=world,
            times=np.array(list(poses), np.int64),
            positions=T[:, :3, 3],
            quats_wxyz=Rotation.from_matrix(T[:, :3, :3]).as_quat(scalar_first=True),
        )
        return track, len(every) - len(poses)

    def T_world(self, name: str, world: str, time: int, where: str) -> Float[np.ndarray, "4 4"]:
        """Return the pose of a frame in the world at a time [ns].

        Args:
            name: the frame.
            world: the frame that counts as the world: an ancestor of `name`.
            time: on the bag's clock [ns].
            where: what is in the frame, for the message.

        Raises:
            RecordingError: no way from the frame to the world, or no message around that time.
        """
        T = np.eye(4)
        for each in self._chain(name, world, where):
            if each not in self._means:
                track = self.track(each)
                self._means[each] = track.mean() if track.motion().still else None
            mean = self._means[each]
            T = (self.track(each).at(time, each) if mean is None else mean) @ T
        return T

    def _chain(self, name: str, world: str, where: str) -> list[str]:
        chain: list[str] = []
        while name != world:
            if name not in self._parents or name in chain:
                raise RecordingError(
                    f"{where} is in the frame '{chain[0] if chain else name}', and /tf does not lead from there to "
                    f"'{world}' (it ends at '{name}'; frames: {listed(sorted(self.names))}). Record "
                    "/tf and /tf_static, or name another common frame with --world."
                )
            chain.append(name)
            name = self._parents[name]
        return chain


def frame_name(name: str) -> str:
    """Return a frame's name without the leading slash of ROS 1."""
    return name.lstrip("/")


def parse_ros_pose(
    position: Any, orientation: Any, where: str
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 4"]]:
    """Return position [m] and quaternion wxyz of a ROS pose or transform.

    Raises:
        RecordingError: NaN, or a quaternion that is zero or not of unit length.
    """
    xyz = np.array([position.x, position.y, position.z], float)
    wxyz = np.array([orientation.w, orientation.x, orientation.y, orientation.z], float)
    try:
        if not wxyz.any():
            raise RecordingError("the rotation is not set: all of its quaternion is 0 (w = 1 is no rotation)")
        if np.abs(xyz).max() > MAX_DISTANCE or np.abs(wxyz).max() > 2:
            raise RecordingError(f"position {xyz.tolist()} m, quaternion wxyz {wxyz.tolist()} is no pose")
        refuse_bad_pose(xyz, wxyz)
    except RecordingError as failure:
        raise RecordingError(f"{where}: {failure}") from failure
    return xyz, wxyz
