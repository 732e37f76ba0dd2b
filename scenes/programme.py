"""The grasp programme: still frames, then one point after the other, grasped, lifted, lowered and let go.

The jaws open where they closed: a corner dropped from the top can fold over, and a fold does not undo itself.
"""

import math
from collections.abc import Iterator

import numpy as np
from jiggle_mj.scenes.scene import Scene

from jiggle_mj.observation import Action, Grasp, Move, Release, Wait


def grasp_points(scene: Scene) -> tuple[tuple[float, float], ...]:
    """The scene's points, or the four corners counter-clockwise from (-, -) [m]."""
    if scene.programme.points:
        return scene.programme.points
    x, y = (side / 2 - scene.programme.inset for side in scene.tissue.size)
    return ((-x, -y), (x, -y), (x, y), (-x, y))


def programme(scene: Scene) -> Iterator[Action]:
    """The scene's actions in order; each is one observation."""
    plan = scene.programme
    for _ in range(plan.still_frames):
        yield Wait()
    lean = math.radians(plan.lean_deg)
    for x, y in grasp_points(scene):
        bottom = np.array([x, y, 2 * scene.tissue.radius])
        inward = -np.array([x, y]) / max(math.hypot(x, y), 1e-9)
        direction = np.array([*(math.sin(lean) * inward), math.cos(lean)])
        yield Grasp(point=bottom, radius=scene.tweezer.radius)
        for k in range(1, plan.increments + 1):
            yield Move(to=bottom + direction * plan.height * k / plan.increments)
        for k in range(1, plan.lowering + 1):
            yield Move(to=bottom + direction * plan.height * (1 - k / plan.lowering))
        yield Release()
