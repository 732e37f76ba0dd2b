"""XPBD: one spring in closed form, the step as a minimum, the equilibrium at the end, derivatives, zero stiffness."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator.physics.block_tridiagonal import Layout
from jiggle_mj.estimator.physics.energy import SheetEnergy
from jiggle_mj.estimator.physics.environment import Grip, Weight
from jiggle_mj.estimator.physics.equilibrium import equilibrium
from jiggle_mj.estimator.physics.membrane import EdgeMembrane
from jiggle_mj.estimator.physics.mesh import SheetMesh
from jiggle_mj.estimator.physics.xpbd import XPBD, colours, hinge_springs
from tests.support.small_sheet import equilateral, jittered, search

K, BEND, TIME_STEP = 30.0, 1.0, 0.02
"""Membrane [N/m], hinge springs [N/m] and time step [s]."""
SETTLING_TIME_STEP, SETTLING = 3e-4, {"sweeps": 2, "steps": 20_000}
"""Time step for settling [s], short enough to be stable, and its numbers of sweeps and steps."""
GRAVITY = (0.0, 0.0, -9.81)
MESH = jittered(equilateral(5, 5), 0.1)
ATTACHED = np.where(MESH.rest[:, 0] < -8e-3, 3.0, 0.3)
"""Springs of 3 N/m at the left, and weak ones that keep the other particles from swinging freely [N/m]."""
CORNER = MESH.rest[np.argmax(MESH.rest[:, 0] + MESH.rest[:, 1])] + 1e-3
"""Position where the jaws close: not on a particle, whose spring would have no direction [m]."""

settle = eqx.filter_jit(XPBD.settle)
step = eqx.filter_jit(XPBD.step)


def springs(mesh: SheetMesh) -> tuple[EdgeMembrane, EdgeMembrane]:
    return EdgeMembrane.build(mesh, stiffness=K), hinge_springs(mesh, stiffness=BEND)


@cache
def simulator(time_step: float = TIME_STEP) -> XPBD:
    return XPBD.build(MESH, springs(MESH), areal_density=1.0, time_step=time_step, gravity=GRAVITY)


def energy(grip: Grip | None = None) -> SheetEnergy:
    """Return the energy of the same springs and weight, for the equilibrium solver."""
    weight = Weight.build(MESH.particle_area, areal_density=1.0, gravity=GRAVITY)
    terms = (*springs(MESH), weight, *(() if grip is None else (grip,)))
    return SheetEnergy.build(MESH.rest, terms, Layout.from_pattern(MESH.adjacency, MESH.rest))


def gripped(tip: np.ndarray) -> Grip:
    """Return jaws that closed at the corner, with the tip moved since."""
    grip = Grip.build(jnp.asarray(MESH.rest), jnp.asarray(CORNER), radius=8e-3, stiffness=100.0)
    return eqx.tree_at(lambda g: g.tip, grip, jnp.asarray(tip))


TIPS = {
    "flat": CORNER,
    "lifted": CORNER + np.array([-4e-3, -4e-3, 15e-3]),
    "stretched": CORNER + np.array([6e-3, 3e-3, 0.0]),
    "folded": np.array([-5e-3, -5e-3, 8e-3]),
}


def test_one_spring_moves_as_implicit_euler_says():
    """Two particles on a line: the stretch s after a step solves (s - s_0) m / 2 + k dt^2 s = 0, in one sweep."""
    pair = XPBD(
        rest=jnp.array([[0.0, 0, 0], [1, 0, 0]]),
        batches=(),
        inverse_mass=jnp.array([2.0, 2.0]),
        force=jnp.zeros((2, 3)),
        time_step=jnp.asarray(0.1),
    )
    pair = eqx.tree_at(lambda p: p.batches, pair, one_spring(0.8, 30.0))
    x = pair.step(pair.rest, jnp.zeros(2), sweeps=1)
    stretch = 0.2 / (1 + 30.0 * 0.1**2 * 4)
    np.testing.assert_allclose(x[1, 0] - x[0, 0], 0.8 + stretch, rtol=1e-14)
    np.testing.assert_allclose(x.mean(axis=0), [0.5, 0, 0], atol=1e-15)


def one_spring(length: float, stiffness: float):
    return (EdgeMembrane(vertices=np.array([[0, 1]]), length=jnp.array([length]), stiffness=jnp.array([stiffness])),)


def test_colours_hold_each_spring_once_and_no_particle_twice():
    for spring in springs(MESH):
        pairs = np.asarray(spring.vertices)
        groups = colours(pairs, MESH.n)
        assert sorted(np.concatenate(groups).tolist()) == list(range(len(pairs)))
        for group in groups:
            assert len(np.unique(pairs[group])) == 2 * len(group)


def test_a_step_swept_to_the_end_is_implicit_euler_but_for_turning_springs():
    """From rest and without weight, the tip moved by h: M (x - x_t) / dt^2 + grad U is of second order in h, because
    in Macklin's update each impulse keeps the direction that its spring had when the impulse was applied."""
    b = jnp.asarray(ATTACHED)
    sim = eqx.tree_at(lambda s: s.force, simulator(), replace_fn=jnp.zeros_like)
    imbalance = []
    for h in (1e-4, 5e-5, 2.5e-5):
        grip = gripped(CORNER + h * np.array([0.5, 0.5, 0.7]))
        x = step(sim, sim.rest, b, grip, sweeps=3000)
        inertia = (x - sim.rest) / (sim.inverse_mass[:, None] * sim.time_step**2)
        elastic = energy(grip).gradient(x, b) + simulator().force
        imbalance.append(float(np.abs(inertia + elastic).max()))
    np.testing.assert_allclose(np.divide(imbalance[:-1], imbalance[1:]), 4, rtol=0.05)  # 3.88 and 3.95: third order


@pytest.mark.parametrize("name", TIPS)
def test_settling_reaches_the_equilibrium_both_ways(name):
    """A settled state has unbalanced forces below 1e-9 N (one particle weighs 4e-4 N). Newton reaches the same state
    within 1 um after the tip has moved and returned, and settling from there moves it by less than 0.1 um."""
    b, grip = jnp.asarray(ATTACHED), gripped(TIPS[name])
    x = settle(simulator(SETTLING_TIME_STEP), simulator(SETTLING_TIME_STEP).rest, b, grip, **SETTLING)
    assert np.abs(energy(grip).gradient(x, b)).max() < 1e-9
    nudged = search(energy(gripped(TIPS[name] + 1e-4)), b, x).x
    result = search(energy(grip), b, nudged)
    assert result.converged
    again = settle(simulator(SETTLING_TIME_STEP), result.x, b, grip, **SETTLING)
    assert np.abs(result.x - again).max() < 1e-7
    assert np.abs(result.x - x).max() < 1e-6


def test_no_stiffness_is_no_constraint():
    """With all of them zero, a step is a free fall, and its derivative in b is finite."""
    sim = simulator()
    free = eqx.tree_at(lambda s: [batch.stiffness for batch in s.batches], sim, replace_fn=jnp.zeros_like)
    b = jnp.zeros(MESH.n)
    x = free.step(sim.rest, b, sweeps=3)
    np.testing.assert_allclose(x, np.asarray(sim.rest) + TIME_STEP**2 * np.asarray(GRAVITY), atol=1e-15)
    derivative = jax.jit(jax.jacfwd(lambda b: sim.step(sim.rest, b, sweeps=3)))(b)
    assert np.isfinite(derivative).all() and np.abs(derivative).max() > 0


def test_derivatives_agree_with_finite_differences_and_with_each_other():
    """Forward and reverse mode through 15 sweeps, in b and in the tip; relative error 1e-6."""
    sim, grip, b = simulator(), gripped(TIPS["lifted"]), jnp.asarray(ATTACHED)
    rng = np.random.default_rng(0)
    db, du = jnp.asarray(rng.normal(size=MESH.n)), jnp.asarray(rng.normal(size=3))
    weight = jnp.asarray(rng.normal(size=(MESH.n, 3)))

    @jax.jit
    def outcome(b, tip):
        return sim.step(sim.rest, b, eqx.tree_at(lambda g: g.tip, grip, tip), sweeps=15)

    _, forward = jax.jvp(outcome, (b, grip.tip), (db, du))
    h = 1e-6
    finite = (outcome(b + h * db, grip.tip + h * du) - outcome(b - h * db, grip.tip - h * du)) / (2 * h)
    np.testing.assert_allclose(forward, finite, atol=1e-6 * np.abs(finite).max())
    pull_b, pull_u = jax.vjp(outcome, b, grip.tip)[1](weight)
    np.testing.assert_allclose(pull_b @ db + pull_u @ du, jnp.sum(weight * forward), rtol=1e-10)


def test_at_the_equilibrium_unrolled_and_implicit_derivatives_agree():
    """dx/db through all steps = -H^-1 diag(x - a), to the 2e-5 that settling has not reached."""
    b, grip, sim = jnp.asarray(ATTACHED), gripped(TIPS["stretched"]), simulator(SETTLING_TIME_STEP)
    model, db = energy(grip), jnp.asarray(np.random.default_rng(1).normal(size=MESH.n))
    x = search(model, b, sim.rest).x
    unrolled, implicit = (
        jax.jit(lambda b, db, f=f: jax.jvp(f, (b,), (db,))[1])(b, db)
        for f in (lambda b: sim.settle(x, b, grip, **SETTLING), lambda b: equilibrium(model, b, x).x)
    )
    np.testing.assert_allclose(unrolled, implicit, atol=1e-4 * np.abs(implicit).max())
