"""Fits of stiffnesses and effects: where they end, their steps, and their normal equations."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator.attribution import fit as fitting
from jiggle_mj.estimator.attribution.fit import discounted, fit, moved
from jiggle_mj.estimator.attribution.hypotheses import jackknife_sd
from jiggle_mj.estimator.attribution.linear import NormalEquations
from jiggle_mj.estimator.attribution.scores import bayes_factor, occam
from jiggle_mj.estimator.blas import one_thread
from tests.support.small_fit import small_fit, small_problem

SIZE_ERROR = 0.03
"""Difference of gravity [g] between fits from different starts, about a tenth of its prior standard deviation."""
END_ERROR = 0.5
"""Largest step from the end of a fit [standard deviations], with weights computed again there."""
SOLVE_RTOL = 1e-5
"""Relative error of a step by normal equations, whose condition number is the square of that of least squares."""
ROUNDING = 1e-12
"""Rounding of products of a few numbers near 1."""


def test_a_fit_finds_the_same_size_from_nothing_and_from_the_truth(light):
    closed, _, dataset = light
    problem, before = closed.problem, closed.contexts[0].fitted
    at, parts = problem.sheet.place("gravity"), {one.part for one in dataset.frames}
    with jax.enable_x64(True), one_thread():
        begun = [moved(problem, before, at, np.array([0.0, 0.0, size])) for size in (0.0, 0.8)]
        nothing, truth = (fit(problem, at, point, parts) for point in begun)
    assert nothing.point.theta[at] == pytest.approx(truth.point.theta[at], abs=SIZE_ERROR)


def test_a_fit_ends_where_its_parameters_fit_best(light):
    problem, ended = light[0].problem, light[0].contexts[-1].fitted
    with jax.enable_x64(True), one_thread():
        refitted = fitting.linearise_at(problem, ended.named, ended.point, list(ended.equations))
        step, _ = fitting.parameter_step(problem, refitted)
        sd = occam(problem, ended)[1]
    np.testing.assert_allclose(step[ended.named] / sd, 0, atol=END_ERROR)


def test_all_stiffnesses_and_parameters_step_together_to_where_both_fit_best(light):
    """Against least squares over one factor and the parameters, with the priors as rows."""
    problem, fitted = light[0].problem, light[0].contexts[0].fitted
    point, n, sd = fitted.point, len(fitted.point.s), problem.sd(fitted.named)
    values, vectors = np.linalg.eigh(fitted.square)
    rows = (np.sqrt(np.maximum(values, 0)) * vectors).T
    prior = np.diag(np.append(np.sqrt(fitting.FACTOR_PRECISION), 1 / sd))
    jacobian = np.r_[np.c_[rows[:, :n] @ point.s, rows[:, n:-1]], prior]
    residual = np.concatenate([rows[:, -1], [0.0], point.theta[fitted.free] / sd])
    factor, *best = -np.linalg.lstsq(jacobian, residual, rcond=None)[0]
    theta, s = fitting.common_factor_step(problem, fitted)
    assert point.s.any() and factor != 0
    np.testing.assert_allclose(s, factor * point.s, rtol=SOLVE_RTOL, atol=1e-9)
    bounded = np.clip(best / sd, -fitting.MAX_CHANGE, fitting.MAX_CHANGE)
    np.testing.assert_allclose(theta[fitted.free] / sd, bounded, rtol=SOLVE_RTOL, atol=1e-8)


def test_a_common_factor_of_all_stiffnesses_is_a_candidate_only_where_none_is_likelier_attached(light):
    problem, fitted = light[0].problem, light[0].contexts[0].fitted
    with jax.enable_x64(True), one_thread():
        uninformed = discounted(problem, fitted, 1e9)
        with_some, with_none = (
            fitting.candidate_steps(problem, one, likeliest_set=False) for one in (fitted, uninformed)
        )
    assert fitted.attached.any() and not uninformed.attached.any()
    assert len(with_some) == 2 and len(with_none) == 3
    assert with_none[-1][1].any()


def test_recentred_normal_equations_are_those_at_the_other_point():
    rng = np.random.default_rng(0)
    columns, tool, displacement = rng.normal(size=(9, 6)), rng.normal(size=(3, 4)), np.append(rng.normal(size=5), 1.0)
    with jax.enable_x64(True):
        found = fitting.recentred(
            NormalEquations(square=jnp.asarray(columns.T @ columns), tool=jnp.asarray(tool)), displacement
        )
    expected = np.c_[columns[:, :-1], columns @ displacement]
    np.testing.assert_allclose(found.square, expected.T @ expected, atol=ROUNDING)
    np.testing.assert_allclose(found.tool, np.c_[tool[:, :-1], tool @ displacement[2:]], atol=ROUNDING)


def test_a_fit_ends_before_a_point_whose_cost_is_not_finite(light, monkeypatch):
    """For example where the sheet has folded."""
    closed, *_ = light
    begun = closed.contexts[0].fitted
    folded = dataclasses.replace(begun, cost=np.nan)
    fits = iter([begun, folded])
    monkeypatch.setattr(fitting, "linearise_at", lambda *_: next(fits))
    monkeypatch.setattr(fitting, "better_point", lambda *_: (begun.point, begun.cost - 1))
    monkeypatch.setattr(fitting, "final_step", lambda _, ended: ended)
    assert fit(closed.problem, begun.named, begun.point, {1}) is begun
    assert bayes_factor(closed.problem, folded, begun, 1) == (-np.inf, -np.inf)


def test_discounted_frames_have_less_information_about_the_attachments(light):
    """With weights computed again at the end of the fit, whose own normal equations are of the step before."""
    closed, *_ = light
    last = closed.contexts[-1].fitted
    with jax.enable_x64(True), one_thread():
        fitted = fitting.linearise_at(closed.problem, last.named, last.point, list(last.equations))
        same, uninformed = (discounted(closed.problem, fitted, excess) for excess in (1.0, 1e9))
    np.testing.assert_array_equal(same.probability, fitted.probability)
    assert fitted.attached.any() and not uninformed.attached.any()


@pytest.mark.parametrize(
    ("costs", "lowest", "passes"), [((100, 90, 95, 93, 80), 90, 3), ((100, 90, 95, 80, 85, 70), 70, 5)]
)
def test_a_fit_that_leads_away_and_back_ends_where_it_cost_least(monkeypatch, costs, lowest, passes):
    fits = iter([small_fit(cost=cost) for cost in costs])
    monkeypatch.setattr(fitting, "linearise_at", lambda *_: next(fits))
    monkeypatch.setattr(fitting, "candidate_steps", lambda *_: [])
    monkeypatch.setattr(fitting, "better_point", lambda problem, now, steps: (now.point, now.cost - 5))
    monkeypatch.setattr(fitting, "final_step", lambda problem, now: now)
    start = small_fit(cost=costs[0]).point
    assert fit(small_problem(), np.zeros(0, dtype=int), start, {0}, passes=passes).cost == lowest


def test_the_jackknife_of_a_mean_is_its_standard_error():
    values = np.random.default_rng(0).normal(size=(7, 2))
    means = [np.delete(values, k, axis=0).mean(axis=0) for k in range(7)]
    np.testing.assert_allclose(jackknife_sd(means, 2), values.std(axis=0, ddof=1) / np.sqrt(7))
    np.testing.assert_array_equal(jackknife_sd([], 2), np.zeros(2))
