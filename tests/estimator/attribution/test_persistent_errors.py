"""Errors that persist from frame to frame: their likelihood against dense matrices, and what is found of them."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator.attribution.every_frame import misfit_under, weighted_together
from jiggle_mj.estimator.attribution.frame_likelihood import with_noise
from jiggle_mj.estimator.attribution.gauss_newton import Weighed, evaluated, linearise_at, start
from jiggle_mj.estimator.attribution.likeliest_noise import likeliest_noise
from jiggle_mj.estimator.attribution.problem import Problem
from jiggle_mj.estimator.blas import one_thread
from jiggle_mj.estimator.effects import LIBRARY

SIZE = 2.5
"""Variance of all errors over the assumed one."""
FRAMES = 4
STEP = 1e-6
"""Change of a parameter in the differences."""
OF_HELD = 0.05
"""Share that what is held has of the slope."""


@pytest.fixture(scope="module")
def grasp(light):
    """Return a fit's problem, with all errors as a free variance, and the first frames of its last grasp."""
    fitted = light[0].declared.fitted
    scales = replace(fitted.problem.scales, noise=SIZE)
    frames = list(fitted.problem.by_grasp(sorted(fitted.weights)).values())[-1][:FRAMES]
    return fitted, fitted.problem.with_scales(scales), frames


def alike(grasp, persistence: float, residuals: dict[int, np.ndarray]) -> Weighed:
    """Return frames that have the H and N of the first one of the grasp, and these residuals of positions [m]."""
    fitted, problem, frames = grasp
    problem, first = problem.with_scales(replace(problem.scales, persistence=persistence)), fitted.weights[frames[0]]
    weights, own = {}, {}
    for k in frames:
        weights[k] = with_noise(first, jnp.asarray(1.0), *map(jnp.asarray, problem.persistence(k, frames)))
        positions = jnp.asarray(first.seen[:, None] * residuals[k])
        own[k] = replace(fitted.residuals[k].own, positions=positions, unbalanced=jnp.zeros_like(positions))
    return evaluated(problem, fitted.point, weights, weighted_together(problem, weights, own))


def drawn(grasp, persistence: float, seed: int) -> tuple[dict[int, np.ndarray], np.ndarray]:
    """Return errors of positions that persist, of the variance of each coordinate, and the autocorrelations."""
    _, problem, frames = grasp
    problem = problem.with_scales(replace(problem.scales, persistence=persistence))
    rng, errors, last = np.random.default_rng(seed), {}, 0.0
    for k in frames:
        rho = problem.autocorrelation(k, problem.before(k, frames))
        last = rho * last + np.sqrt(1 - rho**2) * rng.normal(scale=2e-4, size=(len(problem.history.rest), 3))
        errors[k] = last
    return errors, np.array([problem.autocorrelation(k, problem.before(k, frames)) for k in frames])


@pytest.mark.parametrize("persistence", [0.0, 0.4, 0.97])
def test_the_likelihood_is_that_of_the_dense_covariance_of_all_frames(grasp, persistence):
    """In differences between two sets of residuals, so that constants and the tool's part are the same."""
    fitted, problem, frames = grasp
    first = fitted.weights[frames[0]]
    n = len(first.seen)
    seen = np.repeat(np.asarray(first.seen) > 0, 3)
    with jax.enable_x64(True), one_thread():
        columns = jnp.eye(3 * n).reshape(n, 3, 3 * n)
        slope = np.asarray(jax.vmap(first.forces, 2, 2)(columns)).reshape(3 * n, 3 * n)
        white = np.asarray(first.whitened(columns)).reshape(3 * n, 3 * n)
        fields = np.asarray(first.fields).reshape(3 * n, -1)
        errors, rho = drawn(grasp, persistence, 0)
        half = {k: 0.5 * error for k, error in errors.items()}
        found = [alike(grasp, persistence, one).log_likelihood for one in (errors, half)]
    size = len(frames)
    share = np.eye(size)
    for j in range(1, size):
        share[j] += rho[j] * share[j - 1]
    new = np.diag(SIZE * (1 - rho**2))
    inverse = np.linalg.inv(share @ new @ share.T)  # of the frames' covariance, in units of that of one
    stacked = np.array([np.where(seen, errors[k].ravel(), 0.0) @ slope.T for k in frames])
    squared = np.einsum("ka,kl,lb,ab->", stacked, inverse, stacked, white)
    innovations = np.linalg.solve(share, stacked) / np.sqrt(np.diagonal(new))[:, None]
    of_fields = (innovations @ white @ fields).sum(axis=0)
    precision = size * fields.T @ white @ fields + np.eye(fields.shape[1]) / problem.amplitude**2
    misfit = squared - of_fields @ np.linalg.solve(precision, of_fields)
    assert found[0] - found[1] == pytest.approx(-0.5 * (1 - 0.25) * misfit, rel=1e-6)


@pytest.mark.parametrize("persistence", [0.0, 0.6, 0.95])
def test_the_likeliest_autocorrelation_is_that_of_what_was_drawn(grasp, persistence):
    errors, _ = drawn(grasp, persistence, 1)
    with jax.enable_x64(True), one_thread():
        at = alike(grasp, 0.5, errors)
        found = likeliest_noise(at.problem, at.weights, at.residuals)
    assert found.persistence == pytest.approx(persistence, abs=0.1)


@pytest.mark.parametrize("persistence", [0.0, 0.95])
def test_the_slope_by_what_moves_the_view_is_that_of_the_normal_equations(light, persistence):
    """Against differences of the weighted residuals of the same states, of which what is held would move alone."""
    fitted, name = light[0].declared.fitted, "camera_bias"
    problem = Problem.build(light[2], tuple(effect for effect in LIBRARY if effect.name == name))
    problem = problem.with_scales(replace(problem.scales, persistence=persistence))
    at, unit, frames = problem.sheet.place(name), np.eye(problem.sheet.size), list(fitted.weights)
    with jax.enable_x64(True), one_thread():
        point = start(problem, 1e-5 * unit[at[0]], fitted.point.s, fitted.point.states, frames)
        here = linearise_at(problem, at, point, frames)
        differences = []
        for k in at[:3]:
            ends = [replace(point, theta=point.theta + sign * STEP * unit[k]) for sign in (1, -1)]
            plus, minus = (misfit_under(problem, here.weights, one) for one in ends)
            differences.append((plus - minus) / (4 * STEP))
    found, true = here.square[len(point.s) :, -1][:3], np.array(differences)
    assert np.linalg.norm(found - true) < OF_HELD * np.linalg.norm(true)
