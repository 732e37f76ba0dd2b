"""Errors that persist from frame to frame: their likelihood against dense matrices, and what is found of them."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator.attribution.every_frame import following, misfit_under, weighted_together
from jiggle_mj.estimator.attribution.fit import weighed_without
from jiggle_mj.estimator.attribution.frame_likelihood import seen_noise
from jiggle_mj.estimator.attribution.gauss_newton import Weighed, evaluated, linearise_at, start, weigh
from jiggle_mj.estimator.attribution.likeliest_noise import grasps_of, likeliest_noise
from jiggle_mj.estimator.attribution.linear import SheetResiduals
from jiggle_mj.estimator.attribution.noise_scales import NoiseScales
from jiggle_mj.estimator.attribution.persistence import carried, drive
from jiggle_mj.estimator.attribution.problem import Problem
from jiggle_mj.estimator.blas import one_thread
from jiggle_mj.estimator.effects import LIBRARY
from jiggle_mj.estimator.perception.smooth_modes import smooth_modes
from tests.support.small_fit import with_hidden

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


def alike(grasp, autocorrelation: float, residuals: dict[int, np.ndarray]) -> Weighed:
    """Return frames that have the H and N of the first one of the grasp, and these residuals of positions [m]."""
    fitted, problem, frames = grasp
    problem, first = (
        problem.with_scales(replace(problem.scales, autocorrelation=autocorrelation)),
        fitted.weights[frames[0]],
    )
    weights, own = {}, {}
    for k in frames:
        weights[k] = following(problem, first, k, frames)
        positions = jnp.asarray(first.seen[:, None] * residuals[k])
        own[k] = replace(fitted.residuals[k].own, sheet=SheetResiduals(positions, jnp.zeros_like(positions)))
    return evaluated(problem, fitted.point, weights, weighted_together(problem, weights, own))


def drawn(grasp, autocorrelation: float, seed: int) -> tuple[dict[int, np.ndarray], np.ndarray]:
    """Return errors of positions that persist, of the variance of each coordinate, and the autocorrelations."""
    _, problem, frames = grasp
    problem = problem.with_scales(replace(problem.scales, autocorrelation=autocorrelation))
    rng, errors, last = np.random.default_rng(seed), {}, 0.0
    every = np.array([float(problem.persistence(k, frames).autocorrelation[0]) for k in frames])
    for k, rho in zip(frames, every, strict=True):
        last = rho * last + np.sqrt(1 - rho**2) * rng.normal(scale=2e-4, size=(len(problem.history.rest), 3))
        errors[k] = last
    return errors, every


@pytest.mark.parametrize("autocorrelation", [0.0, 0.4, 0.97])
def test_the_likelihood_is_that_of_the_dense_covariance_of_all_frames(grasp, autocorrelation):
    """In differences between two sets of residuals, so that constants and the tool's part are the same."""
    fitted, problem, frames = grasp
    first = fitted.weights[frames[0]]
    n = len(first.seen)
    seen = np.repeat(np.asarray(first.seen) > 0, 3)
    with jax.enable_x64(True), one_thread():
        columns = jnp.eye(3 * n).reshape(n, 3, 3 * n)
        slope = np.asarray(jax.vmap(first.forces, 2, 2)(columns)).reshape(3 * n, 3 * n)
        white = np.asarray(first.whitened(columns)).reshape(3 * n, 3 * n)
        fields = np.asarray(first.fields / first.persistence.drive).reshape(3 * n, -1)
        errors, rho = drawn(grasp, autocorrelation, 0)
        half = {k: 0.5 * error for k, error in errors.items()}
        found = [alike(grasp, autocorrelation, one).log_likelihood for one in (errors, half)]
    size = len(frames)
    share = np.eye(size)
    for j in range(1, size):
        share[j] += rho[j] * share[j - 1]
    new = np.diag(SIZE * (1 - rho**2))
    inverse = np.linalg.inv(share @ new @ share.T)  # of the frames' covariance, in units of that of one
    stacked = np.array([np.where(seen, errors[k].ravel(), 0.0) @ slope.T for k in frames])
    squared = np.einsum("ka,kl,lb,ab->", stacked, inverse, stacked, white)
    innovations = np.linalg.solve(share, stacked) / np.sqrt(np.diagonal(new))[:, None]
    driven = np.array([drive(autocorrelation, problem.steps(k, frames)) for k in frames])
    of_fields = driven @ innovations @ white @ fields
    precision = np.sum(driven**2) * fields.T @ white @ fields + np.eye(fields.shape[1]) / problem.amplitude**2
    misfit = squared - of_fields @ np.linalg.solve(precision, of_fields)
    assert found[0] - found[1] == pytest.approx(-0.5 * (1 - 0.25) * misfit, rel=1e-6)


@pytest.mark.parametrize("autocorrelation", [0.0, 0.25, 0.7, 0.95])
def test_the_likeliest_autocorrelation_is_that_of_what_was_drawn(grasp, autocorrelation):
    errors, _ = drawn(grasp, autocorrelation, 1)
    with jax.enable_x64(True), one_thread():
        at = alike(grasp, 0.5, errors)
        found = likeliest_noise(at.problem, at.weights, at.residuals)
    assert found.autocorrelation == pytest.approx(autocorrelation, abs=0.1)


@pytest.mark.parametrize("autocorrelation", [0.0, 0.95])
def test_the_slope_by_what_moves_the_view_is_that_of_the_normal_equations(light, autocorrelation):
    """Against differences of the weighted residuals of the same states, of which what is held would move alone."""
    fitted, name = light[0].declared.fitted, "camera_bias"
    problem = Problem.build(light[2], tuple(effect for effect in LIBRARY if effect.name == name))
    problem = problem.with_scales(replace(problem.scales, autocorrelation=autocorrelation))
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


HIDDEN = {1: [2, 3], 2: [3], 3: [5]}
"""Particles that some frames of a grasp do not observe."""


def test_errors_of_particles_that_disappear_follow_the_last_ones_that_were_seen(grasp):
    """Against the dense covariance over time of the observed errors of each particle, of the same variance."""
    _, problem, frames = grasp
    problem = problem.with_scales(replace(problem.scales, autocorrelation=0.9))
    problem = with_hidden(problem, {frames[j]: particles for j, particles in HIDDEN.items()})
    errors, _ = drawn(grasp, 0.9, 2)
    index = np.array([problem.history.frames[k].index for k in frames], dtype=float)
    covariance = SIZE * (0.9 ** np.abs(index[:, None] - index[None]) - 0.9 ** (index[:, None] + index[None]))
    counted = np.array([problem.history.frames[k].counted for k in frames])
    found, expected = 0.0, 0.0
    for k, there in zip(frames, counted, strict=True):
        persistence = problem.persistence(k, frames)
        every = {j: jnp.asarray(error) for j, error in errors.items()}
        last = carried(problem.last_seen(k, frames), every, every[k])
        new = np.asarray(persistence.innovation(jnp.asarray(errors[k]), last))[there]
        found += float(np.sum(new**2) + 3 * np.log(np.asarray(persistence.new)[there]).sum())
    for i in range(counted.shape[1]):
        seen = counted[:, i]
        own, C = np.array([errors[k][i] for k in frames])[seen], covariance[np.ix_(seen, seen)]
        expected += float(np.sum(own * np.linalg.solve(C, own)) + 3 * np.linalg.slogdet(C)[1])
    assert {len(counted) - int(seen.sum()) for seen in counted.T} >= {0, 1, 2}
    assert found == pytest.approx(expected, rel=1e-9)


def test_the_likeliest_noise_is_evaluated_as_the_likelihood_is(grasp):
    """Over autocorrelations and sizes of the smooth noise, with particles that disappear."""
    fitted, problem, frames = grasp
    noise = 1e-4 * smooth_modes(np.asarray(problem.history.rest), 0.03, 4)
    hidden = with_hidden(problem, {frames[j]: particles for j, particles in HIDDEN.items()})
    problem = replace(hidden, assumed_noise=noise)
    with jax.enable_x64(True), one_thread():
        found = []
        for autocorrelation, smooth in ((0.3, 1.0), (0.9, 1.0), (0.9, 4.0)):
            scales = replace(problem.scales, autocorrelation=autocorrelation, smooth=smooth, noise=SIZE)
            at = weigh(problem.with_scales(scales), fitted.point, frames)
            (grasped,) = grasps_of(at.problem, at.weights, at.residuals)
            squared, log_det = grasped.misfit(1.0, autocorrelation, at.problem.amplitude)
            observed = float(grasped.observed.sum())
            found.append(at.log_likelihood + 0.5 * (squared / SIZE + observed * np.log(SIZE) + log_det))
            other, _ = grasped.misfit(4.0 / smooth, 0.6, at.problem.amplitude)
            again = weigh(problem.with_scales(replace(scales, autocorrelation=0.6, smooth=4.0)), fitted.point, frames)
            (regrasped,) = grasps_of(again.problem, again.weights, again.residuals)
            assert other == pytest.approx(regrasped.misfit(1.0, 0.6, again.problem.amplitude)[0], rel=1e-8)
    assert np.ptp(found) < 1e-6


@pytest.mark.parametrize("smooth", [0.2, 1.0, 30.0])
def test_the_likeliest_noise_has_the_largest_posterior(grasp, smooth):
    """Errors lie along few smooth fields and persist; other sizes and autocorrelations near it are less likely."""
    fitted, problem, frames = grasp
    rng = np.random.default_rng(3)
    noise = 2e-4 * smooth_modes(np.asarray(problem.history.rest), 0.03, 4)
    problem = replace(problem, assumed_noise=noise)
    timed, a = list(problem.history.frames), np.zeros(noise.shape[1] * 3)
    for k in frames:
        a = 0.8 * a + 0.6 * smooth**0.5 * rng.normal(size=a.shape)
        there = timed[k].frame
        timed[k] = timed[k].observing(there.y + seen_noise(there, jnp.asarray(noise)) @ a)
    problem = problem.with_frames(timed)
    with jax.enable_x64(True), one_thread():

        def weighed_by(scales: NoiseScales) -> Weighed:
            return weigh(problem.with_scales(scales), fitted.point, frames)

        def log_posterior(scales: NoiseScales) -> float:
            return weighed_by(scales).log_likelihood + scales.log_prior()

        at = weighed_by(replace(problem.scales, autocorrelation=0.5, smooth=1.0))
        found = likeliest_noise(at.problem, at.weights, at.residuals)
        best, rest = log_posterior(found), 1 - found.autocorrelation
        others = [replace(found, smooth=found.smooth * change) for change in (0.6, 1.6)]
        others += [replace(found, autocorrelation=1 - rest * change) for change in (0.6, 1.6) if rest * change <= 1]
        assert max(map(log_posterior, others)) < best
    assert found.smooth != 1.0


@pytest.mark.parametrize(("autocorrelation", "frames"), [(0.0, 3), (0.7, 1), (0.7, 4), (0.999, 9)])
def test_what_drives_all_frames_alike_adds_up(autocorrelation, frames):
    """As a sum over frames that follow at once, and for a grasp that begins some frames after rest."""
    powers = autocorrelation ** np.arange(frames, dtype=float)
    alike = drive(autocorrelation, (1,) * frames)
    assert alike == pytest.approx(powers.sum() / np.sqrt(np.sum(powers**2)), rel=1e-12)
    first, each = (np.sqrt(1 - autocorrelation ** (2 * steps)) for steps in (24, 1))
    last = 1 - autocorrelation ** (2 * (23 + frames))
    expected = (powers[-1] * first + each * powers[:-1].sum()) / np.sqrt(last)
    assert drive(autocorrelation, (24,) + (1,) * (frames - 1)) == pytest.approx(expected, rel=1e-12)


def test_a_fold_is_weighed_as_if_its_frames_had_never_been(grasp):
    """With a part from the middle of a grasp: the frame after it follows the last one before it."""
    fitted, problem, frames = grasp
    problem = problem.with_scales(replace(problem.scales, autocorrelation=0.9))
    timed = [replace(one, part=99 if k == frames[1] else one.part) for k, one in enumerate(problem.history.frames)]
    problem = problem.with_frames(timed)
    kept = [frames[0], *frames[2:]]
    with jax.enable_x64(True), one_thread():
        whole = linearise_at(problem, fitted.named, fitted.point, frames)
        expected = linearise_at(problem, fitted.named, fitted.point, kept)
        found = weighed_without(whole, 99)
    assert list(found.weights) == kept
    assert found.log_likelihood == pytest.approx(expected.log_likelihood, rel=1e-9)
    np.testing.assert_allclose(found.square, expected.square, rtol=1e-6, atol=1e-6 * np.abs(expected.square).max())
