"""Sizes of the errors: their prior, and the likeliest ones."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator.attribution.frame_errors import ForceErrors, force_errors
from jiggle_mj.estimator.attribution.frame_likelihood import frame_likelihood, with_force_sd
from jiggle_mj.estimator.attribution.gauss_newton import weigh
from jiggle_mj.estimator.attribution.likeliest_scales import (
    LOG_RANGE,
    likelier_force,
    with_force,
    with_likeliest_scales,
)
from jiggle_mj.estimator.attribution.noise_scales import NoiseScales, log_prior
from jiggle_mj.estimator.blas import one_thread

CHANGES = (0.5, 0.7, 0.85, 1.2, 1.4, 2.0)
"""Factors by which each variance is changed."""
LOSS = 0.5
"""Log posterior by which the search may fall short: twice the gain that it is not worth going on for [nat]."""
STEP = 1e-2
"""Change of the logarithm of a variance in the differences."""


def test_the_prior_of_a_logarithm_has_a_total_of_one():
    logs = np.linspace(-40, 40, 8001)
    density = np.exp([log_prior(float(np.exp(one))) for one in logs])
    assert np.trapezoid(density, logs) == pytest.approx(1, abs=1e-6)


def test_a_variance_as_assumed_is_usual_and_a_large_one_is_not():
    assert NoiseScales().larger < 0.5
    sizes = [NoiseScales(force=size).larger for size in (0.1, 0.5, 1.0, 3.0, 10.0, 1e3)]
    assert sizes == sorted(sizes) and sizes[-1] > 0.999


@pytest.fixture(scope="module", params=[0.05, 1.0, 30.0])
def begun(request, light):
    """A fit's point under force errors of a size from which to search."""
    fitted = light[0].declared.fitted
    with jax.enable_x64(True), one_thread():
        problem = fitted.problem.with_scales(replace(fitted.problem.assumed_scales, force=request.param))
        yield weigh(problem, fitted.point, list(fitted.weights))


def test_the_likeliest_variances_have_the_largest_posterior(begun):
    """Against the same point with each variance changed, within their range."""
    ended = with_likeliest_scales(begun)

    def log_posterior(scales: NoiseScales) -> float:
        at = weigh(ended.problem.with_scales(scales), ended.point, list(ended.weights))
        return scales.log_prior() + at.log_likelihood

    scales = ended.problem.scales
    best = log_posterior(scales)
    assert best == pytest.approx(scales.log_prior() + ended.log_likelihood, abs=1e-6)
    for name in ("force", "fields", "tool"):
        value = getattr(scales, name)
        within = [value * change for change in CHANGES if np.log(value * change) >= LOG_RANGE[0]]
        found = np.array([log_posterior(replace(scales, **{name: one})) for one in within])
        assert len(found) >= 3 and (found < best + LOSS).all(), name
        assert found[-1] < best and (len(found) < len(CHANGES) or found[0] < best), name


def test_the_slope_by_the_force_variance_is_that_of_finite_differences(begun):
    """With d ln p / d ln v = (sum |f|^2 - degrees) / 2, the other variances as they are."""

    def log_likelihood(change: float) -> float:
        scales = replace(begun.problem.scales, force=begun.problem.scales.force * float(np.exp(change)))
        return weigh(begun.problem.with_scales(scales), begun.point, list(begun.weights)).log_likelihood

    errors = force_errors(begun)
    found = float(errors.squared - errors.degrees) / 2
    assert found == pytest.approx((log_likelihood(STEP) - log_likelihood(-STEP)) / (2 * STEP), rel=1e-4, abs=1e-2)


def test_a_likelihood_with_another_force_error_is_the_one_built_with_it(begun):
    problem, k = begun.problem, next(iter(begun.weights))
    other = problem.with_scales(replace(problem.scales, force=3 * problem.scales.force))
    point, noise = begun.point, jnp.asarray(problem.noise)
    frame, states = problem.history.frames[k].frame, jnp.asarray(point.states)
    context, theta, s = problem.history.context(k, states), jnp.asarray(point.theta), jnp.asarray(point.s)
    persistence = problem.persistence(k, list(begun.weights))
    contact = begun.weights[k].contact
    built = frame_likelihood(other.sheet, theta, s, frame, context, states[k], noise, persistence, contact)
    changed = with_force_sd(begun.weights[k], other.sheet.balance.force_sd, frame, noise)
    for one, two in zip(jax.tree.leaves(built), jax.tree.leaves(changed), strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-6, atol=1e-7 * float(np.abs(one).max(initial=0.0)))


def test_errors_as_large_as_assumed_keep_their_variance(begun):
    scales = replace(begun.problem.scales, force=1.0)
    one = ForceErrors(squared=jnp.asarray(1e6), degrees=jnp.asarray(1e6), count=jnp.asarray(1e6))
    assert likelier_force(begun.problem.with_scales(scales), one) == pytest.approx(0, abs=1e-3)


def test_a_variance_that_makes_a_matrix_singular_is_not_taken(begun, monkeypatch):
    def singular(at, log_force):
        return replace(with_force(at, log_force), log_likelihood=np.nan)

    monkeypatch.setattr("jiggle_mj.estimator.attribution.likeliest_scales.with_force", singular)
    assert with_likeliest_scales(begun).problem.scales.force == begun.problem.scales.force
