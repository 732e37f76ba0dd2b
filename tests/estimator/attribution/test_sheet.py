"""Predictions of the sheet with effects: parallel grasps, history-dependent effects, and what is held."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator.attribution.dataset import collect_dataset
from jiggle_mj.estimator.attribution.problem import Problem
from jiggle_mj.estimator.attribution.sheet import CONVERGED, closed_on, held_displacement, predict_all
from jiggle_mj.estimator.blas import one_thread
from jiggle_mj.estimator.effects import LIBRARY
from tests.support.lifted_recording import observed
from tests.support.small_sheet import DECLARATION, attached, sheet

ROUNDING = 1e-12
"""Rounding of positions [m]."""
FRICTION_EFFECT = 1e-6
"""Smallest change of a state [m] that shows that friction depends on the frame before."""


def test_one_compilation_serves_all_frames(light):
    closed, _, _ = light
    history, states = closed.problem.history, np.array([timed.state for timed in closed.problem.history.frames])
    with jax.enable_x64(True):
        contexts = [history.context(k, states) for k in range(len(states))]
    kinds = {tuple((leaf.shape, leaf.dtype, leaf.weak_type) for leaf in jax.tree.leaves(one)) for one in contexts}
    assert len(kinds) == 1


def test_grasps_are_predicted_in_parallel_and_the_frames_of_each_in_order(light):
    """With friction, which depends on the state of the frame before."""
    problem, point = light[0].problem, light[0].declared.fitted.point
    theta, history = point.theta.copy(), problem.history
    theta[problem.sheet.place("friction")] = 0.5
    with jax.enable_x64(True), one_thread():
        parallel, _ = predict_all(problem.sheet, theta, point.s, history, point.states)
        states = point.states
        for k in range(len(history.frames)):
            states, _ = predict_all(problem.sheet, theta, point.s, history, states, only=[k])
        np.testing.assert_array_equal(parallel, states)
        alone, _ = predict_all(problem.sheet, theta, point.s, history, point.states, only=[1])
    assert history.frames[0].grasp == history.frames[1].grasp
    assert np.abs(alone[1] - parallel[1]).max() > FRICTION_EFFECT


@pytest.mark.slow
def test_a_history_dependent_frame_is_predicted_until_it_converges():
    """With anchors that follow what they hold, predictions from rest and from their own results agree."""
    creep = tuple(effect for effect in LIBRARY if effect.name == "anchor_creep")
    problem = Problem.build(collect_dataset(DECLARATION, None, observed(1.0)), creep)
    theta, s = np.zeros(problem.sheet.size), 0.3 * attached()
    theta[problem.sheet.place("anchor_creep")] = 3.0
    rest = np.array([sheet().rest for _ in problem.history.frames])
    lift, change = [k for k, one in enumerate(problem.history.frames) if one.grasp == 1], {}
    with jax.enable_x64(True), one_thread():
        for predictions in (1, 12):
            once, _ = predict_all(
                problem.sheet, theta, s, problem.history, rest, only=lift, max_predictions=predictions
            )
            again, _ = predict_all(
                problem.sheet, theta, s, problem.history, once, only=lift, max_predictions=predictions
            )
            change[predictions] = np.abs(again - once).max()
    assert change[12] < 2 * CONVERGED < 0.2 * change[1], change


def test_a_moved_camera_shifts_where_the_jaws_closed_too(light):
    """A constant shift of all observations leaves the displacement of what is held; `closed_on` removes it."""
    problem = light[0].problem
    with jax.enable_x64(True):
        camera_sheet = dataclasses.replace(
            problem.sheet, library=tuple(one for one in LIBRARY if one.name == "camera_bias")
        )
        k, shift = 2, jnp.array([1e-3, -2e-3, 3e-3, 0.0, 0.0, 0.0])
        states = light[0].declared.fitted.point.states
        frame, context = problem.history.frames[k].frame, problem.history.context(k, states)
        moved = dataclasses.replace(frame, y=frame.y + shift[None, :3], rotated=frame.rotated + shift[None, :3])
        closed = closed_on(camera_sheet, shift, moved, context)
        np.testing.assert_allclose(closed, frame.rotated, atol=ROUNDING)
        x, nothing = jnp.asarray(states[k]), jnp.zeros(6)
        displacements = [
            held_displacement(
                camera_sheet.model(theta, context, one.displacement),
                one,
                closed_on(camera_sheet, theta, one, context),
                x,
            )
            for theta, one in ((nothing, frame), (shift, moved))
        ]
        np.testing.assert_allclose(*displacements, atol=ROUNDING)
