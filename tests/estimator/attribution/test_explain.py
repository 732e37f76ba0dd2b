"""The split of the evidence: it sums to the log likelihood and to the log Bayes factor, and is right by particle."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from jiggle_mj.estimator.attribution.explain import explanation
from jiggle_mj.estimator.attribution.gauss_newton import weigh
from jiggle_mj.estimator.attribution.likelihood_split import likelihood_split
from jiggle_mj.estimator.blas import one_thread

ROUNDING = 1e-9
"""Error of a sum of some hundred thousand terms [share of it]."""


@pytest.fixture(scope="module")
def explained(light):
    with jax.enable_x64(True), one_thread():
        return explanation(light[0])


def test_the_parts_of_frames_and_grasps_sum_to_the_log_likelihood(light):
    """The fit has it with the shared fields and offsets eliminated instead of at their likeliest values."""
    for one, _ in light[0].hypotheses[:2]:
        with jax.enable_x64(True), one_thread():
            split = likelihood_split(one.fitted)
        total = split.frames.sum() + split.grasps
        assert total == pytest.approx(one.fitted.log_likelihood, rel=ROUNDING)
        assert split.particles.shape == (len(one.fitted.weights), len(one.fitted.point.s))


def test_the_parts_sum_to_the_log_likelihood_with_noise_that_neighbours_share(light):
    fitted = light[0].declared.fitted
    fields = 1e-4 * np.stack([np.ones(len(fitted.point.s)), np.cos(1e2 * fitted.point.states[0, :, 0])], axis=1)
    with jax.enable_x64(True), one_thread():
        noisy = weigh(replace(fitted.problem, assumed_noise=fields), fitted.point, list(fitted.weights)[:3])
        split = likelihood_split(noisy)
    assert split.frames.sum() + split.grasps == pytest.approx(noisy.log_likelihood, rel=ROUNDING)


def test_the_parts_sum_to_the_log_bayes_factor(light, explained):
    closed = light[0]
    best = next(one for one, _ in closed.hypotheses if one.added)
    first = explained[0]
    assert first["effects"] == list(best.names) and len(explained) == min(3, len(closed.fitted_to_all) - 1)
    for one in explained:
        frames = sum(frame["nat"] for frame in one["frames"])
        assert sum(one["particles_nat"]) + one["shared_nat"] == pytest.approx(frames, rel=ROUNDING)
        rest = one["grasps_nat"] + one["error_sizes_nat"] + one["parameters_nat"]
        of_both = 2 * abs(closed.declared.fitted.log_likelihood)
        assert frames + rest == pytest.approx(one["log_bayes_factor"], abs=ROUNDING * of_both)
    assert first["log_bayes_factor"] == best.log_evidence - closed.declared.log_evidence > 0


def test_the_evidence_for_less_weight_rests_on_frames_with_the_sheet_lifted(explained):
    """With the tool at rest another weight changes nothing that is seen."""
    frames = explained[0]["frames"]
    high = [one["nat"] for one in frames if one["displacement_m"] > np.median([f["displacement_m"] for f in frames])]
    low = [one["nat"] for one in frames if one["displacement_m"] <= np.median([f["displacement_m"] for f in frames])]
    assert np.mean(high) > np.mean(low)
