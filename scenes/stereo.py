"""The stereo pair: two fixed MuJoCo cameras side by side, their calibration, and rendering.

A pixel's centre is the integer, as in `jiggle_mj.camera`; so the principal point is ((w-1)/2, (h-1)/2).
"""

import math

import mujoco
import numpy as np
from jaxtyping import Float, UInt8
from jiggle_mj.scenes.highlights import with_highlights
from jiggle_mj.scenes.opengl import IMPORT_ERROR, no_opengl
from jiggle_mj.scenes.scene import Camera

from jiggle_mj.camera import StereoCamera, as_recorded, optical_from_opengl
from jiggle_mj.errors import RenderError
from jiggle_mj.observation import StereoPair

NAMES = ("left", "right")


def _rotation(camera: Camera) -> Float[np.ndarray, "3 3"]:
    """World axes of the OpenGL camera, as columns x (right), y (up), z (backwards)."""
    tilt = math.radians(camera.tilt_deg)
    return np.array([[1, 0, 0], [0, math.cos(tilt), -math.sin(tilt)], [0, math.sin(tilt), math.cos(tilt)]])


def _position(camera: Camera, name: str) -> Float[np.ndarray, " 3"]:
    rotation = _rotation(camera)
    side = -0.5 if name == "left" else 0.5
    return np.array(camera.target) + camera.distance * rotation[:, 2] + side * camera.baseline * rotation[:, 0]


def add_cameras(spec: mujoco.MjSpec, camera: Camera) -> None:
    """Put both cameras into the world body."""
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, _rotation(camera).ravel())
    for name in NAMES:
        spec.worldbody.add_camera(name=name, pos=_position(camera, name), quat=quat, fovy=camera.fov_deg)


def place_cameras(model: mujoco.MjModel, T_world_left: Float[np.ndarray, "4 4"], *, baseline: float) -> None:
    """Move both cameras: the left one's optical pose, the right one a baseline [m] beside it."""
    quat = np.zeros(4)
    T = optical_from_opengl(T_world_left)  # its own inverse
    mujoco.mju_mat2Quat(quat, T[:3, :3].ravel())
    for name, aside in zip(NAMES, (0.0, baseline), strict=True):
        camera = model.camera(name).id
        model.cam_pos[camera], model.cam_quat[camera] = T[:3, 3] + aside * T[:3, 0], quat


def stereo_camera(camera: Camera) -> StereoCamera:
    """The calibration that belongs to the rendered images, as a recording of them has it."""
    T_world_opengl = np.eye(4)
    T_world_opengl[:3, :3], T_world_opengl[:3, 3] = _rotation(camera), _position(camera, "left")
    return StereoCamera.rectified(
        width=camera.width,
        height=camera.height,
        focal=0.5 * camera.height / math.tan(0.5 * math.radians(camera.fov_deg)),
        baseline=camera.baseline,
        T_world_camera=as_recorded(optical_from_opengl(T_world_opengl)),
    )


class StereoRenderer:
    """Offscreen images of both cameras; close it when done, or use it in a `with` block.

    Raises:
        RenderError: this machine has no offscreen OpenGL.
    """

    def __init__(self, model: mujoco.MjModel, camera: Camera, *, gloss: float = 0.0) -> None:
        self.gloss = gloss
        """Strength of the lamp's highlights on the tissue, from 0 to 1."""
        self._model = model
        if IMPORT_ERROR is not None:
            raise RenderError(no_opengl(IMPORT_ERROR))
        try:
            self._renderer = mujoco.Renderer(model, camera.height, camera.width)
        except Exception as error:
            raise RenderError(no_opengl(error)) from error
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._renderer.scene.flags[flag] = 0

    def render(self, data: mujoco.MjData) -> StereoPair:
        """One noise-free image from each camera."""
        left, right = (self._image(data, name) for name in NAMES)
        return StereoPair(left=left, right=right)

    def _image(self, data: mujoco.MjData, name: str) -> UInt8[np.ndarray, "height width 3"]:
        self._renderer.update_scene(data, camera=name)
        image = self._renderer.render().copy()
        return self._glossy(image, data, name) if self.gloss else image

    def _glossy(
        self, image: UInt8[np.ndarray, "height width 3"], data: mujoco.MjData, name: str
    ) -> UInt8[np.ndarray, "height width 3"]:
        renderer, camera = self._renderer, self._model.camera(name).id
        renderer.enable_depth_rendering()
        depth = renderer.render().astype(float)
        renderer.enable_segmentation_rendering()
        wet = renderer.render()[..., 1] == mujoco.mjtObj.mjOBJ_FLEX
        renderer.disable_segmentation_rendering()
        T_world_opengl = np.eye(4)
        T_world_opengl[:3, :3] = data.cam_xmat[camera].reshape(3, 3)
        T_world_opengl[:3, 3] = data.cam_xpos[camera]
        return with_highlights(
            image,
            depth,
            wet,
            focal=0.5 * len(image) / math.tan(0.5 * math.radians(self._model.cam_fovy[camera])),
            T_world_camera=optical_from_opengl(T_world_opengl),
            towards_lamp=-data.light_xdir[0],
            strength=self.gloss,
        )

    def close(self) -> None:
        """Free the OpenGL context."""
        self._renderer.close()
