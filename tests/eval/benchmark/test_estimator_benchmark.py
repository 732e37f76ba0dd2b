"""The benchmark: what it prints, and when its gate closes."""

import json

import numpy as np
import pytest

from jiggle_mj.eval.benchmark import estimator_benchmark as bench

MIN_SHARE = 0.75
"""Smallest share that shows that something is found; with every particle called free it is 0.728."""


@pytest.mark.slow
def test_a_small_benchmark_has_its_figures_and_finds_the_disc():
    """A sheet of 9 by 9 particles, as in other tests."""
    metrics = bench.benchmark((85,), paper=False, log=lambda _: None)
    assert {
        "device",
        "equilibrium_n85_s",
        "update_n85_s",
        "update_n85_compile_s",
        "second_look_n85_s",
        "found_share",
    } <= set(metrics)
    assert float(metrics["update_n85_s"]["value"]) > 0
    assert float(metrics["found_share"]["value"]) > MIN_SHARE
    json.dumps(metrics, allow_nan=False)


@pytest.mark.slow
def test_beyond_the_largest_belief_the_solver_alone_is_timed():
    metrics = bench.benchmark((40, 85), paper=False, log=lambda _: None, max_belief_particles=0)
    times = {"equilibrium_n40_s", "equilibrium_n85_s", "equilibrium_exponent"}
    assert set(metrics) == {"device", "peak_memory"} | times
    assert 0.05 < float(metrics["peak_memory"]["value"]) < 20  # JAX and a test's process, in GiB
    small, large, exponent = (float(metrics[f"equilibrium_{end}"]["value"]) for end in ("n40_s", "n85_s", "exponent"))
    assert exponent == pytest.approx(np.log(large / small) / np.log(85 / 40))


def test_the_gate_closes_on_a_slower_time_a_lower_ratio_and_a_share_that_falls():
    then: bench.Metrics = {
        "update_n600_s": {"value": 0.1, "unit": "s"},
        "update_n600_compile_s": {"value": 1.0, "unit": "s"},
        "found_share": {"value": 0.95, "unit": "share"},
        "update_explicit_over_implicit": {"value": 12.0, "unit": "ratio"},
    }
    same = {name: dict(entry) for name, entry in then.items()}
    assert bench.regressions(same, then) == []
    same["update_n600_compile_s"]["value"] = 100.0
    assert bench.regressions(same, then) == []
    worse = {"update_n600_s": 0.31, "found_share": 0.92, "update_explicit_over_implicit": 3.9}
    for name, value in worse.items():
        same[name]["value"] = value
    assert [line.split()[0] for line in bench.regressions(same, then)] == list(worse)


def test_the_committed_baseline_can_be_compared():
    committed = bench.baseline()
    assert "update_n600_s" in committed and "found_share" in committed
    assert bench.regressions(committed, committed) == []
