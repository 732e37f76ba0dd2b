"""The grasp programme: still frames, then one point after the other, grasped, lifted, lowered and let go.

A policy that chooses its own pulls begins with a part of it: `still`, or `opening`, with the first point in the jaws.
The jaws open where they closed: a corner dropped from the top can fold over, and a fold does not undo itself.
"""

import math
from collections.abc import Iterator
from itertools import islice

import numpy as np
from jaxtyping import Float

from jiggle_mj.actions import Action, Grasp, Move, Release, Wait

from .scene import Scene

OPENING = 0.01
"""Lift with which a single grasp begins [m]."""


def grasp_points(scene: Scene) -> tuple[tuple[float, float], ...]:
    """The scene's points, or the four corners counter-clockwise from (-, -) [m]."""
    if scene.programme.points:
        return scene.programme.points
    x, y = (side / 2 - scene.programme.inset for side in scene.tissue.size)
    return ((-x, -y), (x, -y), (x, y), (-x, y))


def programme(scene: Scene) -> Iterator[Action]:
    """The scene's actions in order; each is one observation."""
    plan = scene.programme
    yield from still(scene)
    for point in grasp_points(scene):
        yield from _lift(scene, point)
        for k in range(1, plan.lowering + 1):
            yield Move(to=_along(scene, point, 1 - k / plan.lowering))
        yield Release()


def still(scene: Scene) -> Iterator[Action]:
    """The frames before the first grasp."""
    for _ in range(scene.programme.still_frames):
        yield Wait()


def opening(scene: Scene, *, height: float = OPENING) -> Iterator[Action]:
    """Still frames, and the first point grasped and lifted [m], so that nothing slides."""
    yield from still(scene)
    share = height / scene.programme.height
    yield from islice(_lift(scene, grasp_points(scene)[0]), 1 + math.ceil(share * scene.programme.increments))


def _lift(scene: Scene, point: tuple[float, float]) -> Iterator[Action]:
    plan = scene.programme
    yield Grasp(point=_along(scene, point, 0.0), radius=scene.tweezer.radius)
    for k in range(1, plan.increments + 1):
        yield Move(to=_along(scene, point, k / plan.increments))


def _along(scene: Scene, point: tuple[float, float], share: float) -> Float[np.ndarray, " 3"]:
    """Where the tip is after a share of the lift from a point."""
    (x, y), lean = point, math.radians(scene.programme.lean_deg)
    inward = -np.array([x, y]) / max(math.hypot(x, y), 1e-9)
    direction = np.array([*(math.sin(lean) * inward), math.cos(lean)])
    return np.array([x, y, 2 * scene.tissue.radius]) + direction * scene.programme.height * share
