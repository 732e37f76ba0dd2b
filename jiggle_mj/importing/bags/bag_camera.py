"""The stereo camera of a bag: calibrations from its topics or from files, and where /tf has it.

It stands still: one that trembles has its mean pose, one that moves is refused.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from ...camera import StereoCamera
from ...errors import RecordingError
from ...observation import MeasuredPoints
from .bag_file import Bag
from .bag_paths import listed
from .calibration import CameraSource, parse_camera_info, read_camera_file, stereo_camera
from .roles import RoleChoice, is_rectified
from .settings import BagSettings, Role, Side
from .survey import BagSurvey
from .tool_track import ToolTrack
from .transforms import TransformTree

MAX_CAMERA_TREMBLE_M = MeasuredPoints.sd
"""Largest root mean square of what a trembling camera shifts at the tool's place [m]: the noise of a measured point.
A camera of 500 px focal length, 0.1 m away, sees it as a pixel."""


def bag_camera(
    bag: Bag,
    survey: BagSurvey,
    roles: dict[Role, RoleChoice],
    settings: BagSettings,
    world: str,
    tool: ToolTrack,
    notes: list[str],
) -> tuple[StereoCamera, bool]:
    """Return the stereo camera of a bag, and whether only its images can tell left from right.

    Args:
        bag: the open bag.
        survey: its first pass.
        roles: topic of each role.
        settings: what the user says.
        world: frame that counts as the world.
        tool: where the tip is.
        notes: what the user should know is added here.

    Raises:
        RecordingError: the camera moves, or its calibration is refused.
    """
    sources: dict[Role, CameraSource] = {}
    sides: tuple[tuple[Side, Role], ...] = (("left", "left_info"), ("right", "right_info"))
    for side, info in sides:
        frame = survey.frame[side]
        if side in settings.camera_info:
            sources[side] = read_camera_file(settings.camera_info[side], frame)
            continue
        messages, where = survey.messages[info], roles[info].topic
        sources[side] = parse_camera_info(messages[0], where, frame or survey.frame[info])
        if any(not _same_info(messages[0], other) for other in messages[1:]):
            notes.append(f"{where} changes during the bag (zoom or focus?); its first message is used")
    left, right, tree = sources["left"].frame, sources["right"].frame, survey.tree
    stamp = min(survey.times["left"].stamps)
    where = roles["left"].topic
    if left and left != world and tree.moving(left, world):
        T_world_left = _mean_pose(bag, tree, left, world, where, tool, notes)
    else:
        T_world_left = tree.T_world(left or world, world, stamp, where)
    T_left_right = None
    if left and right and left != right and left in tree.names and right in tree.names:
        if tree.root(left) == tree.root(right):
            root = tree.root(left)
            T_left_right = np.linalg.inv(tree.T_world(left, root, stamp, where)) @ tree.T_world(
                right, root, stamp, where
            )
    rectified = is_rectified(where) if settings.rectified is None else settings.rectified
    camera, unsure, said = stereo_camera(
        sources["left"],
        sources["right"],
        T_world_left=T_world_left,
        T_left_right=T_left_right,
        rectified=rectified,
    )
    raw = "rectified" if rectified else "raw"
    notes += [*said, f"{camera.left.width}x{camera.left.height} {raw} images, baseline {1e3 * camera.baseline:.4g} mm"]
    return camera, unsure


def _mean_pose(
    bag: Bag, tree: TransformTree, left: str, world: str, where: str, tool: ToolTrack, notes: list[str]
) -> Float[np.ndarray, "4 4"]:
    """Return the mean pose of a camera that trembles on /tf.

    Raises:
        RecordingError: it moves what it sees at the tool by more than `MAX_CAMERA_TREMBLE_M`.
    """
    track, _ = tree.over_time(left, world, where)
    stray = track.stray(np.median(tool.positions, axis=0))
    size = float(np.sqrt(np.mean(stray**2)))
    shown = f"at the tool's place it strays by {1e3 * size:.3g} mm rms, at most {1e3 * stray.max():.3g} mm"
    if size > MAX_CAMERA_TREMBLE_M:
        frames = listed(name for name, _ in tree.moving(left, world))
        raise RecordingError(
            f"{bag.path}: the camera moves on /tf ({frames}): {shown}, from its mean; up to "
            f"{1e3 * MAX_CAMERA_TREMBLE_M:g} mm rms it counts as standing still. Import a part of the bag in which it "
            "stands still, or name a frame that moves with the tissue with --world."
        )
    notes.append(f"the camera trembles on /tf: {shown}; its mean pose is used")
    return track.mean()


def _same_info(first: Any, other: Any) -> bool:
    """Return whether two CameraInfo messages have the same matrices."""
    names = ("k", "d", "r", "p") if hasattr(first, "k") else ("K", "D", "R", "P")
    return all(np.array_equal(getattr(first, name), getattr(other, name)) for name in names)
