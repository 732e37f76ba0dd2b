"""Offscreen rendering of the stereo pair."""

import math

import mujoco
import numpy as np
from jaxtyping import UInt8

from jiggle_mj.camera import optical_from_opengl
from jiggle_mj.errors import RenderError
from jiggle_mj.observation import StereoPair

from ..opengl import IMPORT_ERROR, no_opengl
from ..scene.scene import CameraConfig
from ..tissue.cameras import CAMERA_NAMES
from .highlights import with_highlights


class StereoRenderer:
    """Renderer of both cameras; call `close` when done.

    Raises:
        RenderError: this machine has no offscreen OpenGL.
    """

    def __init__(self, model: mujoco.MjModel, camera: CameraConfig, *, gloss: float = 0.0) -> None:
        self.gloss = gloss
        """Strength of the lamp's highlights on the tissue, in [0, 1]."""
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
        """Return one noise-free image from each camera."""
        left, right = (self._image(data, name) for name in CAMERA_NAMES)
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
