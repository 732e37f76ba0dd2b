"""The paper's objectives against their printed matrices, and its slips."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator.belief.gaussian_belief import GaussianBelief
from jiggle_mj.estimator.planning.objectives import (
    boundary_energy,
    log_shrinkage,
    outside,
    uncertainty_weighted_displacement,
    workspace,
)

N = 7


@pytest.fixture
def state():
    """Return x, rest, b and a covariance."""
    draw = np.random.default_rng(0)
    root = draw.normal(size=(N, N))
    return tuple(
        map(jnp.asarray, (draw.normal(size=(N, 3)), draw.normal(size=(N, 3)), draw.uniform(size=N), root @ root.T))
    )


def test_uwd_is_the_norm_of_the_papers_matrix(state):
    """sum_i e_i e_i^T (x) [dx]_i, times Sigma."""
    x, rest, _, covariance = state
    spread = sum(np.kron(np.outer(e, e), np.asarray(x - rest)[i][:, None]) for i, e in enumerate(np.eye(N)))
    expected = np.linalg.norm(spread @ np.asarray(covariance))
    assert uncertainty_weighted_displacement(x, rest, covariance) == pytest.approx(expected)


def test_a_pull_that_displaces_more_may_teach_less():
    """A particle shows its stiffness by as much as it moves: one that moves by 2 against three that move by 1 each."""
    prior = jnp.eye(3)
    one_far, all_near = jnp.diag(jnp.array([2.0, 0.0, 0.0])), jnp.eye(3)
    displaced = [uncertainty_weighted_displacement(x, jnp.zeros((3, 3)), prior) for x in (one_far, all_near)]
    entropy = [log_shrinkage(jnp.zeros((3, 3, 3)).at[:, :, 0].set(x), prior, 1.0) for x in (one_far, all_near)]
    assert displaced[0] > displaced[1]
    np.testing.assert_allclose(entropy, [-np.log(5), -3 * np.log(2)])
    assert entropy[0] > entropy[1]


def test_the_boundary_energy_is_that_of_its_springs(state):
    x, rest, b, _ = state
    pull = jax.grad(boundary_energy)(x, rest, b)
    np.testing.assert_allclose(pull, b[:, None] * (x - rest))
    assert boundary_energy(rest, rest, b) == 0


def test_the_workspace_term_keeps_the_tip_above_the_ground_and_the_printed_one_would_not():
    above, below = jnp.array([0.0, 0.0, 0.01]), jnp.array([0.0, 0.0, -0.01])
    assert workspace(above) == 1 and workspace(below) > 1
    assert outside(above) == 0 and outside(below) > 0
    assert jax.grad(outside)(below)[2] < 0
    omega_min = 1.0
    printed = [max(0.0, omega_min - float(workspace(tip))) for tip in (above, below)]
    assert printed == [0, 0]


def test_the_shrinkage_is_twice_the_fall_of_the_entropy(state):
    """By the filter's own update in information form, with the 1/2 that the paper's entropy lacks."""
    *_, covariance = state
    dx_db = jnp.asarray(np.random.default_rng(1).normal(size=(N, 4, 3)))
    before = GaussianBelief(precision=jnp.linalg.inv(covariance), shift=jnp.zeros(N))
    flat = dx_db.reshape(N, -1)
    after = before.add(flat @ flat.T / 0.3**2, jnp.zeros(N))
    assert log_shrinkage(dx_db, covariance, 0.3) == pytest.approx(2 * (after.entropy() - before.entropy()))


def test_the_shrinkage_survives_where_the_determinant_does_not():
    """At 600 particles |I - K J| is 0 in float64."""
    dx_db = jnp.broadcast_to(10.0 * jnp.eye(600)[:, :, None], (600, 600, 3))
    found = log_shrinkage(dx_db, jnp.eye(600), 1.0)
    assert found == pytest.approx(-600 * np.log(301))
    assert np.exp(found) == 0
