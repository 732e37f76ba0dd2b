"""The stereo pair in the model: two fixed MuJoCo cameras next to each other, and their calibration.

A pixel's centre is the integer, as in `jiggle_mj.camera`; so the principal point is ((w-1)/2, (h-1)/2).
"""

import math

import mujoco
import numpy as np
from jaxtyping import Float

from jiggle_mj.camera import StereoCamera, as_recorded, optical_from_opengl

from ..scene.scene import CameraConfig

CAMERA_NAMES = ("left", "right")
"""Names of the two cameras in the model."""


def _rotation(camera: CameraConfig) -> Float[np.ndarray, "3 3"]:
    """Return the world axes of the OpenGL camera, as columns x (right), y (up), z (backwards)."""
    tilt = math.radians(camera.tilt_deg)
    return np.array([[1, 0, 0], [0, math.cos(tilt), -math.sin(tilt)], [0, math.sin(tilt), math.cos(tilt)]])


def _position(camera: CameraConfig, name: str) -> Float[np.ndarray, " 3"]:
    rotation = _rotation(camera)
    side = -0.5 if name == "left" else 0.5
    return np.array(camera.target) + camera.distance * rotation[:, 2] + side * camera.baseline * rotation[:, 0]


def add_cameras(spec: mujoco.MjSpec, camera: CameraConfig) -> None:
    """Add both cameras to the world body."""
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, _rotation(camera).ravel())
    for name in CAMERA_NAMES:
        spec.worldbody.add_camera(name=name, pos=_position(camera, name), quat=quat, fovy=camera.fov_deg)


def place_cameras(model: mujoco.MjModel, T_world_left: Float[np.ndarray, "4 4"], *, baseline: float) -> None:
    """Move the left camera to this optical pose, and the right camera a baseline [m] to its right."""
    quat = np.zeros(4)
    T = optical_from_opengl(T_world_left)  # its own inverse
    mujoco.mju_mat2Quat(quat, T[:3, :3].ravel())
    for name, shift in zip(CAMERA_NAMES, (0.0, baseline), strict=True):
        camera = model.camera(name).id
        model.cam_pos[camera], model.cam_quat[camera] = T[:3, 3] + shift * T[:3, 0], quat


def stereo_camera(camera: CameraConfig) -> StereoCamera:
    """Return the calibration of the rendered images, as a recording of them states it."""
    T_world_opengl = np.eye(4)
    T_world_opengl[:3, :3], T_world_opengl[:3, 3] = _rotation(camera), _position(camera, "left")
    return StereoCamera.rectified(
        width=camera.width,
        height=camera.height,
        focal=0.5 * camera.height / math.tan(0.5 * math.radians(camera.fov_deg)),
        baseline=camera.baseline,
        T_world_camera=as_recorded(optical_from_opengl(T_world_opengl)),
    )
