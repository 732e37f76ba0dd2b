"""The paper's controllers on a small sheet: derivatives, descent, samples, and how far the tip goes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator.physics.environment import Grip
from jiggle_mj.estimator.physics.simulator import simulator
from jiggle_mj.estimator.planning.controllers import (
    KEPT_SHARE,
    PRIMITIVES,
    Samples,
    Scales,
    Situation,
    displacement_loss,
    entropy_loss,
    large_step,
    local_step,
    truncated_step,
)
from jiggle_mj.observation import Declaration
from tests.support.small_sheet import STIFFNESS, attached, sheet

LOW, HIGH = jnp.array([-0.03, -0.03, 0.0]), jnp.array([0.03, 0.03, 0.03])
PRIOR = 0.3
"""Standard deviation of each b [N/m]."""
DIFFERENCE = 1e-6
"""Step of finite differences [m]."""
DERIVATIVE_RTOL = 1e-4
"""Share of the largest derivative: the error of central differences of an iterated simulator."""
ROUNDING = 1e-12
"""Rounding of lengths [m]."""


@pytest.fixture(scope="module")
def problem():
    """Simulator, situation with a corner in the jaws, and scales."""
    f = simulator(sheet(), Declaration())
    tip = f.rest[0] + jnp.array([0.0, 0.0, 2e-3])
    grip = Grip.build(f.rest, f.rest[0], radius=6e-3, stiffness=900.0)
    covariance = PRIOR**2 * jnp.eye(sheet().n)
    situation = Situation(
        x=f.rest,
        tip=tip,
        length=grip.length,
        stiffness=grip.stiffness,
        b=jnp.asarray(np.where(attached(), STIFFNESS, 1e-4)),
        covariance=covariance,
    )
    return f, situation, Scales.at_prior(f.rest, covariance, energy=1e-6, noise=2e-4)


@pytest.mark.parametrize("kind", [displacement_loss, entropy_loss])
def test_the_gradient_of_a_loss_equals_its_finite_differences(problem, kind):
    loss = eqx.filter_jit(kind(*problem))
    tip, step = problem[1].tip, DIFFERENCE
    gradient = jax.jacfwd(loss)(tip)
    differences = [(loss(tip + step * e) - loss(tip - step * e)) / (2 * step) for e in jnp.eye(3)]
    atol = DERIVATIVE_RTOL * float(jnp.abs(gradient).max())
    np.testing.assert_allclose(gradient, differences, rtol=DERIVATIVE_RTOL, atol=atol)


def test_below_the_ground_a_loss_drives_the_tip_up(problem):
    """The workspace's term alone has a derivative of -100 exp(0.005) there, and the others must not outweigh half."""
    below = problem[1].tip.at[2].set(-5e-3)
    assert jax.grad(displacement_loss(*problem))(below)[2] < -50


def test_the_local_step_lowers_the_loss_and_is_no_longer_than_allowed(problem):
    loss, tip = eqx.filter_jit(displacement_loss(*problem)), problem[1].tip
    moved = local_step(loss, tip, longest=1e-3)
    assert loss(moved) < loss(tip)
    assert 0 < jnp.linalg.norm(moved - tip) <= 1e-3 + ROUNDING


def bowl(tip):
    """Return a loss with its minimum at (0.01, 0, 0.01), and NaN far to the left."""
    return jnp.where(tip[0] < -0.02, jnp.nan, 1e3 * jnp.sum((tip - jnp.array([0.01, 0.0, 0.01])) ** 2))


def test_samples_end_in_order_within_the_box_and_those_that_are_not_finite_come_last():
    """A sixth of the box is NaN; the best of 100 samples ends within 7 mm of the minimum, which is a loss of 0.05."""
    found = large_step(bowl, LOW, HIGH, jax.random.key(0))
    assert ((LOW[None] <= found.tips) & (found.tips <= HIGH[None])).all()
    assert (jnp.diff(found.loss[jnp.isfinite(found.loss)]) >= 0).all()
    assert jnp.isinf(found.loss[-1]) and jnp.isinf(found.loss).mean() < 0.4
    assert found.loss[0] < 0.05


def test_the_descent_lowers_the_loss_and_the_best_samples_are_kept():
    without_descent = large_step(bowl, LOW, HIGH, jax.random.key(1), iterations=0)
    descended = large_step(bowl, LOW, HIGH, jax.random.key(1))
    assert descended.loss[0] < without_descent.loss[0]
    following = large_step(bowl, LOW, HIGH, jax.random.key(2), descended, iterations=0)
    kept = round(KEPT_SHARE * len(following.loss))
    np.testing.assert_allclose(following.loss[:kept], descended.loss[:kept])


def test_the_large_step_is_truncated_and_never_goes_too_far():
    tip = jnp.array([0.0, 0.0, 0.01])
    found = Samples(tips=jnp.array([[0.02, 0.0, 0.01]]), loss=jnp.zeros(1))
    np.testing.assert_allclose(truncated_step(found, tip, longest=5e-3), [0.005, 0.0, 0.01])
    np.testing.assert_allclose(truncated_step(found, tip, longest=0.1), [0.02, 0.0, 0.01])


def test_no_primitive_goes_down():
    assert len(PRIMITIVES) == 5
    for direction in PRIMITIVES.values():
        assert np.linalg.norm(direction) == 1 and direction[2] >= 0
