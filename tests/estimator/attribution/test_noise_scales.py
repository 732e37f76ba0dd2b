"""Sizes of the errors: their prior, and the likeliest ones."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from jiggle_mj.estimator.attribution.gauss_newton import linearise_at
from jiggle_mj.estimator.attribution.likeliest_scales import (
    LOG_RANGE,
    MAX_EVALUATIONS,
    NEAR,
    STEP,
    likeliest_scales,
    maximum,
)
from jiggle_mj.estimator.attribution.noise_scales import NoiseScales, log_prior
from jiggle_mj.estimator.blas import one_thread

CHANGE = 1.3
"""Factor by which each variance is changed: more than the error of the search, and less than its step."""

TOLERATED_LOSS = 0.2
"""Loss of log likelihood that is tolerated, of 300 residuals [nat]."""


def test_the_prior_of_a_logarithm_has_a_total_of_one():
    logs = np.linspace(-40, 40, 8001)
    density = np.exp([log_prior(float(np.exp(one))) for one in logs])
    assert np.trapezoid(density, logs) == pytest.approx(1, abs=1e-6)


def test_a_variance_as_assumed_is_usual_and_a_large_one_is_not():
    assert NoiseScales().larger < 0.5
    sizes = [NoiseScales(force=size).larger for size in (0.1, 0.5, 1.0, 3.0, 10.0, 1e3)]
    assert sizes == sorted(sizes) and sizes[-1] > 0.999


def test_the_likeliest_variances_have_the_largest_posterior(light):
    """Against the cost of fits at the same point with each variance changed, within their range."""
    fitted = light[0].declared.fitted
    with jax.enable_x64(True), one_thread():
        scales = likeliest_scales(fitted)

        def log_posterior(one: NoiseScales) -> float:
            there = linearise_at(fitted.problem.with_scales(one), fitted.named, fitted.point, list(fitted.equations))
            return one.log_prior() - there.cost / 2

        best = log_posterior(scales)
        for name in ("force", "fields", "tool"):
            value = getattr(scales, name)
            within = [one for one in (value * CHANGE, value / CHANGE) if np.log(one) >= LOG_RANGE[0]]
            assert within
            for changed in within:
                assert log_posterior(replace(scales, **{name: changed})) < best, name


@pytest.mark.parametrize("begun", [-2.0, 0.0, 3.0, 9.0])
@pytest.mark.parametrize("at", [-2.5, -0.3, 1.0, 6.0, 12.0])
def test_the_search_finds_the_maximum_of_a_skewed_function(begun, at):
    """A likelihood falls exponentially below its likeliest variance, and linearly above it."""
    tried = []

    def log_likelihood(x: float) -> float:
        tried.append(x)
        return -500 * (np.exp(at - x) + x - at)

    assert maximum(log_likelihood, begun) == pytest.approx(at, abs=NEAR)
    assert len(tried) <= MAX_EVALUATIONS


@pytest.mark.parametrize("near", [-2.0, 4.5, 10.0])
@pytest.mark.parametrize("at", [-1.0, 0.2, 3.0])
def test_the_search_finds_the_maximum_beside_a_variance_that_is_known(near, at):
    """Residuals have the variance sought and a known one, which differs by a factor of a million between them."""
    known = np.geomspace(1e-4, 1e2, 300)
    tried = []

    def log_likelihood(x: float) -> float:
        tried.append(x)
        return -0.5 * float(np.sum(np.log(np.exp(x) + known) + (np.exp(at) + known) / (np.exp(x) + known)))

    found = maximum(log_likelihood, 0.0, near)
    assert log_likelihood(found) > log_likelihood(at) - TOLERATED_LOSS
    assert len(tried) <= MAX_EVALUATIONS + 2


@pytest.mark.parametrize("slope, end", [(1.0, LOG_RANGE[1]), (-1.0, LOG_RANGE[0])])
def test_the_search_ends_at_the_end_of_its_range(slope, end):
    assert maximum(lambda x: slope * x, 0.0) == pytest.approx(end)


@pytest.mark.parametrize("least", [-2.0, -0.5, 2.0])
def test_the_search_keeps_to_where_the_function_is_a_number(least):
    tried = []

    def falling(x: float) -> float:
        tried.append(x)
        return -x if x > least else np.nan

    assert least < maximum(falling, 0.0) < least + 2 * STEP
    assert len(tried) <= MAX_EVALUATIONS
    assert maximum(lambda x: np.nan, 1.0) == 1.0
