"""Variances of held-out predictions: how residuals move with stiffnesses and parameters, against finite differences."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator.attribution import held_out
from jiggle_mj.estimator.attribution.every_frame import weighed
from jiggle_mj.estimator.attribution.frame_likelihood import seen_noise
from jiggle_mj.estimator.attribution.gauss_newton import start, weigh
from jiggle_mj.estimator.attribution.held_out import predict_held_out, responses
from jiggle_mj.estimator.blas import one_thread
from jiggle_mj.estimator.perception.smooth_modes import smooth_modes

STEPS = {"attached": 0.02, "stretch": 0.05, "bending": 0.3}
"""Steps of the finite differences to both sides: of s, and of each parameter by its prior standard deviation."""
COSINE, SIZE = 0.93, (0.6, 1.7)
"""Least cosine between both movements of all particles, and range of the ratio of their lengths. The linear one has
earlier frames fixed, whose friction the finite difference changes too."""


@pytest.mark.parametrize("moved", ["attached", "stretch", "bending"])
def test_residuals_move_as_finite_differences_of_the_prediction_say(light, moved):
    """At the last fitted frame, where the pull is largest; what is held stays where it was observed."""
    fitted = light[0].declared.fitted
    problem, point, frames = fitted.problem, fitted.point, list(fitted.equations)
    k, n = frames[-1], len(point.s)
    free_parameter = "attached" if moved == "attached" else int(problem.sheet.place(moved)[0])
    column = int(np.argmax(point.s))
    if free_parameter != "attached":
        column = n + int(np.flatnonzero(fitted.free == free_parameter)[0])
    seen = []
    with jax.enable_x64(True), one_thread():
        _, by_fit = responses(fitted, point, weighed(problem, point, [k])[k], k)
        for step in (STEPS[moved], -STEPS[moved]):
            theta, s = point.theta.copy(), point.s.copy()
            if free_parameter == "attached":
                s[column] += step
            else:
                theta[free_parameter] += step
            seen.append(start(problem, theta, s, point.states, frames).seen[k])
    difference = (seen[1] - seen[0]) / (2 * STEPS[moved])
    free = ~np.asarray(problem.history.frames[k].frame.held)
    found = by_fit[:, column].reshape(n, 3)
    lengths = [float(np.linalg.norm(one[free])) for one in (found, difference)]
    assert np.sum(found[free] * difference[free]) > COSINE * lengths[0] * lengths[1]
    assert SIZE[0] < lengths[0] / lengths[1] < SIZE[1]


def test_a_parameter_that_is_less_certain_widens_the_prediction(light):
    """With a tenth of the information, what the fit leaves open has more variance, and everything else has the same."""
    fitted = light[0].declared.fitted
    part = light[2].frames[-1].part
    with jax.enable_x64(True), one_thread():
        known = predict_held_out(fitted, part).variances
        vague = predict_held_out(replace(fitted, square=fitted.square / 10), part).variances
    assert np.all(vague.fit >= known.fit) and vague.fit.sum() > 1.1 * known.fit.sum()
    np.testing.assert_array_equal(vague.others, known.others)


def test_the_intervals_do_not_depend_on_what_is_seen_in_the_frames_that_they_are_of(light):
    """All that is not held is seen 3 mm higher there, as if nothing touched the bed."""
    fitted = light[0].declared.fitted
    problem, part = fitted.problem, light[2].frames[-1].part
    frames = list(problem.history.frames)
    for k in problem.frames({part}):
        higher = frames[k].frame.y + jnp.where(frames[k].frame.held[:, None], 0.0, 3e-3 * jnp.eye(3)[2:])
        frames[k] = frames[k].observing(higher)
    seen = replace(fitted, problem=problem.with_frames(frames))
    with jax.enable_x64(True), one_thread():
        first, second = predict_held_out(fitted, part), predict_held_out(seen, part)
        assert abs(second.rms - first.rms) > 1e-3
        np.testing.assert_array_equal(second.sd, first.sd)


@pytest.fixture(scope="module")
def shared(light):
    """Return the fit of the declared model, with noise that neighbours share, and the amplitudes of an error of it."""
    fitted = light[0].declared.fitted
    noise = 3e-4 * smooth_modes(np.asarray(fitted.problem.history.rest), 0.03, 4)
    return replace(fitted, problem=replace(fitted.problem, assumed_noise=noise)), np.tile([1.5, -1.0, 2.0], 4)


def erring(problem, at: list[int], w: np.ndarray):
    """Return a problem in which the tracker errs by F w in some frames, of what is held too."""
    frames, noise = list(problem.history.frames), jnp.asarray(problem.noise)
    for k in at:
        there = frames[k].frame
        frames[k] = frames[k].observing(there.y + seen_noise(there, noise) @ w)
    return problem.with_frames(frames)


def test_errors_that_were_seen_persist(shared):
    """The frames of a grasp err alike, so that the last one, which is not fitted, is expected to."""
    fitted, w = shared
    problem, grasp = fitted.problem, fitted.problem.history.frames[list(fitted.equations)[-1]].grasp
    own = [k for k, one in enumerate(problem.history.frames) if one.grasp == grasp]
    frames = [replace(one, part=99 if k == own[-1] else one.part) for k, one in enumerate(problem.history.frames)]
    problem = problem.with_frames(frames)
    drifting = problem.with_scales(replace(problem.scales, autocorrelation=0.95))
    with jax.enable_x64(True), one_thread():
        fits = []
        for one in (problem, erring(drifting, own, 3 * w)):
            at = weigh(one, fitted.point, own[:-1])
            fits.append(replace(fitted, problem=one, weights=at.weights, residuals=at.residuals))
        still, alone, on = (
            predict_held_out(fits[0], 99),
            *(predict_held_out(fits[1], 99, persistent=d) for d in (False, True)),
        )
    assert alone.rms > 1.5 * still.rms
    assert on.rms < 0.5 * (still.rms + alone.rms)
    assert on.variances.others.sum() < 0.5 * still.variances.others.sum()
    assert on.variances.fit.sum() < 0.5 * alone.variances.fit.sum()


def test_what_the_fit_leaves_open_of_the_last_frame_is_known_by_its_error(light, monkeypatch):
    """While all rests, each frame is as the last one: of what is unsure of it, the share 1 - rho is left."""
    monkeypatch.setattr(held_out, "from_rest", lambda problem, point, frames, by_tool: point)
    fitted = light[0].declared.fitted
    problem, last = fitted.problem, list(fitted.equations)[-1]
    rests = [fitted.problem.history.frames[last]] * 4
    gap = rests[0].time - fitted.problem.history.frames[last - 1].time
    rests = [
        replace(one, index=one.index + j, time=one.time + j * gap, part=99 if j == 3 else one.part)
        for j, one in enumerate(rests)
    ]
    states = np.repeat(fitted.point.states[[last]], 4, axis=0)
    variances = []
    with jax.enable_x64(True), one_thread():
        for autocorrelation in (0.0, 0.8):
            one = problem.with_scales(replace(problem.scales, autocorrelation=autocorrelation))
            one = one.with_frames(rests)
            point = replace(fitted.point, states=states, seen=states)
            known = replace(fitted, problem=one, point=point, weights=dict.fromkeys(range(3), fitted.weights[last]))
            variances.append(predict_held_out(known, 99).variances)
    np.testing.assert_allclose(variances[1].fit, 0.2**2 * variances[0].fit, rtol=1e-6)
    np.testing.assert_allclose(variances[1].others, (1 - 0.8**2) * variances[0].others, rtol=1e-6)
