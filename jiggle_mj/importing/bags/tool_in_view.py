"""Whether the camera can see the tool: a wrong frame, unit or order of axes puts the tip where no camera looks.

Where another unit, or another meaning of the camera's pose, puts the tip into the scene, and what is given does not, it
is named.
"""

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from ...camera import OPENCV_FROM_OPENGL, StereoCamera
from ...errors import RecordingError
from ...plausibility.problems import MAX_DEPTH_M, MAX_DISPARITY_SHARE
from ...recording.frames import transform_of_rotation
from ..grasp_table import DEFAULT_GRASP_RADIUS
from ..units import LENGTH_UNITS
from .gripper import state_at
from .preparation import Preparation
from .tool_track import ToolTrack

MARGIN = 1.0
"""How far beyond the image's border a tip may be without a word [image sizes]: jaws may hold an edge out of view."""
SCENE_FACTOR = 2.0
"""How much further or nearer than the scene a tip may be: what the jaws hold is near what has features."""
REPORTED_UNITS = ("m", "cm", "mm")
"""Units in which robots report."""
MIN_PULL_M = DEFAULT_GRASP_RADIUS
"""Extent of the tip's path in a grasp up to which another unit is none [m]: a pull is longer than the grip is wide."""
OPTICAL_IN_BODY = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Pose of the optical frame in a camera's own frame by REP-103: x forward, y left, z up."""
CAMERA_READINGS: dict[str, Callable[[Float[np.ndarray, "4 4"]], Float[np.ndarray, "4 4"]]] = {
    "as OpenGL's (y up, z backward)": lambda T: T @ OPENCV_FROM_OPENGL,
    "as a robot's (x forward, y left, z up)": lambda T: T @ OPTICAL_IN_BODY,
    "as the pose of the world in the camera": np.linalg.inv,
}
"""What the camera's pose on /tf is at times, and how it becomes that of the optical frame."""


def tool_in_view(camera: StereoCamera, prepared: Preparation, scene: tuple[float, float] | None) -> list[str]:
    """Return what to say where the tip is out of view in most frames with closed jaws.

    Args:
        camera: the cameras.
        prepared: with the tool and the jaws.
        scene: range of the disparities that the images show [px]; None where unknown.

    Raises:
        RecordingError: it is always behind the camera, or always far out of view where another reading of the bag
            always puts it into the scene.
    """
    tips, _ = _tips(prepared, prepared.tool)
    if not len(tips) or _in_scene(camera, tips, scene).mean() > 0.5:
        return []
    near = bool(_in_scene(camera, tips, scene, margin=MARGIN).any())
    readings = "; or ".join(_other_readings(camera, prepared, scene))
    if near and not readings:
        return []
    seen = camera.in_camera(tips)
    behind = not (seen[:, 2] > 0).any()
    where = "always behind the left camera" if behind else "mostly out of view" if near else "always far out of view"
    text = f"with closed jaws the tip is {where}: x, y, z = {np.median(seen, axis=0).round(4).tolist()} m (median) in "
    text += "the left camera's frame"
    if scene is not None:
        text += (
            f", and what both cameras see is {' to '.join(f'{depth:.3g}' for depth in _depths(camera, scene))} m away"
        )
    if readings:
        cure = f"It is in view {readings}."
    else:
        left, tool = prepared.topic("left"), prepared.topic("tool")
        unit = next(name for name, factor in LENGTH_UNITS.items() if factor == prepared.settings.tool_unit)
        cure = f"Is the frame of {left} an optical one (x right, y down, z forward), and {tool} in {unit}?"
    if behind or (readings and not near):
        raise RecordingError(f"{text}. {cure}")
    return [f"WARNING: {text}. {cure}"]


def _other_readings(camera: StereoCamera, prepared: Preparation, scene: tuple[float, float] | None) -> Iterator[str]:
    """Yield what would put the tip into the scene, each with its cure."""
    given = prepared.settings.tool_unit
    for unit in REPORTED_UNITS:
        if LENGTH_UNITS[unit] == given:
            continue
        tips, pull = _tips(prepared, prepared.tool.scaled(LENGTH_UNITS[unit] / given))
        if pull > MIN_PULL_M and _in_scene(camera, tips, scene).all():
            yield f'if its poses are in {unit}: give [tool] unit = "{unit}" in map.toml (--topics)'
    tips, _ = _tips(prepared, prepared.tool)
    rectifying = transform_of_rotation(camera.left.R)
    for reading, optical in CAMERA_READINGS.items():
        T = optical(camera.T_world_camera @ rectifying) @ rectifying.T
        if _in_scene(replace(camera, T_world_camera=T), tips, scene).all():
            yield (
                f"if the camera's pose on /tf is read {reading}: publish that of its optical frame (x right, y down, z "
                "forward) in its parent"
            )


def _tips(prepared: Preparation, tool: ToolTrack) -> tuple[Float[np.ndarray, "n 3"], float]:
    """Return where the tip is in the frames with closed jaws, and the largest extent of its path in a grasp [m]."""
    grasps: dict[int, list[Float[np.ndarray, " 3"]]] = {}
    for frame in prepared.frames:
        jaws = state_at(prepared.jaws, frame.stamp)
        if jaws.closed:
            with suppress(RecordingError):
                grasps.setdefault(jaws.grasp, []).append(tool.at(frame.stamp)[0])
    pull = max((float(np.ptp(tips, axis=0).max()) for tips in grasps.values()), default=0.0)
    return np.array([tip for tips in grasps.values() for tip in tips]).reshape(-1, 3), pull


def _in_scene(
    camera: StereoCamera, tips: Float[np.ndarray, "n 3"], scene: tuple[float, float] | None, *, margin: float = 0.0
) -> Bool[np.ndarray, " n"]:
    """Return which tips are within a margin of the left image [image sizes], and as far away as the scene."""
    size = np.array([camera.left.width, camera.left.height])
    if scene is None:
        nearest, farthest = camera.focal[0] * camera.baseline / (MAX_DISPARITY_SHARE * size[0]), MAX_DEPTH_M
    else:
        nearest, farthest = _depths(camera, scene)
        nearest, farthest = nearest / SCENE_FACTOR, farthest * SCENE_FACTOR
    depth = camera.in_camera(tips)[:, 2]
    inside = (depth >= nearest) & (depth <= farthest)
    pixels = camera.project(tips[inside])[:, :2]
    inside[inside] = ((pixels > -margin * size) & (pixels < (1 + margin) * size)).all(axis=1)
    return inside


def _depths(camera: StereoCamera, scene: tuple[float, float]) -> tuple[float, float]:
    """Return the distances of what is near and far in the scene [m]."""
    low, high = scene
    return camera.focal[0] * camera.baseline / high, camera.focal[0] * camera.baseline / low
