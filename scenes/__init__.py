"""The reference tissue: a MuJoCo shell that is attached to a bed, a tweezer, and a stereo camera. It knows the truth.

    scene = load_scene("arc")
    with Reference(scene, seed=0, sensing="stereo") as reference:
        for action in programme(scene):
            observation = reference.step(action)

Imports run one way: `scene/` (what a scene says), `tissue/` (its simulation in MuJoCo), `sensing/` (what is observed),
`disturbances/` (what changes the two), then the files of this folder.
"""

from . import opengl as opengl  # before anything that imports mujoco
from .disturbances.registry import DISTURBANCES, disturbed
from .reference import Reference
from .scene.programme import programme
from .scene.scene import Scene
from .scene_file import load_scene, scene_summary, scene_table, shipped_scenes

__all__ = [
    "DISTURBANCES",
    "Reference",
    "Scene",
    "disturbed",
    "load_scene",
    "programme",
    "scene_summary",
    "scene_table",
    "shipped_scenes",
]
