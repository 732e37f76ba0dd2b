"""How long the reference tissue takes: a settled lift increment, a stereo pair, a whole episode, and cost against size.

The scene is `arc`, on meshes of several sizes; an increment is the scene's own, an eighth of its lift, until nothing
moves faster than a millimetre a second. Times are medians; nothing is compiled but the scene, which is not timed.
"""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from jiggle_mj.actions import Grasp, Move, Wait
from jiggle_mj.scenes import Reference, Scene, load_scene, programme
from jiggle_mj.scenes.tissue.model import TIMESTEP

from .estimator_benchmark import Metrics, growth

SIZES = (300, 625, 1200, 2500)
NAMED = 625
"""Vertices of the figures without a size in their name."""
PAIRS = 15


def reference_benchmark(sizes: tuple[int, ...], *, log: Callable[[str], None]) -> Metrics:
    """Times of the reference.

    Args:
        sizes: vertices, about.
        log: told what comes next.
    """
    metrics: Metrics = {"device": {"value": "cpu", "unit": "name"}}
    increments = {}
    for n in sizes:
        log(f"{n} vertices")
        increments[n], steps = increment(sized(n))
        metrics[f"reference_increment_n{n}_s"] = {"value": increments[n], "unit": "s"}
        metrics[f"reference_increment_n{n}_steps"] = {"value": steps, "unit": "steps of 20 ms"}
    metrics |= growth("reference_increment", increments)
    if NAMED in increments:
        metrics["reference_increment_s"] = {"value": increments[NAMED], "unit": "s"}
    log("stereo pairs")
    metrics["stereo_pair_s"] = {"value": stereo_pair(load_scene("arc")), "unit": "s"}
    log("an episode")
    metrics["reference_episode_s"] = {"value": episode(load_scene("arc")), "unit": "s"}
    return metrics


def sized(n: int) -> Scene:
    """The scene `arc` with about n vertices: triangles have half a vertex each, and the outline some more."""
    scene = load_scene("arc")
    side = float(np.sqrt(np.prod(scene.tissue.size)))
    per_area = 1 / np.sqrt(0.75)
    spacing = side * per_area / (np.sqrt(1 + per_area * (n - 1)) - 1)
    return replace(scene, tissue=replace(scene.tissue, spacing=spacing))


def increment(scene: Scene) -> tuple[float, float]:
    """Median seconds of the increments of the first lift, and simulation steps that one took on average."""
    seconds, began, ended = [], 0, 0
    with Reference(scene, seed=0, sensing="particles") as reference:
        for action in _first_lift(scene):
            before = time.perf_counter()
            observation = reference.step(action)
            if isinstance(action, Move):
                seconds.append(time.perf_counter() - before)
                ended = observation.time
            else:
                began = observation.time
    return float(np.median(seconds)), (ended - began) * 1e-9 / TIMESTEP / len(seconds)


def stereo_pair(scene: Scene) -> float:
    """Median seconds of a pair of images, with the time of a step of the sheet at rest taken off."""
    times = {}
    for sensing in ("stereo", "particles"):
        with Reference(scene, seed=0, sensing=sensing) as reference:
            times[sensing] = np.median([_timed(lambda: reference.step(Wait())) for _ in range(PAIRS)])
    return float(times["stereo"] - times["particles"])


def episode(scene: Scene) -> float:
    """Seconds of the scene's whole programme without images, the scene's compilation not counted."""
    with Reference(scene, seed=0, sensing="particles") as reference:
        return _timed(lambda: [reference.step(action) for action in programme(scene)])


def _first_lift(scene: Scene) -> list[Grasp | Move]:
    actions = [one for one in programme(scene) if isinstance(one, Grasp | Move)]
    return actions[: 1 + scene.programme.increments]


def _timed(call: Callable[[], object]) -> float:
    before = time.perf_counter()
    call()
    return time.perf_counter() - before
