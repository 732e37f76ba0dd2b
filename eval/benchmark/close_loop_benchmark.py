"""Time of closing the loop, part by part: over a recording with nothing undeclared, and over one with one effect.

The reference tissue `arc` is lifted at its four corners, eight increments each, and its particles are seen with noise.
Every part is called twice in one process; what the first call takes longer is compiling. What is logged while the whole
runs for the second time is printed with its seconds, so that it is seen where the time goes.
"""

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import jax
import jax.numpy as jnp

from jiggle_mj.episode import observe
from jiggle_mj.estimator.attribution.close_loop import Closed, close_the_loop
from jiggle_mj.estimator.attribution.dataset import collect_dataset
from jiggle_mj.estimator.attribution.fit import fit
from jiggle_mj.estimator.attribution.held_out import predict_held_out
from jiggle_mj.estimator.attribution.problem import Problem
from jiggle_mj.estimator.attribution.remainder import remainder_of_fit
from jiggle_mj.estimator.attribution.scores import scores
from jiggle_mj.estimator.blas import one_thread
from jiggle_mj.estimator.effects import LIBRARY, Effect
from jiggle_mj.recording.reader import Recording
from jiggle_mj.scenes import Reference, Scene, disturbed, programme
from jiggle_mj.worker_processes import usable_cores

from .estimator_benchmark import Metrics, peak_memory, timed
from .reference_benchmark import sized

T = TypeVar("T")
SIZES = (600,)
"""About how many particles the sheet has."""
EFFECT = "stretch"
"""Effect of the second recording, which nobody declares to the estimator."""
CASES = {"nothing": (), "effect": (f"{EFFECT}=2.5",)}
"""Disturbances of each recording; the sheet is 2.5 times as stiff as declared."""
STILL_FRAMES = 20
"""Frames before the first grasp, from which the noise is measured."""
BED_FRICTION = 0.1
"""Coefficient of friction of the bed, with which closing the loop counts in any sheet; the shipped scene has 0.3."""
REPEATS = 1
"""Calls after the first one: the whole takes minutes."""


@dataclass(kw_only=True)
class PhaseClock:
    """Receives log lines, and keeps the seconds from each to the next; use the instance as the log."""

    phases: list[tuple[float, str]] = field(default_factory=list)
    """Seconds before each line, and the line."""
    began: float = field(default_factory=time.perf_counter)
    """When the last line came [s]."""

    def __call__(self, line: str) -> None:
        """Keep a line."""
        now = time.perf_counter()
        self.phases.append((now - self.began, line))
        self.began = now

    def restart(self) -> None:
        """Forget all lines, and start anew."""
        self.phases, self.began = [], time.perf_counter()


def close_loop_benchmark(
    sizes: tuple[int, ...],
    *,
    log: Callable[[str], None],
    scene: Callable[[int], Scene] = sized,
    library: tuple[Effect, ...] = LIBRARY,
) -> Metrics:
    """Time closing the loop at each size.

    Args:
        sizes: particles, about.
        log: gets a line before each part, and the lines of closing the loop with their seconds.
        scene: returns a scene of about so many particles.
        library: effects that are looked for; `EFFECT` must be among them.
    """
    with jax.enable_x64(True), one_thread():
        metrics: Metrics = {
            "device": {"value": jax.devices()[0].device_kind, "unit": "name"},
            "precision": {"value": str(jnp.zeros(()).dtype), "unit": "name"},
            "cores": {"value": usable_cores(), "unit": "count"},
        }
        for n in sizes:
            for case, disturbances in CASES.items():
                log(f"n = {n}, {case} undeclared: recording")
                with tempfile.TemporaryDirectory() as folder:
                    recording = _recorded(disturbed(plain(scene(n)), disturbances), Path(folder) / "run.mcap")
                    found = _times(recording, library, log)
                metrics |= {f"close_loop_{case}_n{n}_{name}": entry for name, entry in found.items()}
    metrics["peak_memory"] = {"value": peak_memory(), "unit": "GiB"}
    return metrics


def plain(scene: Scene) -> Scene:
    """Return the scene with still frames, and with no more friction than any sheet may have."""
    still = replace(scene.programme, still_frames=STILL_FRAMES)
    return replace(scene, programme=still, bed=replace(scene.bed, friction=BED_FRICTION))


def _recorded(scene: Scene, path: Path) -> Recording:
    with Reference(scene, seed=0, sensing="particles") as reference:
        for _ in observe(reference, programme(scene), path, seed=0):
            pass
    return Recording.open(path)


def _times(recording: Recording, library: tuple[Effect, ...], log: Callable[[str], None]) -> Metrics:
    """Return the seconds of all parts for one recording, and what was found in it."""
    metrics: Metrics = {}

    def measure(name: str, call: Callable[[], T]) -> T:
        """Time a part, and return its last result; earlier ones are not kept."""
        log(f"  {name}")
        last: list[T] = []

        def again() -> T:
            last[:] = [call()]
            return last[0]

        compiled, seconds = timed(again, repeats=REPEATS)
        metrics[f"{name}_s"] = {"value": seconds, "unit": "s"}
        metrics[f"{name}_compile_s"] = {"value": compiled, "unit": "s"}
        return last[0]

    clock = PhaseClock()

    def close() -> Closed:
        clock.restart()
        closed = close_the_loop(dataset, library=library, log=clock)
        clock("end")
        return closed

    dataset = measure("read_and_filter", lambda: collect_dataset(recording.declaration, recording.camera, recording))
    measure("build", lambda: Problem.build(dataset, library))
    closed = measure("close", close)
    for seconds, line in clock.phases:
        log(f"    {seconds:7.2f} s until: {' '.join(line.split())}")
    problem, fitted = closed.problem, closed.declared.fitted
    measure("scores", lambda: scores(fitted))
    measure("one_hypothesis", lambda: fit(problem, problem.sheet.place(EFFECT), [fitted.point], list(fitted.equations)))
    measure("held_out", lambda: predict_held_out(fitted, dataset.frames[-1].part))
    measure("remainder", lambda: remainder_of_fit(fitted))
    whole = float(metrics["read_and_filter_s"]["value"]) + float(metrics["close_s"]["value"])
    named = ", ".join(closed.final.names)
    return {
        "particles": {"value": len(dataset.estimator.sheet.rest), "unit": "count"},
        "frames": {"value": len(dataset.frames), "unit": "count"},
        "verdict": {"value": closed.verdict + (f": {named}" if named else ""), "unit": "name"},
        "whole_s": {"value": whole, "unit": "s"},
        **metrics,
    }
