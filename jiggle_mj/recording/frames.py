"""Coordinate frames of a recording: the transform from any named frame to the world.

Frames stand still: a recording gives each one pose, and the transform of a frame that moves is refused.
Optical frames belong to the raw images; rectification rotates them by the calibration's R, as in ROS's image_proc.
"""

from collections.abc import Iterable

import numpy as np
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from jaxtyping import Float

from ..camera import StereoCamera
from ..errors import MAX_SHOWN, RecordingError
from .schemas import CAMERA_FRAMES, WORLD, frame_transform, parse_transform

MAX_STATIC_CHANGE = 1e-6
"""Largest change of a static transform's entries [m, or 1 for a cosine]: the rounding of a robot's messages."""

MAX_FRAMES = 10_000
"""Most frames of a recording; a robot has a hundred."""


class FrameTree:
    """Coordinate frames by name, each with its parent and its pose in the parent."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Float[np.ndarray, "4 4"]]] = {}
        self._moving: set[str] = set()

    def add(self, transforms: Iterable[FrameTransform]) -> None:
        """Add the transforms of one message.

        Raises:
            RecordingError: a transform holds NaN, or its quaternion is not of unit length.
        """
        for transform in transforms:
            child, parent = transform.child_frame_id[:MAX_SHOWN], transform.parent_frame_id[:MAX_SHOWN]
            if len(self._parents) > MAX_FRAMES:
                raise RecordingError(f"/tf has more than {MAX_FRAMES} frames.")
            try:
                T = parse_transform(transform)
            except RecordingError as failure:
                raise RecordingError(f"/tf from {parent} to {child}: {failure}.") from failure
            known_parent, known = self._parents.setdefault(child, (parent, T))
            if known_parent != parent or not np.allclose(known, T, rtol=0, atol=MAX_STATIC_CHANGE):
                self._moving.add(child)

    def T_world(self, frame: str, where: str) -> Float[np.ndarray, "4 4"]:
        """Return the pose of a frame in the world; an empty name is the world.

        Raises:
            RecordingError: the frame is not connected to the world, or moves.
        """
        T, name, passed = np.eye(4), frame or WORLD, set()
        while name != WORLD:
            if name not in self._parents or name in passed:
                raise RecordingError(f"{where}: /tf does not lead from '{WORLD}' to the frame '{frame[:MAX_SHOWN]}'.")
            if name in self._moving:
                raise RecordingError(
                    f"{where}: the frame '{name}' moves on /tf; only frames that stand still are read."
                )
            passed.add(name)
            name, T_parent_child = self._parents[name]
            T = T_parent_child @ T
        return T


def transform_of_rotation(R: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4 4"]:
    """Return a rotation as a transform without translation."""
    T = np.eye(4)
    T[:3, :3] = R
    return T


def camera_transforms(camera: StereoCamera) -> FrameTransforms:
    """Return the poses of both raw optical frames: the left one in the world, the right one in the left one.

    The baseline lies along the rectified x.
    """
    left, right = CAMERA_FRAMES["left"], CAMERA_FRAMES["right"]
    T_rectified_raw = {side: transform_of_rotation(getattr(camera, side).R) for side in ("left", "right")}
    T_left_right = np.eye(4)
    T_left_right[0, 3] = camera.baseline
    return FrameTransforms(
        transforms=[
            frame_transform(WORLD, left, camera.T_world_camera @ T_rectified_raw["left"]),
            frame_transform(left, right, T_rectified_raw["left"].T @ T_left_right @ T_rectified_raw["right"]),
        ]
    )
