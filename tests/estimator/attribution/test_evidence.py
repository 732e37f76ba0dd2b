"""Evidence of a fit, against quadrature over the stiffness and the parameter of a fit with one of each."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy.special import logit
from scipy.stats import norm, truncnorm

from jiggle_mj.estimator.attribution.evidence import log_model_evidence
from jiggle_mj.estimator.attribution.gauss_newton import Fitted
from jiggle_mj.estimator.attribution.problem import Point
from jiggle_mj.estimator.belief.attachment_belief import AttachmentBelief
from jiggle_mj.estimator.belief.attachment_prior import AttachmentPrior
from jiggle_mj.estimator.belief.spike_and_slab import SpikeAndSlab
from tests.support.small_fit import small_fit, small_problem

SPIKE, MEAN, SPREAD, P = 5e-3, 0.3, 0.5, 0.1
"""Width of s if free, mean and spread if attached, and the prior probability of that."""
S = np.concatenate([np.linspace(0, 0.05, 1200, endpoint=False), np.linspace(0.05, 1, 1500)])
"""Stiffnesses of the quadrature, finer where a free particle's are."""


def two_particles() -> AttachmentBelief:
    """Return the belief about two independent particles before any evidence, with weights that stay as they are."""
    stiffness = SpikeAndSlab.build(spike=SPIKE, components=(MEAN,), spread=SPREAD, dirichlet_strength=1e12, partial=0.0)
    prior = AttachmentPrior.build(2, np.array([[0, 1]]), stiffness=stiffness, probability=P, coupling=0.0)
    return AttachmentBelief.before(prior, reference=30.0)


def fit_of(square: np.ndarray, *, s: float) -> Fitted:
    """Return a fit of one stiffness and one parameter with these normal equations, about where the latter fits best.

    Nothing is known of a second particle.
    """
    problem = replace(small_problem(), prior=two_particles())
    square = np.insert(np.insert(square, 1, 0.0, axis=0), 1, 0.0, axis=1)
    sd = problem.prior_sd[0]
    theta = np.array([-(sd**2) * square[-2, -1]])
    fitted = small_fit(theta=theta)
    nowhere = np.zeros((0, 2, 3))
    point = Point(theta=theta, s=np.array([s, 0.0]), states=nowhere, seen=nowhere)
    return replace(fitted, problem=problem, square=square, point=point, log_likelihood=-0.5 * square[-1, -1])


def by_quadrature(fitted: Fitted) -> float:
    """Return the logarithm of the integral of likelihood and prior, by the trapezium rule."""
    sd = fitted.problem.prior_sd[0]
    theta = fitted.point.theta[0] + np.linspace(-9, 9, 1201) * sd / np.sqrt(1 + sd**2 * fitted.square[-2, -2])
    square = fitted.square[np.ix_([0, -2, -1], [0, -2, -1])]
    free = truncnorm.pdf(S, 0, 1 / SPIKE, scale=SPIKE)
    attached = truncnorm.pdf(S, -1 / SPREAD, (1 - MEAN) / (SPREAD * MEAN), loc=MEAN, scale=SPREAD * MEAN)
    odds = np.exp(logit(P))
    step = np.stack(np.broadcast_arrays((S - fitted.point.s[0])[:, None], theta - fitted.point.theta, 1.0), axis=-1)
    likelihood = np.exp(-0.5 * np.einsum("...i,ij,...j", step, square, step))
    prior = (free + odds * attached)[:, None] * norm.pdf(theta, scale=sd)
    of_second = np.log1p(odds)
    return float(np.log(np.trapezoid(np.trapezoid(likelihood * prior, theta, axis=1), S)) + of_second)


@pytest.mark.parametrize("s", [0.0, 0.2])
def test_the_evidence_is_the_integral_over_stiffness_and_parameter(s):
    """The parameter has a tenth of its prior's spread, and shifts with the stiffness."""
    rows = np.array([[40.0, 3.0, 0.8], [5.0, -20.0, 1.5], [0.0, 4.0, -2.0]]) / [1, small_problem().prior_sd[0], 1]
    with jax.enable_x64(True):
        fitted = fit_of(rows.T @ rows, s=s)
        found = log_model_evidence(fitted) - fitted.problem.scales.log_prior()
    assert found == pytest.approx(by_quadrature(fitted), abs=2e-2)


@pytest.mark.parametrize("s", [0.0, 0.2])
def test_what_a_parameter_would_gain_by_a_step_counts_for_nothing(s):
    """A fit that ended before its parameter was best; the slope in the stiffness is what the parameter leaves of it."""
    sd = small_problem().prior_sd[0]
    rows = np.array([[40.0, 3.0, 0.8], [5.0, -20.0, 1.5], [0.0, 4.0, -2.0]]) / [1, sd, 1]
    with jax.enable_x64(True):
        ended = fit_of(rows.T @ rows, s=s)
        begun = replace(ended, point=replace(ended.point, theta=np.zeros(1)))
        found = log_model_evidence(begun) - begun.problem.scales.log_prior()
    gain = 0.5 * begun.square[-2, -1] ** 2 / (begun.square[-2, -2] + sd**-2)
    assert gain > 1 and found == pytest.approx(by_quadrature(begun) - gain, abs=2e-2)


def test_a_fit_without_a_finite_likelihood_has_no_evidence():
    with jax.enable_x64(True):
        fitted = fit_of(np.diag([40.0, 3.0, 1.0]), s=0.1)
        assert np.isfinite(log_model_evidence(fitted))
        assert log_model_evidence(replace(fitted, log_likelihood=np.nan)) == -np.inf


def test_a_parameter_at_its_bound_is_not_integrated():
    """Gravity has none, the height of the bed has; there the evidence is that of the stiffness alone."""
    rows = np.array([[40.0, 3.0, 0.8], [5.0, -20.0, 1.5]])
    with jax.enable_x64(True):
        fitted = fit_of(rows.T @ rows, s=0.1)
        at = np.flatnonzero(np.isfinite(fitted.problem.lower_bounds(np.arange(len(fitted.problem.prior_sd)))))[:1]
        bounded = replace(fitted, named=at, free=at, point=replace(fitted.point, theta=np.zeros(at[0] + 1)))
        kept = [0, 1, 3]
        alone = replace(fitted, named=at[:0], free=at[:0], square=fitted.square[np.ix_(kept, kept)])
        assert log_model_evidence(bounded) == pytest.approx(log_model_evidence(alone))
