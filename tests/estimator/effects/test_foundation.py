"""What is under the sheet: a hold spread over all of it, and a base that gives way under the loads of attachments."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jiggle_mj.estimator.effects import LIBRARY
from jiggle_mj.estimator.effects.terms import DeadLoad
from tests.support.small_sheet import DECLARATION, at_rest, sheet

EXACT = 1e-12
"""Rounding of forces [N] and lengths [m]."""
TETHERING, SUBSTRATE = (next(one for one in LIBRARY if one.name == name) for name in ("tethering", "substrate"))
LOADED = 40
"""A particle in the middle of the sheet."""


def anchors_moved_by(force: np.ndarray, compliance: float) -> np.ndarray:
    """Return how far the anchors move where one attachment carries a force [N], for a shear compliance [1/Pa].

    The sheet lies at rest, and has moved by a nanometre as the force pulls: no other force changes by that.
    """
    plain, moment = at_rest(sheet(), DECLARATION)
    pulled = np.zeros_like(sheet().rest)
    pulled[LOADED] = force
    model = plain.with_term(eqx.tree_at(lambda t: t.force, plain.term(DeadLoad), jnp.asarray(pulled)))
    moved = eqx.tree_at(lambda m: m.now, moment, moment.rest + 1e-9 * jnp.asarray(force / np.linalg.norm(force))[None])
    return np.asarray(SUBSTRATE.acts(model, jnp.array([compliance]), moved).energy.rest - moment.rest)


def test_tethering_is_a_spring_to_rest_by_each_particles_area():
    with jax.enable_x64(True):
        plain, moment = at_rest(sheet(), DECLARATION)
        tethered, by = TETHERING.acts(plain, jnp.array([2e4]), moment), np.array([1e-3, -2e-3, 3e-3])
        x = moment.rest + jnp.asarray(by)[None]
        force = np.asarray(tethered.energy.internal_gradient(x) - plain.energy.internal_gradient(x))
        np.testing.assert_allclose(force, 2e4 * sheet().particle_area[:, None] * by[None], rtol=0, atol=EXACT)
        np.testing.assert_allclose(force.sum(axis=0), 2e4 * sheet().face_area.sum() * by, rtol=1e-9)


def test_the_base_gives_way_as_an_incompressible_half_space():
    """Along the surface as Cerruti has it, across it as Boussinesq [Johnson 1985], with Poisson's ratio 1/2.

    u_x = F_x (1 - nu + nu x^2 / r^2) / (2 pi G r)
    u_y = F_x nu x y / (2 pi G r^3)
    u_z = F_z (1 - nu) / (2 pi G r)
    """
    nu, compliance, other = 0.5, 1e-3, np.arange(sheet().n) != LOADED
    x, y, _ = (sheet().rest - sheet().rest[LOADED])[other].T
    r = np.hypot(x, y)
    with jax.enable_x64(True):
        along = anchors_moved_by(np.array([0.05, 0.0, 0.0]), compliance)
        across = anchors_moved_by(np.array([0.0, 0.0, 0.05]), compliance)
        size = 0.05 * compliance / (2 * np.pi * r[:, None])
        expected = size * np.column_stack([1 - nu + nu * x**2 / r**2, nu * x * y / r**2, 0 * x])
        tolerance = 1e-4 * np.abs(expected).max()  # the sheet's own forces by a nanometre
        np.testing.assert_allclose(along[other], expected, rtol=0, atol=tolerance)
        np.testing.assert_allclose(across[other], size * np.array([[0.0, 0.0, 1 - nu]]), rtol=0, atol=tolerance)
        np.testing.assert_allclose(np.stack([along[LOADED], across[LOADED]]), 0, atol=tolerance)


def test_what_the_jaws_hold_does_not_load_the_base():
    """A force against the sheet's displacement is balanced by the jaws, not by an attachment."""
    with jax.enable_x64(True):
        plain, moment = at_rest(sheet(), DECLARATION)
        lifted = eqx.tree_at(lambda m: m.now, moment, moment.rest + jnp.array([[0.0, 0.0, 5e-3]]))
        moved = SUBSTRATE.acts(plain, jnp.array([1e-3]), lifted).energy.rest
        np.testing.assert_array_equal(moved, moment.rest)
