"""A sheet that hangs still: its vertical, and the tension that carries its weight where it was seen."""

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
"""In the plane of x and z."""


def unbalanced(energy, mesh: SheetMesh) -> np.ndarray:
    """Of each particle, by the largest weight of one."""
    weight = next(term for term in energy.terms if isinstance(term, Weight))
    force = eqx.filter_jit(lambda e, x: e.internal_gradient(x))(energy, jnp.asarray(mesh.rest))
    return np.linalg.norm(np.asarray(force), axis=1) / np.abs(np.asarray(weight.force)).max()


@pytest.mark.parametrize("membrane", ["triangles", "edges"])
@pytest.mark.parametrize("by", ["its edge", "a corner"])
def test_it_is_in_balance_where_it_was_seen_but_for_its_topmost_particles(membrane, by):
    middle = np.average(HUNG.rest, axis=0, weights=HUNG.particle_area)
    to_corner = HUNG.rest[np.argmax(HUNG.rest.sum(axis=1))] - middle
    turn = -np.arctan2(to_corner[0], to_corner[2]) if by == "a corner" else 0.0
    mesh = SheetMesh(Rotation.from_euler("y", turn).apply(HUNG.rest), HUNG.faces)
    with jax.enable_x64(True):
        off = unbalanced(surrogate(mesh, AIR, membrane=membrane), mesh)
    height = mesh.rest[:, 2]
    top = height > height.max() - mesh.spacing / 2
    assert top.sum() == (3 if by == "a corner" else 7)
    assert off[~top].max() < 1e-5


@pytest.mark.parametrize(("name", "theta"), [("gravity", [0, 0, 0.4]), ("stretch", [0.7]), ("poisson", [-0.2])])
def test_what_it_weighs_and_how_stiff_it_is_change_nothing_where_it_was_seen(name, theta):
    effect = next(one for one in LIBRARY if one.name == name)
    with jax.enable_x64(True):
        model, moment = at_rest(HUNG, AIR)
        off = unbalanced(effect.acts(model, jnp.asarray(theta, dtype=float), moment).energy, HUNG)
    height = HUNG.rest[:, 2]
    assert off[height < height.max() - HUNG.spacing / 2].max() < 1e-5


def test_a_sheet_that_leans_is_pulled_within_its_plane_and_one_that_is_held_up_is_not():
    for lean, taken in ((np.radians(5), True), (np.radians(-8), True), (np.radians(30), False)):
        rotated = np.array([[1, 0, 0], [0, np.cos(lean), -np.sin(lean)], [0, np.sin(lean), np.cos(lean)]])
        mesh = SheetMesh(HUNG.rest @ rotated.T, HUNG.faces)
        terms = surrogate(mesh, AIR).terms
        pulled = next(np.asarray(term.gravity) for term in terms if isinstance(term, Weight))
        np.testing.assert_allclose(pulled, rotated @ [0, 0, -G] if taken else [0, 0, -G], atol=1e-12)
        assert any(isinstance(term, Tension) for term in terms) == taken
