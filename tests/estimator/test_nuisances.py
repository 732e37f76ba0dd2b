"""The derivatives by nuisance parameters agree with differences and with Coulomb's law."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from jiggle_mj.estimator.filters.frame import Frame
from jiggle_mj.estimator.nuisances import FRICTION, HEIGHT, dr_dnuisance, normals, prior_sd
from jiggle_mj.estimator.physics.energy import SheetEnergy
from jiggle_mj.estimator.physics.environment import BedContact, Weight
from tests.support.small_sheet import attached, lifts, observed, sheet, sheet_balance, sheet_energy

STEP = 1e-7
"""Height of the finite difference [m]; below it rounding counts, above it curvature."""


def lifted() -> tuple[Frame, jnp.ndarray]:
    """Return a lifted frame linearised at the truth, and its derivatives by the nuisance parameters."""
    balance, truth = sheet_balance(1e-3), lifts()[3]
    frame = balance.linearise(jnp.asarray(truth.x), jnp.asarray(0.1 * attached()), observed(truth, 0))
    return frame, dr_dnuisance(balance, frame, jnp.asarray(sheet().faces))


def test_the_normals_of_a_cylinder_are_its_radii():
    """Within a twentieth: the mesh is 7 mm wide and the radius 60 mm."""
    x, radius = sheet().rest, 0.06
    bent = np.column_stack([radius * np.sin(x[:, 0] / radius), x[:, 1], radius * np.cos(x[:, 0] / radius)])
    radial = np.column_stack([bent[:, 0], 0 * x[:, 1], bent[:, 2]]) / radius
    found = np.asarray(normals(jnp.asarray(bent), jnp.asarray(sheet().faces)))
    assert np.abs(np.abs((found * radial).sum(axis=1)) - 1).max() < 1 / 20


def test_the_derivative_by_the_height_is_that_of_a_surface_seen_above_the_middle():
    """The residual force at y = x + h (m - m_rest) is r(x) less h times the derivative, by the difference at `STEP`."""
    frame, derivative = lifted()
    balance, faces = sheet_balance(1e-3), jnp.asarray(sheet().faces)
    above = normals(frame.x, faces) - normals(jnp.asarray(sheet().rest), faces)
    difference = balance.unbalanced(frame.x + STEP * above, frame.s) - balance.unbalanced(frame.x, frame.s)
    expected = -np.asarray(difference) / STEP
    np.testing.assert_allclose(derivative[:, :, 0], expected, atol=1e-4 * np.abs(expected).max())


def test_friction_resists_the_displacement_of_what_presses_on_the_bed_and_of_nothing_else():
    frame, derivative = lifted()
    friction, bed = np.asarray(derivative[:, :, 1]), term(sheet_energy(), BedContact)
    pressing = np.asarray(bed.gradient(frame.x[bed.vertices])[:, 0])
    d = np.asarray(frame.x - sheet_energy().rest)[:, :2]
    assert not friction[:, 2].any()
    assert not friction[~pressing.any(axis=1)].any() and (pressing == 0).all(axis=1).any()
    assert ((friction[:, :2] * d).sum(axis=1) >= 0).all()
    assert (np.linalg.norm(friction, axis=1) <= np.linalg.norm(pressing, axis=1)).all() and friction.any()


def test_a_sheet_without_a_bed_has_no_friction():
    free = SheetEnergy.build(sheet().rest, (term(sheet_energy(), Weight),), sheet_energy().layout)
    assert set(prior_sd(sheet_energy(), height_sd=5e-4)) == {HEIGHT, FRICTION}
    assert prior_sd(free, height_sd=5e-4) == {HEIGHT: 5e-4}


def term(energy: SheetEnergy, kind: type) -> Any:
    return next(each for each in energy.terms if isinstance(each, kind))
