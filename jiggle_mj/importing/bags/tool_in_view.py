"""Whether the camera can see the tool: a wrong frame, unit or order of axes puts the tip where no camera looks.

Where another unit, or the inverse of the camera's pose, puts the tip into the scene, and what is given does not, it is
named.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ...camera import StereoCamera
from ...errors import RecordingError
from ...observation import MeasuredPoints
from ...plausibility.problems import MAX_DEPTH_M, MAX_DISPARITY_SHARE
from ...recording.frames import transform_of_rotation
from ..units import LENGTH_UNITS
from .gripper import state_at
from .preparation import Preparation
from .tool_track import ToolTrack

MARGIN = 1.0
"""How far beyond the image's border a tip may be without a word [image sizes]: jaws may hold an edge out of view."""
SCENE_FACTOR = 2.0
"""How much further or nearer than the scene a tip may be: what the jaws hold is near what has features."""
OTHER_UNITS = ("cm", "mm")
"""Units in which robots report beside metres."""
MIN_PULL_M = 3 * MeasuredPoints.sd
"""Extent of the tip's path with closed jaws below which another unit is none [m]: such a pull is noise."""


def tool_in_view(camera: StereoCamera, prepared: Preparation, scene: tuple[float, float] | None) -> list[str]:
    """Return what to say where the tip is far from what the cameras see in all frames with closed jaws.

    Args:
        camera: the cameras.
        prepared: with the tool and the jaws.
        scene: range of the disparities that the images show [px]; None where unknown.

    Raises:
        RecordingError: it is behind the camera in all of them, or another reading of the bag puts it into the scene.
    """
    tips = _tips(prepared, prepared.tool)
    if not len(tips) or _in_scene(camera, tips, scene, margin=MARGIN):
        return []
    T = np.linalg.inv(camera.T_world_camera)
    seen = tips @ T[:3, :3].T + T[:3, 3]
    tool, shown = prepared.topic("tool"), f"x, y, z = {np.median(seen, axis=0).round(4).tolist()} m"
    cures = list(_other_readings(camera, prepared, scene))
    behind = not (seen[:, 2] > 0).any()
    if cures or behind:
        where = "behind the left camera" if behind else "far from what the left camera sees"
        cure = " Or: ".join(cures) or (
            f"Is the frame of {prepared.topic('left')} an optical one (x right, y down, z forward), and {tool} in "
            "metres?"
        )
        raise RecordingError(f"with closed jaws the tip is always {where} ({shown} in the left camera's frame). {cure}")
    return [
        f"WARNING: with closed jaws the tip is always far from what the left camera sees ({shown} in its frame"
        + (
            ""
            if scene is None
            else f"; what both cameras see is {_depth(camera, scene[1]):.3g} to {_depth(camera, scene[0]):.3g} m away"
        )
        + "); are the frames and units right?"
    ]


def _other_readings(camera: StereoCamera, prepared: Preparation, scene: tuple[float, float] | None) -> Iterator[str]:
    """Yield what would put the tip into the scene, each with its cure."""
    for unit in OTHER_UNITS:
        tips = _tips(prepared, prepared.tool.scaled(LENGTH_UNITS[unit]))
        if np.ptp(tips, axis=0).max() > MIN_PULL_M and _in_scene(camera, tips, scene, margin=0.0):
            yield f'Read in {unit} it is in view: give [tool] unit = "{unit}" in map.toml (--topics).'
    rectifying = transform_of_rotation(camera.left.R)
    inverse = np.linalg.inv(camera.T_world_camera @ rectifying) @ rectifying.T
    if _in_scene(replace(camera, T_world_camera=inverse), _tips(prepared, prepared.tool), scene, margin=0.0):
        yield (
            "With the inverse of the camera's pose it is in view: /tf must hold the pose of the camera in its parent, "
            "not that of the parent in the camera."
        )


def _tips(prepared: Preparation, tool: ToolTrack) -> Float[np.ndarray, "n 3"]:
    """Return where the tip is in the frames with closed jaws [m]."""
    tips: list[Float[np.ndarray, " 3"]] = []
    for frame in prepared.frames:
        if state_at(prepared.jaws, frame.stamp).closed:
            try:
                tips.append(tool.at(frame.stamp)[0])
            except RecordingError:
                continue
    return np.array(tips).reshape(-1, 3)


def _in_scene(
    camera: StereoCamera, tips: Float[np.ndarray, "n 3"], scene: tuple[float, float] | None, *, margin: float
) -> bool:
    """Return whether a tip is within a margin of the left image [image sizes], and as far away as the scene."""
    T = np.linalg.inv(camera.T_world_camera)
    before = tips[(tips @ T[:3, :3].T + T[:3, 3])[:, 2] > 0]
    size = np.array([camera.left.width, camera.left.height])
    uvd = camera.project(before)
    if scene is None:
        low, high = camera.focal[0] * camera.baseline / MAX_DEPTH_M, MAX_DISPARITY_SHARE * camera.left.width
    else:
        low, high = scene[0] / SCENE_FACTOR, scene[1] * SCENE_FACTOR
    inside = ((uvd[:, :2] > -margin * size) & (uvd[:, :2] < (1 + margin) * size)).all(axis=1)
    return bool((inside & (uvd[:, 2] >= low) & (uvd[:, 2] <= high)).any())


def _depth(camera: StereoCamera, disparity: float) -> float:
    return camera.focal[0] * camera.baseline / disparity
