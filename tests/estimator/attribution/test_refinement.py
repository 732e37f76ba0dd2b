"""The whole slope of the likelihood against finite differences, and the steps along it, on lifts by our own engine."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from jiggle_mj.estimator.attribution import refinement
from jiggle_mj.estimator.attribution.gauss_newton import linearise_at, moved, start, weigh
from jiggle_mj.estimator.attribution.likelihood_slope import likelihood_slopes, whole_slope
from jiggle_mj.estimator.attribution.refinement import refined
from jiggle_mj.estimator.blas import one_thread
from tests.support.small_fit import with_hidden

STEP = 1e-3
"""Change of a parameter [prior sd], and of s, in the differences."""
SETTLED = 4
"""Predictions, each from the one before, with which the states have settled to what the differences need."""
MAX_ERROR = 0.12
"""Error of the slope by the parameters [norm of the slope]: friction has the frame's own state as given, and particles
touch down or lift off between the two points of the differences."""
RTOL, ATOL = 0.1, 0.05
"""Error of the slope by the logarithm of s."""


@pytest.mark.parametrize(
    ("shared", "autocorrelation"),
    [(False, 0.5), pytest.param(True, 0.0, marks=pytest.mark.slow), pytest.param(True, 0.5, marks=pytest.mark.slow)],
    ids=["white noise that persists", "noise that neighbours share", "noise that neighbours share and that persists"],
)
def test_the_slope_is_that_of_finite_differences(light, shared, autocorrelation):
    """The differences are of states that are predicted anew, so that weights and determinants change with them.

    Some particles are hidden for a frame, so that their errors follow those of frames before.
    """
    fitted = light[0].final.fitted
    problem, frames = fitted.problem, list(fitted.equations)[::3]
    problem = problem.with_scales(replace(problem.scales, autocorrelation=autocorrelation))
    problem = with_hidden(problem, {frames[1]: [0, 7], frames[-2]: [3]})
    if shared:
        x = np.asarray(problem.sheet.balance.energy.rest)
        problem = replace(problem, assumed_noise=2e-4 * np.column_stack([np.ones(len(x)), np.cos(30 * x[:, 0])]))
    sd, free, s = problem.sd(fitted.named), fitted.free, fitted.point.s
    with jax.enable_x64(True), one_thread():

        def settled(theta, s):
            point = start(problem, theta, s, fitted.point.states, frames)
            for _ in range(SETTLED):
                point = start(problem, theta, s, point.states, frames)
            return point

        def minus_log_likelihood(theta, s):
            return -weigh(problem, settled(theta, s), frames).log_likelihood

        at = linearise_at(problem, fitted.named, settled(fitted.point.theta, s), frames)
        found = whole_slope(at, likelihood_slopes(at))
        unit = np.zeros(problem.sheet.size)
        of_theta: list[float] = []
        for k, size in zip(free, sd, strict=True):
            unit[:] = 0
            unit[k] = STEP * size
            plus, minus = (minus_log_likelihood(at.point.theta + sign * unit, s) for sign in (1, -1))
            of_theta.append((plus - minus) / (2 * STEP))
        of_s: list[float] = []
        chosen = np.flatnonzero(s > 0)[:4]
        for k in chosen:
            change = STEP * s[k] * np.eye(len(s))[k]
            plus, minus = (minus_log_likelihood(at.point.theta, s + sign * change) for sign in (1, -1))
            of_s.append((plus - minus) / (2 * STEP))
    inside = (at.point.theta[free] != 0) | np.isin(free, fitted.named)  # differences at a bound are one-sided
    true, of_residuals = np.array(of_theta), at.square[len(s) : -1, -1] * sd
    error, before = (np.linalg.norm((one - true)[inside]) for one in (found[len(s) :] * sd, of_residuals))
    assert error < MAX_ERROR * np.linalg.norm(true[inside]) < before
    np.testing.assert_allclose(found[chosen] * s[chosen], of_s, rtol=RTOL, atol=ATOL)
    assert not np.allclose(at.square[chosen, -1] * s[chosen], of_s, rtol=RTOL, atol=ATOL)


def test_a_refined_fit_is_likelier_and_returns_to_the_size_it_had(light):
    """From the effect at half of its size, with everything else as it was."""
    fitted = light[0].final.fitted
    with jax.enable_x64(True), one_thread():
        half = moved(fitted, fitted.named, fitted.point.theta[fitted.named] / 2)
        begun = linearise_at(fitted.problem, fitted.named, half, list(fitted.equations))
        ended = refined(begun)
    assert ended.log_posterior > begun.log_posterior + refinement.MIN_PROMISE
    largest = np.linalg.norm(fitted.point.theta[fitted.named])
    error = np.linalg.norm(ended.point.theta[fitted.named] - fitted.point.theta[fitted.named])
    assert error < 0.25 * largest
    np.testing.assert_array_equal(ended.point.s > 0, (begun.point.s > 0) & (ended.point.s > 0))
