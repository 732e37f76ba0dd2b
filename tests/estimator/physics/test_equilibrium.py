"""The equilibrium: balance of forces, scipy's minimum, implicit derivatives, and honest failure."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from jiggle_mj.estimator.physics.block_tridiagonal import cholesky, multiply, solve
from jiggle_mj.estimator.physics.equilibrium import MAX_LINEAR_RESIDUAL, equilibrium, newton_step
from jiggle_mj.estimator.physics.surrogate import surrogate
from jiggle_mj.observation import Declaration
from tests.support.small_sheet import (
    DECLARATION,
    FORCE_TOLERANCE,
    STIFFNESS,
    attached,
    corners,
    equilateral,
    gripped,
    lifts,
    search,
    sheet,
    sheet_energy,
)

SAME_POSITION = 3e-7
"""Distance of two converged states [m]: twice the force tolerance of 1e-8 N over the stiffness of bending,
3e-6 N m / (7 mm)^2 = 0.06 N/m."""
TIGHT_FORCE = 1e-11
"""Force tolerance for states that are differentiated numerically [N]."""


@pytest.fixture(scope="module")
def lifted():
    """Return the shared sheet with a lifted corner, its attachments, and its equilibrium."""
    corner = corners()[0]
    energy = gripped(sheet_energy(), sheet().rest, corner, corner + np.array([2e-3, 2e-3, 0.012]))
    b = jnp.asarray(STIFFNESS * attached())
    return energy, b, search(energy, b, jnp.asarray(sheet().rest))


def test_forces_balance_to_the_tolerance(lifted):
    energy, b, found = lifted
    assert bool(found.converged) and int(found.steps) > 1
    force = float(jnp.max(jnp.abs(jax.grad(energy.value)(found.x, b))))
    assert force <= FORCE_TOLERANCE * (1 + 1e-6)
    assert float(found.force) == pytest.approx(force, abs=1e-12)


def test_the_held_corner_moves_with_the_tip_and_the_attached_middle_lags(lifted):
    energy, _, found = lifted
    moved = np.linalg.norm(np.asarray(found.x) - sheet().rest, axis=1)
    held = np.asarray(energy.terms[-1].stiffness) > 0
    assert moved[held].min() > 8e-3 > 3e-3 > moved[attached()].max()


def test_the_end_does_not_depend_on_the_start(lifted):
    energy, b, found = lifted
    draw = np.random.default_rng(0)
    for shift in (1e-3 * draw.normal(size=sheet().rest.shape), np.array([0.0, 0.0, 0.01])):
        other = search(energy, b, jnp.asarray(sheet().rest + shift))
        assert bool(other.converged)
        np.testing.assert_allclose(other.x, found.x, atol=SAME_POSITION)


def test_a_search_cut_short_says_that_it_has_not_converged(lifted):
    energy, b, _ = lifted
    short = search(energy, b, jnp.asarray(sheet().rest), max_steps=2)
    assert not bool(short.converged)
    assert int(short.steps) == 2
    assert float(short.force) > FORCE_TOLERANCE


@pytest.mark.parametrize("lift", [0.02, 0.04])
def test_the_last_steps_of_a_wrinkled_sheet_converge_quadratically(lift):
    """With elements made positive semi-definite one by one the error falls by a constant factor in each step."""
    mesh = equilateral(24, 18, 4e-3)
    corner = mesh.rest[np.argmax(mesh.rest[:, 0] + mesh.rest[:, 1])]
    energy = gripped(surrogate(mesh, DECLARATION), mesh.rest, corner, corner + np.array([-0.01, -0.01, lift]))
    far = np.linalg.norm(mesh.rest[:, :2] - corner[None, :2], axis=1) > 0.05
    b, start = jnp.asarray(STIFFNESS * (far & (np.arange(mesh.n) % 5 == 0))), jnp.asarray(mesh.rest)
    usual, tight = search(energy, b, start), search(energy, b, start, force_tolerance=TIGHT_FORCE)
    assert bool(usual.converged) and bool(tight.converged)
    assert int(tight.steps) - int(usual.steps) <= 2


def test_a_step_that_single_precision_cannot_solve_is_solved_in_double():
    """A sheet that floats except for 1e-7 N/m per particle, against membrane edges of 30 N/m."""
    energy, b = surrogate(sheet(), Declaration(gravity=(0.0, 0.0, 0.0), bed=False)), jnp.full(sheet().n, 1e-7)
    x = jnp.asarray(sheet().rest) + jnp.array([[0.0, 0.0, 5e-3]])
    matrix, gradient = energy.hessian(x, b, positive=True), energy.gradient(x, b)

    def residual(step):
        return float(jnp.linalg.norm(multiply(energy.layout, matrix, step) + gradient) / jnp.linalg.norm(gradient))

    single = jax.tree.map(lambda part: part.astype(jnp.float32), (matrix, gradient))
    assert not residual(-solve(energy.layout, cholesky(single[0]), single[1]).astype(float)) < MAX_LINEAR_RESIDUAL
    assert residual(newton_step(energy.layout, matrix, gradient)) < 1e-3 * MAX_LINEAR_RESIDUAL


def test_scipy_finds_the_same_minimum():
    """An independent method: trust-exact with the dense Hessian by autodiff, on a sheet of 16 particles."""
    mesh = equilateral(4, 4)
    energy = surrogate(mesh, DECLARATION)
    corner = mesh.rest[0] + 1e-3
    energy = gripped(energy, mesh.rest, corner, corner + np.array([1e-3, 1e-3, 6e-3]))
    b = jnp.zeros(mesh.n).at[10].set(1.0).at[11].set(1.0)
    shape = mesh.rest.shape
    functions = [jax.jit(f(lambda x: energy.value(x.reshape(shape), b))) for f in (lambda g: g, jax.grad, jax.hessian)]
    value, gradient, hessian = (lambda x, f=f: np.asarray(f(x)) for f in functions)
    theirs = minimize(
        value, mesh.rest.ravel(), jac=gradient, hess=hessian, method="trust-exact", options={"gtol": 1e-9}
    )
    ours = search(energy, b, jnp.asarray(mesh.rest))
    assert theirs.success and bool(ours.converged)
    np.testing.assert_allclose(np.ravel(ours.x), theirs.x, atol=SAME_POSITION)


def test_scaling_every_stiffness_and_weight_moves_nothing(lifted):
    """Only ratios are identifiable from positions: k, plate, bed, weight, grip and b times one factor."""
    energy, b, found = lifted
    scale = 5.0
    declared = dataclasses.replace(
        DECLARATION,
        membrane_stiffness=scale * DECLARATION.membrane_stiffness,
        areal_density=scale * DECLARATION.areal_density,
    )
    grip = eqx.tree_at(lambda g: g.stiffness, energy.terms[-1], scale * energy.terms[-1].stiffness)
    scaled = eqx.tree_at(lambda e: e.terms, energy, (*surrogate(sheet(), declared).terms, grip))
    other = search(scaled, scale * b, jnp.asarray(sheet().rest), force_tolerance=scale * FORCE_TOLERANCE)
    assert bool(other.converged)
    np.testing.assert_allclose(other.x, found.x, atol=SAME_POSITION)


def equilibrium_of(energy, b, tip, start):
    """Return the equilibrium as a function of b and the tip."""
    energy = eqx.tree_at(lambda e: e.terms[-1].tip, energy, tip)
    return equilibrium(energy, b, start, force_tolerance=TIGHT_FORCE).x


def test_implicit_derivatives_in_b_and_tip_equal_finite_differences_forward_and_reverse(lifted):
    """dx/db = -H^-1 blkdiag(x - a) and dx/du in the same form; central differences along random directions."""
    energy, b, found = lifted
    draw = np.random.default_rng(1)
    b = b + 0.2
    tip = energy.terms[-1].tip
    move_b, move_tip = jnp.asarray(draw.normal(size=len(b))), jnp.asarray(draw.normal(size=3) * 1e-3)
    out = jnp.asarray(draw.normal(size=found.x.shape))
    start = search(energy, b, found.x, force_tolerance=TIGHT_FORCE).x

    f = jax.jit(lambda b, tip: equilibrium_of(energy, b, tip, start))
    _, forward = jax.jvp(f, (b, tip), (move_b, move_tip))
    step = 1e-4
    moved = lambda s: eqx.tree_at(lambda e: e.terms[-1].tip, energy, tip + s * move_tip)  # noqa: E731
    ends = [search(moved(s), b + s * move_b, start, force_tolerance=TIGHT_FORCE).x for s in (step, -step)]
    difference = np.asarray(ends[0] - ends[1]) / (2 * step)
    # Positions of about 1 cm move by 1e-7 m and are converged to 1e-11 m.
    scale = float(np.abs(difference).max())
    assert scale > 1e-4
    np.testing.assert_allclose(forward, difference, atol=1e-4 * scale)

    by_b, by_tip = jax.grad(lambda b, tip: jnp.sum(out * f(b, tip)), argnums=(0, 1))(b, tip)
    reverse = float(by_b @ move_b + by_tip @ move_tip)
    assert reverse == pytest.approx(float(jnp.sum(out * forward)), rel=1e-8)


def test_lifts_used_by_other_tests_have_converged():
    """12 frames and four closings, each from the one before."""
    frames = lifts()
    assert len(frames) == 16
    assert all(frame.held.sum() >= 1 for frame in frames)
