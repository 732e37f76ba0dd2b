"""Time of the reference tissue: a settled lift increment, a stereo pair, a complete episode, and cost against size.

The scene is `arc`, on meshes of several sizes. An increment is the scene's own, an eighth of its lift, until nothing
moves faster than a millimetre a second. Times are medians. Only the scene is compiled, and that is not timed.
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
"""About how many vertices are timed; each is about twice the one before."""
SHIPPED_SIZE = 625
"""Vertices of the figures without a size in their name: about those of the shipped scene."""
STEREO_PAIRS = 15
"""Stereo pairs of which the median is reported."""


def reference_benchmark(
    sizes: tuple[int, ...],
    *,
    log: Callable[[str], None],
    scene: Scene | None = None,
    stereo_pairs: int = STEREO_PAIRS,
) -> Metrics:
    """Time the reference.

    Args:
        sizes: vertices, about, of the lift increments.
        log: gets a line before each part.
        scene: of the stereo pairs and the episode; `arc` if None.
        stereo_pairs: of which the median is reported.
    """
    scene = load_scene("arc") if scene is None else scene
    metrics: Metrics = {"device": {"value": "cpu", "unit": "name"}}
    increments = {}
    for n in sizes:
        log(f"{n} vertices")
        increments[n], steps = increment(sized(n))
        metrics[f"reference_increment_n{n}_s"] = {"value": increments[n], "unit": "s"}
        metrics[f"reference_increment_n{n}_steps"] = {"value": steps, "unit": "steps of 20 ms"}
    metrics |= growth("reference_increment", increments)
    if SHIPPED_SIZE in increments:
        metrics["reference_increment_s"] = {"value": increments[SHIPPED_SIZE], "unit": "s"}
    log("stereo pairs")
    metrics["stereo_pair_s"] = {"value": stereo_pair(scene, repeats=stereo_pairs), "unit": "s"}
    log("an episode")
    metrics["reference_episode_s"] = {"value": episode(scene), "unit": "s"}
    return metrics


def sized(n: int) -> Scene:
    """Return the scene `arc` with about n vertices: triangles have half a vertex each, and the outline some more."""
    scene = load_scene("arc")
    side = float(np.sqrt(np.prod(scene.tissue.size)))
    per_area = 1 / np.sqrt(0.75)
    spacing = side * per_area / (np.sqrt(1 + per_area * (n - 1)) - 1)
    return replace(scene, tissue=replace(scene.tissue, spacing=spacing))


def increment(scene: Scene) -> tuple[float, float]:
    """Return the median seconds of the increments of the first lift, and the mean number of simulation steps of one."""
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


def stereo_pair(scene: Scene, *, repeats: int = STEREO_PAIRS) -> float:
    """Return the median seconds of a pair of images, less the time of a step of the sheet at rest."""
    times = {}
    for sensing in ("stereo", "particles"):
        with Reference(scene, seed=0, sensing=sensing) as reference:
            times[sensing] = np.median([_timed(lambda: reference.step(Wait())) for _ in range(repeats)])
    return float(times["stereo"] - times["particles"])


def episode(scene: Scene) -> float:
    """Return the seconds of the scene's complete programme without images, less the scene's compilation."""
    with Reference(scene, seed=0, sensing="particles") as reference:
        return _timed(lambda: [reference.step(action) for action in programme(scene)])


def _first_lift(scene: Scene) -> list[Grasp | Move]:
    actions = [action for action in programme(scene) if isinstance(action, Grasp | Move)]
    return actions[: 1 + scene.programme.increments]


def _timed(call: Callable[[], object]) -> float:
    before = time.perf_counter()
    call()
    return time.perf_counter() - before
