"""The benchmark of closing the loop: what it prints, and that its recordings are what they are said to be."""

import json
from dataclasses import replace

import jax
import pytest

from jiggle_mj.estimator.effects import LIBRARY
from jiggle_mj.eval.benchmark import close_loop_benchmark as bench
from jiggle_mj.scenes import Scene, disturbed, programme
from jiggle_mj.worker_processes import usable_cores
from tests.support.small_scene import SCENE

PARTS = ("read_and_filter", "build", "close", "scores", "one_hypothesis", "held_out", "remainder")
FRAMES = 8
"""Frames of the small recording with closed jaws: two grasps, each seen as it closes, twice lifted and once lowered."""
FEW = tuple(effect for effect in LIBRARY if effect.name in (bench.EFFECT, "tool_scale"))
"""Effects that the test looks for, to save time."""


def small(_: int) -> Scene:
    """Return a small scene with two grasps, each lifted and lowered by `FRAMES` / 2 - 1 moves."""
    lifts = replace(SCENE.programme, points=((-0.02, -0.02), (0.02, 0.02)), increments=2, height=0.015)
    return replace(SCENE, programme=lifts)


@pytest.mark.slow
def test_every_part_has_its_time_and_the_whole_is_the_pass_and_the_loop():
    lines = list[str]()
    metrics = bench.close_loop_benchmark((90,), log=lines.append, scene=small, library=FEW)
    json.dumps(metrics, allow_nan=False)
    assert metrics["precision"]["value"] == "float64" and metrics["cores"]["value"] == usable_cores()
    assert metrics["device"]["value"] == jax.devices()[0].device_kind
    for case in bench.CASES:
        found = {name: metrics[f"close_loop_{case}_n90_{name}"]["value"] for name in ("particles", "frames", "whole_s")}
        assert 60 < float(found["particles"]) < 120 and found["frames"] == FRAMES
        seconds = {name: float(metrics[f"close_loop_{case}_n90_{name}_s"]["value"]) for name in PARTS}
        assert min(seconds.values()) > 0
        assert found["whole_s"] == seconds["read_and_filter"] + seconds["close"]
        # the scores, the held-out prediction and the remainder are parts of the loop
        assert seconds["close"] > seconds["scores"] + seconds["remainder"]
    logged = [float(line.split()[0]) for line in lines if " s until: " in line]
    loops = [float(metrics[f"close_loop_{case}_n90_close_s"]["value"]) for case in bench.CASES]
    assert sum(logged) == pytest.approx(sum(loops), rel=0.01, abs=0.01 * len(logged))
    assert any(f"fitting {FRAMES // 2} frames" in line for line in lines)


def test_the_recordings_are_four_lifts_of_eight_increments_with_what_is_undeclared_and_nothing_else():
    """And a move down each; the sheet's stiffness is the declared one where nothing is undeclared."""
    scene = bench.plain(bench.sized(600))
    moves = [type(action).__name__ for action in programme(scene)]
    assert [moves.count(name) for name in ("Wait", "Grasp", "Move")] == [bench.STILL_FRAMES, 4, 4 * (8 + 1)]
    assert scene.disturbances == () and bench.CASES["nothing"] == ()
    assert scene.tissue.young * scene.tissue.thickness == scene.declared.membrane_stiffness
    (stretch,) = disturbed(scene, bench.CASES["effect"]).disturbances
    assert type(stretch).kind() == bench.EFFECT
