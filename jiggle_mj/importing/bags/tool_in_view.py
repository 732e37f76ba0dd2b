"""Whether the camera can see the tool: a wrong frame, unit or order of axes puts the tip where no camera looks."""

import numpy as np

from ...camera import StereoCamera
from ...errors import RecordingError
from .gripper import state_at
from .preparation import Preparation

MARGIN = 1.0
"""How far beyond the image's border a tip may be without a word [image sizes]: jaws may hold an edge out of view."""


def tool_in_view(camera: StereoCamera, prepared: Preparation) -> list[str]:
    """Return what to say where the tip is far outside the left image in all frames with closed jaws.

    Raises:
        RecordingError: it is behind the camera in all of them.
    """
    tips = []
    for frame in prepared.frames:
        if state_at(prepared.jaws, frame.stamp).closed:
            try:
                tips.append(prepared.tool.at(frame.stamp)[0])
            except RecordingError:
                continue
    if not tips:
        return []
    T = np.linalg.inv(camera.T_world_camera)
    seen = np.array(tips) @ T[:3, :3].T + T[:3, 3]
    shown = f"x, y, z = {np.median(seen, axis=0).round(4).tolist()} m in the left camera's frame"
    if not (seen[:, 2] > 0).any():
        raise RecordingError(
            f"with closed jaws the tip is always behind the left camera ({shown}). Is the frame of "
            f"{prepared.topic('left')} an optical one (x right, y down, z forward), and {prepared.topic('tool')} in "
            "metres?"
        )
    pixels = camera.project(np.array(tips)[seen[:, 2] > 0])[:, :2]
    size = np.array([camera.left.width, camera.left.height])
    if ((pixels > -MARGIN * size) & (pixels < (1 + MARGIN) * size)).all(axis=1).any():
        return []
    return [
        f"WARNING: with closed jaws the tip is always far outside the left image ({shown}); are the frames and "
        "units right?"
    ]
