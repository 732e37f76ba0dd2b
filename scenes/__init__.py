"""The reference tissue: a MuJoCo shell held to a bed, a tweezer, and a stereo camera. The truth lives here.

    scene = load_scene("arc")
    with Reference(scene, seed=0, sensing="stereo") as reference:
        for action in programme(scene):
            observation = reference.step(action)

MuJoCo reads MUJOCO_GL when it is imported, so the offscreen default is set here, before any module imports it.
"""

import os

os.environ.setdefault("MUJOCO_GL", "egl")

from jiggle_mj.scenes.programme import programme  # noqa: E402
from jiggle_mj.scenes.reference import Reference  # noqa: E402
from jiggle_mj.scenes.scene import Scene  # noqa: E402
from jiggle_mj.scenes.scene_file import load_scene, shipped_scenes  # noqa: E402

__all__ = ["Reference", "Scene", "load_scene", "programme", "shipped_scenes"]
