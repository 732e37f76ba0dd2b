"""Recordings of observations: MCAP files that hold what an estimator may see, and nothing else.

The topics are in docs/RECORDINGS.md. Frames that fail a check are named and skipped. Does not rectify, resample or
interpolate; which messages a file may hold is in `recording_contents`.
"""

import os
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..camera import StereoCamera
from ..errors import RecordingError
from ..observation import Declaration, MeasuredPoints, Observation, StereoPair, ToolReport, ToolState
from .contents import EVENT, GRASP, LEFT, LEFT_INFO, POINTS, POSE, RIGHT, RIGHT_INFO, TF, RecordingContents
from .declaration import METADATA, file_metadata, write_declaration
from .events import EVENT_SCHEMA, event_json
from .frames import camera_transforms, transform_of_rotation
from .mcap_files import McapOutput
from .pairing import MessageGroup, Stamped, group_moments
from .schemas import (
    GRASP_SCHEMA,
    calibration_message,
    decode_image,
    grasp_json,
    image_message,
    parse_calibration,
    parse_points,
    parse_transform,
    point_cloud,
    pose_message,
)


class RecordingWriter:
    """Writes observations as they come; what is written survives a crash.

    Args:
        path: the file to write.
        camera: where the images come from; None for a recording of points.
        declaration: what the user says is known.
        metadata: the caller's own, such as the seed.
        overwrite: replace a file that is there.

    Raises:
        OutputError: the path exists, or cannot be written.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        camera: StereoCamera | None,
        declaration: Declaration,
        metadata: dict[str, str],
        overwrite: bool = False,
    ) -> None:
        self._camera = camera
        self._output = McapOutput(path, overwrite=overwrite)
        self._output.metadata(METADATA, file_metadata() | metadata)
        write_declaration(self._output, declaration)
        if camera is not None:
            self._output.message(LEFT_INFO, 0, calibration_message(camera.left, "left"))
            self._output.message(RIGHT_INFO, 0, calibration_message(camera.right, "right"))
            self._output.message(TF, 0, camera_transforms(camera))
        self._output.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()

    def write(self, observation: Observation) -> None:
        """Write one moment, and hand it to the operating system.

        Raises:
            ValueError: images without a camera to explain them.
        """
        output, time = self._output, observation.time
        for report in observation.reports:
            at_report = replace(observation.tool, position=report.position)
            output.message(POSE, report.time, pose_message(report.time, at_report))
        output.message(POSE, time, pose_message(time, observation.tool))
        output.json(GRASP, time, grasp_json(observation.tool), schema=GRASP_SCHEMA)
        for event in observation.events:
            output.json(EVENT, time, event_json(event), schema=EVENT_SCHEMA)
        if observation.images is not None:
            if self._camera is None:
                raise ValueError("RecordingWriter.camera is None, and the observation has images; give the camera.")
            output.message(LEFT, time, image_message(time, observation.images.left, "left"))
            output.message(RIGHT, time, image_message(time, observation.images.right, "right"))
        if observation.points is not None:
            output.message(POINTS, time, _points_message(time, observation.points))
        output.flush()

    def close(self) -> None:
        """Write the index and close the file."""
        self._output.close()


class Recording:
    """A recording opened for reading; iterating gives the usable observations, images decoded one moment at a time.

    `Recording.open` makes one. Iterating again starts from the beginning.
    """

    camera: StereoCamera | None
    """None where the recording has points only."""
    declaration: Declaration
    """The defaults where the file, a robot's for example, holds none."""
    metadata: dict[str, str]
    """Versions, units, seed; empty for a file that something else wrote."""
    ignored: dict[str, int]
    """Messages of topics that are not read."""
    skipped: list[tuple[int, str]]
    """Index and reason of each unusable moment of the latest iteration, as far as it went."""

    def __init__(self, contents: RecordingContents, *, tolerance_ns: int, pose_age_ns: int) -> None:
        self._contents, self._pose_age, self._tolerance = contents, pose_age_ns, tolerance_ns
        self.camera = _read_camera(contents) if contents.has_images else None
        self.declaration, self.metadata, self.ignored = contents.declaration, contents.metadata, contents.ignored
        self.skipped = []
        stamped = contents.stamped
        self._moments = group_moments(
            left=stamped[LEFT],
            right=stamped[RIGHT],
            points=stamped[POINTS],
            pose=stamped[POSE],
            grasp=stamped[GRASP],
            tolerance=tolerance_ns,
        )
        self._poses = sorted(stamped[POSE])
        self._origin = 0 if self.metadata else self._moments[0].stamp

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        *,
        allow_truncated: bool = False,
        tolerance_ns: int = 5_000_000,
        pose_age_ns: int = 100_000_000,
    ) -> Self:
        """Open a recording and read everything in it but images and points.

        Args:
            path: an MCAP file of observations.
            allow_truncated: read what is whole of a file without an end.
            tolerance_ns: largest difference between the stamps of one moment [ns].
            pose_age_ns: oldest tool pose that still says where the tool is [ns].

        Raises:
            RecordingError: missing, not an MCAP, truncated, damaged, foreign, holding truth, uncalibrated.
        """
        contents = RecordingContents(Path(path), allow_truncated=allow_truncated)
        return cls(contents, tolerance_ns=tolerance_ns, pose_age_ns=pose_age_ns)

    def __len__(self) -> int:
        """Number of moments, the unusable ones counted."""
        return len(self._moments)

    def __iter__(self) -> Iterator[Observation]:
        """Usable observations in file order."""
        self.skipped = []
        latest: int | None = None
        told: Stamped | None = None
        coming = deque(self._contents.events)
        for index, (moment, messages) in enumerate(self._messages()):
            try:
                if latest is not None and moment.stamp <= latest:
                    raise RecordingError(f"time goes backwards, from {latest} ns to {moment.stamp} ns")
                latest = moment.stamp
                observation = self._observation(index, moment, messages)
            except RecordingError as failure:
                self.skipped.append((index, str(failure)))
                continue
            events = []
            while coming and coming[0][0] <= moment.stamp + self._tolerance:
                events.append(coming.popleft()[1])
            yield replace(observation, events=tuple(events), reports=self._reports(told, moment.pose))
            told = moment.pose

    def _messages(self) -> Iterator[tuple[MessageGroup, dict[str, Any]]]:
        """Each moment with its images and points, still encoded; keeps only what a coming moment needs."""
        wanted = {message.ordinal: topic for moment in self._moments for topic, message in _parts(moment)}
        kept: dict[int, Any] = {}
        coming = iter(self._moments)
        moment = next(coming, None)
        for ordinal, message in self._contents.encoded(wanted):
            kept[ordinal] = message
            while moment is not None and all(part.ordinal <= ordinal for _, part in _parts(moment)):
                yield moment, {topic: kept.pop(part.ordinal) for topic, part in _parts(moment)}
                moment = next(coming, None)

    def _observation(self, index: int, moment: MessageGroup, messages: dict[str, Any]) -> Observation:
        images = None
        if moment.left is not None or moment.right is not None:
            images = self._images(messages)
        points = self._points(messages[POINTS]) if POINTS in messages else None
        return Observation(
            index=index,
            time=moment.stamp - self._origin,
            tool=self._tool(moment),
            images=images,
            points=points,
        )

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
            height, width = image.shape[:2]
            if (width, height) != (calibration.width, calibration.height):
                raise RecordingError(
                    f"{topic} is {width}x{height} and its calibration {calibration.width}x{calibration.height}"
                )
            decoded.append(image)
        return StereoPair(left=decoded[0], right=decoded[1])

    def _points(self, message: PointCloud) -> MeasuredPoints:
        columns = parse_points(message, POINTS)
        T = self._contents.frames.T_world(message.frame_id, POINTS) @ parse_transform(message.pose)
        positions = np.column_stack([columns[name].astype(float) for name in "xyz"])
        positions[~np.isfinite(positions).all(axis=1)] = np.nan
        if not np.array_equal(T, np.eye(4)):
            positions = positions @ T[:3, :3].T + T[:3, 3]
        known = {}
        if "sd" in columns and len(positions):
            known["sd"] = _one_sd(columns["sd"].astype(float))
        track = columns["track_id"].astype(np.int64) if "track_id" in columns else None
        return MeasuredPoints(positions=positions, track_id=track, **known)

    def _reports(self, after: Stamped | None, until: Stamped | None) -> tuple[ToolReport, ...]:
        """What the tool said between the poses of two observations, poses that are none left out."""
        if until is None:
            return ()
        reports, begin = [], 0 if after is None else bisect_right(self._poses, after)
        for one in self._poses[begin : bisect_left(self._poses, until)]:
            with suppress(RecordingError):
                tip = self._tip(self._contents.poses[one.ordinal])[:3, 3]
                reports.append(ToolReport(time=one.stamp - self._origin, position=tip))
        return tuple(reports)

    def _tip(self, pose: PoseInFrame) -> Float[np.ndarray, "4 4"]:
        """In the world."""
        return self._contents.frames.T_world(pose.frame_id, POSE) @ parse_transform(pose.pose)

    def _tool(self, moment: MessageGroup) -> ToolState:
        if moment.pose is None or moment.grasp is None:
            raise RecordingError("no tool pose or grasp has come yet")
        age = moment.stamp - moment.pose.stamp
        if age > self._pose_age:
            raise RecordingError(f"the latest tool pose is {age / 1e6:g} ms old")
        pose = self._contents.poses[moment.pose.ordinal]
        T = self._contents.frames.T_world(pose.frame_id, POSE)
        T_world_tip = self._tip(pose)
        stated = pose.pose.orientation
        quat_wxyz = np.array([stated.w, stated.x, stated.y, stated.z])
        if not (quat_wxyz.any() and np.array_equal(T, np.eye(4))):
            quat_wxyz = Rotation.from_matrix(T_world_tip[:3, :3]).as_quat(scalar_first=True)
        return ToolState(
            position=T_world_tip[:3, 3], quat_wxyz=quat_wxyz, **self._contents.grasps[moment.grasp.ordinal]
        )


def _parts(moment: MessageGroup) -> list[tuple[str, Stamped]]:
    """The messages of a moment that are decoded when their turn comes, with their topics."""
    parts = ((LEFT, moment.left), (RIGHT, moment.right), (POINTS, moment.points))
    return [(topic, message) for topic, message in parts if message is not None]


def _read_camera(contents: RecordingContents) -> StereoCamera:
    left, right = contents.calibrations[LEFT_INFO], contents.calibrations[RIGHT_INFO]
    calibration = parse_calibration(left, LEFT_INFO)
    T_world_left = contents.frames.T_world(left.frame_id, LEFT_INFO)
    return StereoCamera(
        left=calibration,
        right=parse_calibration(right, RIGHT_INFO),
        T_world_camera=T_world_left @ transform_of_rotation(calibration.R.T),
    )


def _one_sd(stated: Float[np.ndarray, " m"]) -> float:
    """The standard deviation that all points share."""
    finite = stated[np.isfinite(stated)]
    low, high = (finite.min(), finite.max()) if len(finite) else (np.nan, np.nan)
    if high > low * (1 + 1e-6):
        raise RecordingError(f"{POINTS} states sd from {low:g} to {high:g} m; all points of a cloud must share one.")
    return float(low)


def _points_message(time: int, points: MeasuredPoints) -> PointCloud:
    columns: dict[str, np.ndarray] = dict(zip("xyz", np.asarray(points.positions, float).T, strict=True))
    if points.track_id is not None:
        columns["track_id"] = points.track_id
    columns["sd"] = np.full(len(points.positions), points.sd)
    return point_cloud(time, columns)
