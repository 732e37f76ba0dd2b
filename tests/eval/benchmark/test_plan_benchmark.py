"""The benchmark of a plan: what it prints."""

import jax

from jiggle_mj.eval.benchmark.plan_benchmark import plan_benchmark


def test_a_plan_has_its_time_its_compile_time_and_the_devices_that_it_ran_on():
    metrics = plan_benchmark((40,), log=lambda _: None)
    assert metrics["devices"]["value"] == len(jax.devices())
    assert 0 < float(metrics["plan_n40_s"]["value"]) < float(metrics["plan_n40_compile_s"]["value"])
