"""The grasp programme: still frames, then each grasp point in turn is grasped, lifted, lowered and released.

A policy that chooses its own pulls begins with a part of the programme: `still`, or `opening`, which also grasps and
lifts the first point. The jaws open where they closed: a corner that is dropped from the top can fold over, and a fold
does not undo itself.
"""

import math
from collections.abc import Iterator
from itertools import islice

import numpy as np
from jaxtyping import Float

from jiggle_mj.actions import Action, Grasp, Move, Release, Wait
from jiggle_mj.argument_checks import as_instance

from .scene import Scene

OPENING_HEIGHT = 0.01
"""Lift of the first grasp in `opening` [m]; low enough that the sheet does not slide."""
MIN_DISTANCE_FROM_MIDDLE = 1e-9
"""Distance from the sheet's middle below which a lift has no inward direction [m]; it avoids a division by 0."""


def grasp_points(scene: Scene) -> tuple[tuple[float, float], ...]:
    """Return the scene's grasp points, or the four corners counter-clockwise from (-, -) [m]."""
    if scene.programme.points:
        return scene.programme.points
    x, y = (side / 2 - scene.programme.inset for side in scene.tissue.size)
    return ((-x, -y), (x, -y), (x, y), (-x, y))


def programme(scene: Scene) -> Iterator[Action]:
    """Yield the scene's actions in order; each gives one observation."""
    plan = as_instance(scene, "scene", Scene, hint="load_scene(NAME) reads one.").programme
    yield from still(scene)
    for point in grasp_points(scene):
        yield from _lift(scene, point)
        for k in range(1, plan.lowering + 1):
            yield Move(to=_along(scene, point, 1 - k / plan.lowering))
        yield Release()


def still(scene: Scene) -> Iterator[Action]:
    """Yield the waits before the first grasp."""
    for _ in range(scene.programme.still_frames):
        yield Wait()


def opening(scene: Scene, *, height: float = OPENING_HEIGHT) -> Iterator[Action]:
    """Yield the still frames, then the grasp of the first point and its lift by at least `height` [m]."""
    yield from still(scene)
    share = height / scene.programme.height
    yield from islice(_lift(scene, grasp_points(scene)[0]), 1 + math.ceil(share * scene.programme.increments))


def _lift(scene: Scene, point: tuple[float, float]) -> Iterator[Action]:
    plan = scene.programme
    yield Grasp(point=_along(scene, point, 0.0), radius=scene.tweezer.radius)
    for k in range(1, plan.increments + 1):
        yield Move(to=_along(scene, point, k / plan.increments))


def _along(scene: Scene, point: tuple[float, float], share: float) -> Float[np.ndarray, " 3"]:
    """Return the tip's position after a share of the lift from a point [m]."""
    (x, y), lean = point, math.radians(scene.programme.lean_deg)
    inward = -np.array([x, y]) / max(math.hypot(x, y), MIN_DISTANCE_FROM_MIDDLE)
    direction = np.array([*(math.sin(lean) * inward), math.cos(lean)])
    return np.array([x, y, 2 * scene.tissue.radius]) + direction * scene.programme.height * share
