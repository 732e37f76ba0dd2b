"""Decoding the messages of one frame into an observation in the world frame, in SI units."""

from bisect import bisect_left, bisect_right
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..camera import StereoCamera
from ..errors import RecordingError
from ..observation import MeasuredForce, MeasuredPoints, Observation, StereoPair, ToolReport, ToolState
from ..toml_kinds import MAX_COUNT
from .contents import RecordingContents
from .force import TOOL
from .images import decode_image, refuse_other_size
from .pairing import MessageGroup, Stamped
from .schemas import parse_points, parse_transform
from .stored_arrays import MAX_LENGTH_M, StoredArrays
from .topics import FORCE, LEFT, POINTS, POSE, RIGHT

MAX_SPAN_M = 20.0
"""Largest extent of a cloud [m]: a room. A sheet of 2 cm and more is larger in millimetres."""
MAX_SD_M = 1.0
"""Largest standard deviation of a point [m]; a hundredth of it already hides every pull."""
EQUAL_SD = 1e-6
"""Largest relative difference of two standard deviations that count as one: the rounding of float32."""


@dataclass(frozen=True, kw_only=True)
class ObservationReader:
    """Decoder of the messages of one group into an observation in the world frame."""

    contents: RecordingContents
    """The file that holds frames, poses and grasps."""
    camera: StereoCamera | None
    """The calibrated stereo camera; None where the recording has points only."""
    poses: list[Stamped]
    """Every tool pose of the file, by stamp."""
    origin: int
    """Stamp that counts as time 0 [ns]."""
    max_pose_age: int
    """Age above which a tool pose no longer says where the tool is, nor a force how hard it pulls [ns]."""
    tolerance: int
    """Time up to which a force may come after its frame [ns]."""

    def read(self, index: int, group: MessageGroup, messages: dict[str, Any], *, images: bool = True) -> Observation:
        """Decode one group; its events and reports are added by `Recording`.

        Args:
            index: position of the group in the recording.
            group: which messages belong together.
            messages: the encoded images and points by topic.
            images: whether to decode the images.

        Raises:
            RecordingError: half of a stereo pair is missing, an image cannot be decoded or has another size than its
                calibration, a pose is not one, a frame is not joined to the world, the tool pose is missing or too old.
        """
        pair = None
        if images and (group.left is not None or group.right is not None):
            pair = self._images(messages)
        points = self._points(messages[POINTS]) if POINTS in messages else None
        tool = self._tool(group)
        return Observation(
            index=index,
            time=group.stamp - self.origin,
            tool=tool,
            images=pair,
            points=points,
            force=self._force(group.stamp, tool) if self.why_no_force is None else None,
        )

    @cached_property
    def why_no_force(self) -> str | None:
        """Why the forces of the file cannot be used; None where they can, or where there is none."""
        try:
            for frame in {force.frame_id for force in self.contents.forces} - {TOOL}:
                self.contents.frames.T_world(frame, FORCE)
        except RecordingError as failure:
            return str(failure)
        return None

    def _force(self, stamp: int, tool: ToolState) -> MeasuredForce | None:
        """Return the latest force up to the tolerance of poses before a frame, in the world.

        None where it is old, or no number: then an earlier one would be of another frame.
        """
        forces = self.contents.forces
        place = bisect_right(forces, stamp + self.tolerance, key=lambda force: force.time)
        if not place or stamp - forces[place - 1].time > self.max_pose_age:
            return None
        force = forces[place - 1]
        if not force.is_measured:
            return None
        if force.frame_id == TOOL:
            rotation = Rotation.from_quat(tool.quat_wxyz, scalar_first=True).as_matrix()
        else:
            rotation = self.contents.frames.T_world(force.frame_id, FORCE)[:3, :3]
        return MeasuredForce(on_tool=rotation @ np.array(force.force), sd=force.sd)

    def reports(self, after: Stamped | None, until: Stamped | None) -> tuple[ToolReport, ...]:
        """Return the tool's reports strictly between the poses of two observations; malformed poses are left out."""
        if until is None:
            return ()
        reports, begin = [], 0 if after is None else bisect_right(self.poses, after)
        for pose in self.poses[begin : bisect_left(self.poses, until)]:
            with suppress(RecordingError):
                tip = self._T_world_tip(self.contents.poses[pose.ordinal])[:3, 3]
                reports.append(ToolReport(time=pose.stamp - self.origin, position=tip))
        return tuple(reports)

    def _images(self, messages: dict[str, Any]) -> StereoPair:
        assert self.camera is not None
        decoded = []
        for topic, calibration in ((LEFT, self.camera.left), (RIGHT, self.camera.right)):
            if topic not in messages:
                raise RecordingError(f"missing half of the stereo pair: {topic}")
            try:
                image = decode_image(messages[topic])
            except RecordingError as failure:
                raise RecordingError(f"{topic} {failure}") from failure
            refuse_other_size(image, calibration, topic)
            decoded.append(image)
        return StereoPair(left=decoded[0], right=decoded[1])

    def _points(self, message: PointCloud) -> MeasuredPoints:
        columns = StoredArrays(parse_points(message, POINTS), POINTS)
        T = self.contents.frames.T_world(message.frame_id, POINTS) @ parse_transform(message.pose)
        positions = np.column_stack([columns.numbers(name, (None,)) for name in "xyz"])
        positions[~np.isfinite(positions).all(axis=1)] = np.nan
        _refuse_span(positions)
        if not np.array_equal(T, np.eye(4)):
            positions = positions @ T[:3, :3].T + T[:3, 3]
        stated = ("sd", "smooth_sd", "smooth_length") if len(positions) else ()
        known = {name: _common(columns.numbers(name, (None,)), name) for name in stated if name in columns}
        track = None
        if "track_id" in columns:
            track = columns.indices("track_id", (None,), from_=-MAX_COUNT, below=MAX_COUNT)
        return MeasuredPoints(positions=positions, track_id=track, sd_stated="sd" in known, **known)

    def _T_world_tip(self, pose: PoseInFrame) -> Float[np.ndarray, "4 4"]:
        return self.contents.frames.T_world(pose.frame_id, POSE) @ parse_transform(pose.pose)

    def _tool(self, group: MessageGroup) -> ToolState:
        if group.pose is None or group.grasp is None:
            raise RecordingError("no tool pose or grasp has come yet")
        age = group.stamp - group.pose.stamp
        if age > self.max_pose_age:
            raise RecordingError(f"the latest tool pose is {age / 1e6:g} ms old")
        pose = self.contents.poses[group.pose.ordinal]
        T = self.contents.frames.T_world(pose.frame_id, POSE)
        T_world_tip = self._T_world_tip(pose)
        orientation = pose.pose.orientation
        quat_wxyz = np.array([orientation.w, orientation.x, orientation.y, orientation.z])
        if not (quat_wxyz.any() and np.array_equal(T, np.eye(4))):
            quat_wxyz = Rotation.from_matrix(T_world_tip[:3, :3]).as_quat(scalar_first=True)
        return ToolState(position=T_world_tip[:3, 3], quat_wxyz=quat_wxyz, **self.contents.grasps[group.grasp.ordinal])


def _refuse_span(positions: Float[np.ndarray, "m 3"]) -> None:
    """Refuse a cloud that is larger than any sheet or scene; it is the likeliest one in millimetres."""
    seen = positions[~np.isnan(positions[:, 0])]
    if len(seen) and (np.abs(seen) > MAX_LENGTH_M).any():
        raise RecordingError(f"{POINTS} has a point beyond {MAX_LENGTH_M:g} m")
    span = float(np.ptp(seen, axis=0).max()) if len(seen) else 0.0
    if span > MAX_SPAN_M:
        raise RecordingError(
            f"{POINTS} spans {span:.4g} m; PointCloud is in metres, and at most {MAX_SPAN_M:g} m are read (is it in "
            f"millimetres? then it spans {span / 1e3:.4g} m)"
        )


def _common(lengths: Float[np.ndarray, " m"], name: str) -> float:
    """Return the number that all points of a cloud share, of their noise [m]; refuse two different ones."""
    finite = lengths[np.isfinite(lengths)]
    low, high = (finite.min(), finite.max()) if len(finite) else (np.nan, np.nan)
    if high > low * (1 + EQUAL_SD):
        raise RecordingError(f"{POINTS} has {name} from {low:g} to {high:g} m; all points of a cloud must share one.")
    if low > MAX_SD_M:
        raise RecordingError(
            f"{POINTS} has an {name} of {low:g} m; at most {MAX_SD_M:g} m are read (is it in millimetres?)"
        )
    return float(low)
