"""A sheet that hangs still: its vertical, and the tension that supports its weight in its measured shape."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jiggle_mj.estimator.effects import LIBRARY
from jiggle_mj.estimator.physics.environment import Weight
from jiggle_mj.estimator.physics.hanging import Tension
from jiggle_mj.estimator.physics.mesh import SheetMesh
from jiggle_mj.estimator.physics.surrogate import surrogate
from tests.support.small_sheet import DECLARATION, at_rest, equilateral, jittered

G = -DECLARATION.gravity[2]
AIR = dataclasses.replace(DECLARATION, bed=False)
FLAT = jittered(equilateral(7, 9), 0.1)
HUNG = SheetMesh(FLAT.rest[:, [0, 2, 1]], FLAT.faces)
"""The sheet in the plane of x and z."""
BALANCED = 1e-5
"""Largest unbalanced force [weight of a particle]: the weak springs of `TETHER_STIFFNESS` take this much."""


def unbalanced(energy, mesh: SheetMesh) -> np.ndarray:
    """Return the unbalanced force on each particle [largest weight of a particle]."""
    weight = next(term for term in energy.terms if isinstance(term, Weight))
    force = eqx.filter_jit(lambda e, x: e.internal_gradient(x))(energy, jnp.asarray(mesh.rest))
    return np.linalg.norm(np.asarray(force), axis=1) / np.abs(np.asarray(weight.force)).max()


@pytest.mark.parametrize("membrane", ["triangles", "edges"])
@pytest.mark.parametrize("held_by", ["its edge", "a corner"])
def test_all_but_the_topmost_particles_are_in_balance_in_the_measured_shape(membrane, held_by):
    middle = np.average(HUNG.rest, axis=0, weights=HUNG.particle_area)
    to_corner = HUNG.rest[np.argmax(HUNG.rest.sum(axis=1))] - middle
    angle = -np.arctan2(to_corner[0], to_corner[2]) if held_by == "a corner" else 0.0
    mesh = SheetMesh(Rotation.from_euler("y", angle).apply(HUNG.rest), HUNG.faces)
    with jax.enable_x64(True):
        force = unbalanced(surrogate(mesh, AIR, membrane=membrane), mesh)
    height = mesh.rest[:, 2]
    top = height > height.max() - mesh.spacing / 2
    assert top.sum() == (3 if held_by == "a corner" else 7)
    assert force[~top].max() < BALANCED


@pytest.mark.parametrize(("name", "theta"), [("gravity", [0, 0, 0.4]), ("stretch", [0.7]), ("poisson", [-0.2])])
def test_weight_and_stiffness_change_nothing_in_the_measured_shape(name, theta):
    effect = next(effect for effect in LIBRARY if effect.name == name)
    with jax.enable_x64(True):
        model, moment = at_rest(HUNG, AIR)
        force = unbalanced(effect.acts(model, jnp.asarray(theta, dtype=float), moment).energy, HUNG)
    height = HUNG.rest[:, 2]
    assert force[height < height.max() - HUNG.spacing / 2].max() < BALANCED


def test_gravity_is_rotated_into_the_plane_of_a_slightly_inclined_sheet_only():
    """`MAX_NORMAL_GRAVITY` is 12 degrees."""
    for lean, hangs in ((np.radians(5), True), (np.radians(-8), True), (np.radians(30), False)):
        rotation = np.array([[1, 0, 0], [0, np.cos(lean), -np.sin(lean)], [0, np.sin(lean), np.cos(lean)]])
        mesh = SheetMesh(HUNG.rest @ rotation.T, HUNG.faces)
        terms = surrogate(mesh, AIR).terms
        gravity = next(np.asarray(term.gravity) for term in terms if isinstance(term, Weight))
        np.testing.assert_allclose(gravity, rotation @ [0, 0, -G] if hangs else [0, 0, -G], atol=1e-12)
        assert any(isinstance(term, Tension) for term in terms) == hangs
