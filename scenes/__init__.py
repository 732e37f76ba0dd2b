"""The reference tissue: a MuJoCo shell held to a bed, a tweezer, and a stereo camera. The truth lives here.

scene = load_scene("arc")
with Reference(scene, seed=0, sensing="stereo") as reference:
    for action in programme(scene):
        observation = reference.step(action)
"""

from jiggle_mj.scenes import opengl as opengl  # before anything that imports mujoco
from jiggle_mj.scenes.disturbances import DISTURBANCES, disturbed
from jiggle_mj.scenes.programme import programme
from jiggle_mj.scenes.reference import Reference
from jiggle_mj.scenes.scene import Scene
from jiggle_mj.scenes.scene_file import load_scene, scene_table, shipped_scenes

__all__ = [
    "DISTURBANCES",
    "Reference",
    "Scene",
    "disturbed",
    "load_scene",
    "programme",
    "scene_table",
    "shipped_scenes",
]
