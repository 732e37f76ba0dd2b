"""The bed's contact around predicted states: what a particle that is observed above the bed costs."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator.attribution import every_frame
from jiggle_mj.estimator.attribution.bed_contact import contact_share, left_out_contact
from jiggle_mj.estimator.attribution.gauss_newton import weigh
from jiggle_mj.estimator.attribution.grasped_frames import ClosedFrame
from jiggle_mj.estimator.attribution.problem import Point, Problem
from jiggle_mj.estimator.blas import one_thread
from jiggle_mj.estimator.physics.environment import BedContact

LIFTED = 3e-3
"""Height above where it is predicted at which a particle is observed [m]."""
NEAR = 1e-7
"""Distance from where it touches the bed [m]."""


@pytest.fixture(scope="module")
def resting(light):
    """A fit's problem and point, a frame, the particle that presses most on the bed there, and the bed."""
    fitted = light[0].declared.fitted
    problem, point, k = fitted.problem, fitted.point, next(iter(fitted.weights))
    with jax.enable_x64(True), one_thread():
        frame, bed = problem.history.frames[k].frame, problem.sheet.balance.energy.terms
        bed = next(term for term in bed if isinstance(term, BedContact))
        height = np.asarray(jnp.asarray(point.states[k]) @ bed.up - bed.height)
        usable = np.asarray(frame.counted & ~frame.force_unknown) & (point.s == 0)
        yield problem, point, k, int(np.argmin(np.where(usable, height, 0.0))), bed


def observed_above(
    problem: Problem, point: Point, k: int, i: int, bed: BedContact, *, gap: float
) -> tuple[Problem, Point]:
    """Return a problem whose frame k sees particle i lifted, and a point that predicts it at a gap from the bed."""
    states, frames = point.states.copy(), list(problem.history.frames)
    up = np.asarray(bed.up)
    states[k, i] += (float(bed.height[i]) + gap - states[k, i] @ up) * up
    frames[k] = frames[k].observing(frames[k].frame.y.at[i].set(jnp.asarray(states[k, i] + LIFTED * up)))
    return problem.with_frames(frames), replace(point, states=states)


def test_the_likelihood_does_not_jump_where_a_lifted_particle_is_predicted_to_touch_the_bed(resting, monkeypatch):
    """With the bed's whole stiffness it jumps there by tens of nat."""

    def jump() -> float:
        above, below = (weigh(*observed_above(*resting, gap=gap), [resting[2]]).log_likelihood for gap in (NEAR, -NEAR))
        return above - below

    smooth = jump()
    monkeypatch.setattr(every_frame, "contact_share", lambda *given: jnp.ones(len(given[4])))
    assert abs(smooth) < 0.1 and jump() > 50


def test_what_rests_on_the_bed_touches_it_whatever_the_noise(resting):
    """Its weight, many force errors, would have to be wrong, and two standard deviations are likelier."""
    problem, point, k, i, bed = resting
    sd = float(problem.history.frames[k].frame.precision[i, 0, 0] ** -0.5)
    for height in (0.0, 2 * sd):
        y = jnp.asarray(point.states[k]) + height * bed.up[None]
        assert float(share(problem, point, k, y)[i]) > 0.95


def test_what_is_not_observed_touches_the_bed_as_predicted(resting):
    problem, point, k, i, bed = resting
    frame = problem.history.frames[k].frame
    y = jnp.asarray(point.states[k]) + LIFTED * bed.up[None]
    unseen = replace(frame, visible=frame.visible.at[i].set(False))
    assert float(share(problem, point, k, y, unseen)[i]) == 1.0


def test_the_stiffness_that_is_left_out_is_the_rest_of_the_bed_where_it_is_touched(resting):
    problem, point, k, i, bed = resting
    context = problem.history.context(k, point.states)
    model = problem.sheet.model(jnp.asarray(point.theta), context, problem.history.frames[k].frame.displacement)
    found = left_out_contact(model, jnp.asarray(point.states[k]), jnp.full(len(point.s), 0.25))
    np.testing.assert_allclose(found[i], 0.75 * float(bed.stiffness) * np.outer(bed.up, bed.up), atol=1e-12)


def share(problem: Problem, point: Point, k: int, y: jax.Array, frame: ClosedFrame | None = None) -> jax.Array:
    """Return the share of the contact of each particle in frame k, observed at y."""
    frame = replace(problem.history.frames[k].frame if frame is None else frame, y=y)
    context, x = problem.history.context(k, point.states), jnp.asarray(point.states[k])
    variance = jnp.asarray(frame.noise_variance(problem.assumed_noise))
    return contact_share(problem.sheet, jnp.asarray(point.theta), frame, context, x, variance)
