"""Fits of stiffnesses and effects: where they end, their steps, and their normal equations."""

import dataclasses

import jax
import numpy as np
import pytest
from scipy.stats import norm

from jiggle_mj.estimator.attribution import gauss_newton as stepping
from jiggle_mj.estimator.attribution.fit import fit, without
from jiggle_mj.estimator.attribution.gauss_newton import moved
from jiggle_mj.estimator.attribution.scores import parameters_sd, step_and_evidence
from jiggle_mj.estimator.belief.gaussian_information import GaussianInformation
from jiggle_mj.estimator.blas import one_thread

SIZE_ERROR = 0.03
"""Difference of gravity [g] between fits from different starts, about a tenth of its prior standard deviation."""
END_ERROR = 0.5
"""Largest step from the end of a fit [standard deviations], with weights computed again there."""
SOLVE_RTOL = 1e-5
"""Relative error of a step by normal equations, whose condition number is the square of that of least squares."""


def test_a_fit_finds_the_same_size_from_nothing_and_from_the_truth(light):
    closed, _, dataset = light
    problem, before = closed.problem, closed.declared.fitted
    at, frames = problem.sheet.place("gravity"), list(range(len(dataset.frames)))
    with jax.enable_x64(True), one_thread():
        begun = [moved(before, at, np.array([0.0, 0.0, size])) for size in (0.0, 0.8)]
        nothing, truth = (fit(problem, at, [point], frames).likeliest for point in begun)
    assert nothing.point.theta[at] == pytest.approx(truth.point.theta[at], abs=SIZE_ERROR)


def test_a_fit_ends_where_its_parameters_fit_best(light):
    ended = light[0].final.fitted
    step, _ = stepping.parameter_step(ended)
    np.testing.assert_allclose(step[ended.named] / parameters_sd(ended), 0, atol=END_ERROR)


def test_all_stiffnesses_and_parameters_step_together_to_where_both_fit_best(light):
    """Against least squares over one factor and the parameters, with the priors as rows."""
    fitted = light[0].declared.fitted
    point, n, sd = fitted.point, len(fitted.point.s), fitted.problem.sd(fitted.named)
    values, vectors = np.linalg.eigh(fitted.square)
    rows = (np.sqrt(np.maximum(values, 0)) * vectors).T
    prior = np.diag(np.append(np.sqrt(stepping.FACTOR_PRECISION), 1 / sd))
    jacobian = np.r_[np.c_[rows[:, :n] @ point.s, rows[:, n:-1]], prior]
    residual = np.concatenate([rows[:, -1], [0.0], point.theta[fitted.free] / sd])
    factor, *best = -np.linalg.lstsq(jacobian, residual, rcond=None)[0]
    theta, s = stepping.common_factor_step(fitted)
    assert point.s.any() and factor != 0
    np.testing.assert_allclose(s, factor * point.s, rtol=SOLVE_RTOL, atol=1e-9)
    bounded = np.clip(best / sd, -stepping.MAX_CHANGE, stepping.MAX_CHANGE)
    np.testing.assert_allclose(theta[fitted.free] / sd, bounded, rtol=SOLVE_RTOL, atol=1e-8)


def test_a_common_factor_of_all_stiffnesses_is_a_candidate_only_where_none_is_likelier_attached(light):
    """With errors a million times as large nothing is known of the attachments."""
    fitted = light[0].declared.fitted
    flat = dataclasses.replace(fitted.problem.scales, force=1e12, tool=1e12)
    with jax.enable_x64(True), one_thread():
        uninformed = stepping.linearise_at(
            fitted.problem.with_scales(flat), fitted.named, fitted.point, list(fitted.equations)
        )
        with_some, with_none = (stepping.candidate_steps(one, likeliest_set=False) for one in (fitted, uninformed))
    assert fitted.attached.any() and not uninformed.attached.any()
    assert len(with_some) == 2 and len(with_none) == 3
    assert with_none[-1][1].any()


def test_a_step_leads_to_a_lower_cost_or_nowhere(light):
    """From no attachments, with weights and determinants of where it leads; a cost that is no number is not lower."""
    fitted = light[0].declared.fits.assumed
    problem, frames, free = fitted.problem, list(fitted.equations), np.zeros_like(fitted.point.s)
    with jax.enable_x64(True), one_thread():
        point = stepping.start(problem, fitted.point.theta, free, fitted.point.states, frames)
        begun = stepping.linearise_at(problem, fitted.named, point, frames)
        better = stepping.better_point(begun, stepping.candidate_steps(begun))
        assert better is not None
        there = stepping.linearise_at(problem, fitted.named, better.point, frames)
        assert there.cost < begun.cost
        no_number = dataclasses.replace(begun, log_likelihood=np.nan)
        assert stepping.better_point(no_number, stepping.candidate_steps(begun)) is None


def test_a_step_that_fails_as_a_whole_is_shortened(light, monkeypatch):
    """Where the first two points that are tried are no better, the third is on the way to the first."""
    fitted = light[0].declared.fits.assumed
    problem, frames, free = fitted.problem, list(fitted.equations), np.zeros_like(fitted.point.s)
    tried, real = [], stepping.evaluated

    def refusing(problem, point, weights, residuals):
        tried.append(point)
        there = real(problem, point, weights, residuals)
        return there if len(tried) > stepping.MAX_WHOLE else dataclasses.replace(there, log_likelihood=-np.inf)

    with jax.enable_x64(True), one_thread():
        point = stepping.start(problem, fitted.point.theta, free, fitted.point.states, frames)
        begun = stepping.linearise_at(problem, fitted.named, point, frames)
        monkeypatch.setattr(stepping, "evaluated", refusing)
        better = stepping.better_point(begun, stepping.candidate_steps(begun))
    assert better is not None and len(tried) == stepping.MAX_WHOLE + 1
    np.testing.assert_allclose(better.point.s, stepping.SHORTER_SHARES[0] * tried[0].s, atol=1e-12)


def test_an_effect_more_does_not_make_a_fit_less_likely(light):
    """It may begin where the fit without it ended. A fit that cannot be worth it does not move from there."""
    closed = light[0]
    problem, before = closed.problem, closed.final
    frames = list(before.fitted.equations)
    named = np.append(before.fitted.named, problem.sheet.place("tool_scale"))
    with jax.enable_x64(True), one_thread():
        more = fit(problem, named, [before.fits.assumed.point], frames, before=before.fits).likeliest
        hopeless = fit(problem, named, [before.fits.assumed.point], frames, before=before.fits, worth=np.inf)
    assert more.log_posterior >= before.fitted.log_posterior - stepping.MIN_GAIN
    begun = (hopeless.assumed.point.theta, before.fitted.point.theta)
    assert any(np.array_equal(hopeless.likeliest.point.theta, one) for one in begun)


def test_a_fit_without_a_part_uses_the_other_frames_alone(light):
    fitted = light[0].declared.fitted
    part = fitted.problem.history.frames[min(fitted.equations)].part
    with jax.enable_x64(True), one_thread():
        rest = without(fitted, part)
    assert rest.equations and all(rest.problem.history.frames[k].part != part for k in rest.equations)


@pytest.mark.parametrize(("sd", "lower"), [(0.05, -np.inf), (0.4, -np.inf), (0.4, 0.1)])
def test_the_evidence_of_a_step_is_the_integral_over_the_prior(sd, lower):
    """The likelihood is normal about 0.176 and linearised at 0.14; the integral is a sum over many values."""
    own = GaussianInformation(precision=np.array([[1600.0]]), shift=np.array([57.6]))
    step, evidence = step_and_evidence(own, np.array([0.14]), np.array([sd]), lower)
    theta = np.linspace(-1.5, 1.5, 300_001)
    over_here = np.exp(57.6 * (theta - 0.14) - 800 * (theta - 0.14) ** 2)
    assert evidence == pytest.approx(np.log(np.trapezoid(over_here * norm.pdf(theta, scale=sd), theta)), abs=1e-6)
    assert 0.14 + step[0] == pytest.approx(0.176 * 1600 / (1600 + sd**-2))


def test_a_step_beyond_the_lower_bound_is_none():
    own = GaussianInformation(precision=np.array([[1600.0]]), shift=np.array([-57.6]))
    step, evidence = step_and_evidence(own, np.zeros(1), np.array([0.4]), 0.0)
    assert step[0] == 0 and evidence == pytest.approx(-0.5 * np.log1p(1600 * 0.4**2))
