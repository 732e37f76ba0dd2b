"""Effects: no change at parameters of 0, derivatives against finite differences, and closed forms."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jiggle_mj.estimator.effects import LIBRARY, Effect
from jiggle_mj.estimator.effects.sheet_model import (
    RESTING_DISPLACEMENT,
    FrameContext,
    SheetModel,
    centred,
    nominal_energy,
    tangents,
)
from jiggle_mj.estimator.physics.environment import Weight
from jiggle_mj.estimator.physics.membrane import TriangleMembrane
from jiggle_mj.estimator.physics.mesh import SheetMesh
from tests.support.small_sheet import DECLARATION, lifts, sheet, sheet_energy

DIFFERENCE = 1e-4
"""Step of finite differences, in prior standard deviations."""
DIFFERENCE_ERROR = 2e-3
"""Error of finite differences, as a share of the largest derivative: their curvature, most of all of friction."""
ROUNDING = 1e-9
"""Rounding of quantities in the comparable units of `observables`."""
EXACT = 1e-12
"""Rounding of forces [N] and lengths [m] in closed forms."""
DISPLACEMENT = np.array([1e-3, 2e-3, 6e-3])
"""Displacement of the tool between two reports [m]."""
EFFECTS = {effect.name: effect for effect in LIBRARY}


@pytest.fixture(scope="module")
def context():
    """Return the context of the third frame of the first grasp."""
    states = jnp.asarray(np.stack([lift.x for lift in lifts()[:4]]))
    times = jnp.array([0.0, 0.5, 1.25, 2.0])
    displacements = jnp.asarray(np.outer([0.0, 1.0, 2.0, 3.0], DISPLACEMENT))
    return FrameContext(
        rest=jnp.asarray(sheet().rest),
        time=times[2],
        gap=times[2] - times[1],
        earlier_gap=times[1] - times[0],
        closed=times[2],
        now=states[2],
        before=states[1],
        earlier=states[0],
        report_times=times,
        reports=displacements,
        past=states,
        began=jnp.array([0.0, 0.0, 0.5, 1.25]),
        ended=times,
    )


@pytest.fixture(scope="module")
def plain(context):
    return SheetModel(
        energy=nominal_energy(sheet(), DECLARATION),
        tool=jnp.asarray(2 * DISPLACEMENT),
        view=centred(sheet()),
        time=context.time,
    )


def observables(effect: Effect, plain: SheetModel, context: FrameContext):
    """Return the function of theta that gives forces, observed positions, tool and anchors, in comparable units."""
    x, membrane = context.now, plain.term(TriangleMembrane)
    force, length = 1e-4, 1e-4

    @jax.jit
    def all_of(theta):
        model = effect.acts(plain, theta, context)
        seen = model.view(x, tangents=tangents(membrane, x))
        parts = (
            model.energy.internal_gradient(x) / force,
            seen / length,
            model.tool / length,
            model.energy.rest / length,
            model.force_factor,
        )
        return jnp.concatenate([part.ravel() for part in parts])

    return all_of


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_changes_nothing_at_zero_and_its_derivatives_are_finite_differences(name, plain, context):
    effect = EFFECTS[name]
    with jax.enable_x64(True):
        all_of, sd = observables(effect, plain, context), np.ravel(effect.prior_sds)
        zero = jnp.zeros(effect.size)
        without = observables(dataclasses.replace(effect, acts=lambda model, theta, context: model), plain, context)(
            zero
        )
        np.testing.assert_allclose(all_of(zero), without, rtol=0, atol=ROUNDING)
        draw = np.random.default_rng(0)
        for at in (np.zeros(effect.size), 0.3 * sd * draw.normal(size=effect.size)):
            step = sd * draw.normal(size=effect.size)
            _, derivative = jax.jvp(all_of, (jnp.asarray(at),), (jnp.asarray(step),))
            difference = (all_of(at + DIFFERENCE * step) - all_of(at - DIFFERENCE * step)) / (2 * DIFFERENCE)
            scale = float(jnp.max(jnp.abs(derivative)))
            np.testing.assert_allclose(derivative, difference, rtol=0, atol=DIFFERENCE_ERROR * scale + ROUNDING)
            assert scale > 0 or (name in ("inertia", "friction") and not at.any()), "it changes nothing at all"


def test_the_energy_with_room_for_effects_is_the_declared_one(plain):
    with jax.enable_x64(True):
        x = jnp.asarray(lifts()[2].x)
        declared, b = sheet_energy().gradient(x, jnp.zeros(len(x))), jnp.zeros(len(x))
        np.testing.assert_allclose(plain.energy.gradient(x, b), declared, rtol=0, atol=EXACT)


def test_another_poissons_ratio_is_the_membrane_built_with_it(plain, context):
    with jax.enable_x64(True):
        k, nu = DECLARATION.membrane_stiffness, DECLARATION.poisson
        changed = EFFECTS["poisson"].acts(plain, jnp.array([-0.2]), context).term(TriangleMembrane)
        built = TriangleMembrane.build(sheet(), stiffness=k, poisson=nu - 0.2)
        np.testing.assert_allclose(changed.elasticity, built.elasticity, rtol=ROUNDING)


def test_gravity_and_drag_are_their_closed_forms(plain, context):
    with jax.enable_x64(True):
        forces = lambda model: np.asarray(model.energy.internal_gradient(context.now))  # noqa: E731
        mass = np.asarray(plain.term(Weight).mass)
        heavier = EFFECTS["gravity"].acts(plain, jnp.array([0.0, 0.0, -1.0]), context)
        np.testing.assert_allclose(
            forces(heavier) - forces(plain), mass[:, None] * [[0, 0, 9.80665]], rtol=0, atol=EXACT
        )
        dragged = EFFECTS["viscous_drag"].acts(plain, jnp.array([1e-3]), context)
        speed = np.asarray((context.now - context.before) / context.gap)
        k = DECLARATION.membrane_stiffness
        np.testing.assert_allclose(forces(dragged) - forces(plain), 1e-3 * k * speed, rtol=0, atol=EXACT)


def test_the_lag_is_that_of_an_exponential(context):
    """For a tool that moved evenly up to the frame, in the first half of the time alone, and not at all."""
    lag, gap = 0.5, float(context.gap)
    even = lag / gap * (1 - np.exp(-gap / lag))
    half = gap / 2
    times = jnp.array([0.5, 0.5 + half, 1.25, 2.0])
    early = eqx.tree_at(
        lambda m: (m.report_times, m.reports),
        context,
        (times, jnp.asarray(np.outer([1.0, 2.0, 2.0, 3.0], DISPLACEMENT))),
    )
    resting = eqx.tree_at(lambda m: m.reports, context, jnp.asarray(np.outer([0.0, 1.0, 1.0, 3.0], DISPLACEMENT)))
    with jax.enable_x64(True):
        constant = jnp.asarray(lag)
        stays, share = np.exp(-gap / lag), RESTING_DISPLACEMENT / (RESTING_DISPLACEMENT + np.linalg.norm(DISPLACEMENT))
        assert float(context.lag_share(constant)) == pytest.approx((1 - share) * even + share * stays)
        late = lag / half * (np.exp(-half / lag) - stays)
        assert float(early.lag_share(constant)) == pytest.approx((1 - share) * late + share * stays)
        assert float(resting.lag_share(constant)) == pytest.approx(stays)


def test_damped_tissue_resists_its_motion_since_the_frame_before(plain, context):
    """In the earlier state the force is below 1 % of that: hinges stretched within their plane become stiffer there."""
    with jax.enable_x64(True):
        damped = EFFECTS["material_damping"].acts(plain, jnp.array([0.3]), context)
        forces = lambda model, x: np.asarray(model.energy.internal_gradient(x))  # noqa: E731
        added = forces(damped, context.now) - forces(plain, context.now)
        before = forces(damped, context.before) - forces(plain, context.before)
        np.testing.assert_allclose(before, 0, atol=0.01 * np.abs(added).max())
        assert np.sum(added * np.asarray(context.now - context.before)) > 0
        np.testing.assert_allclose(added.sum(axis=0), 0, atol=EXACT)


def test_friction_resists_the_displacement_along_the_bed_by_mu_times_the_weight(plain, context):
    """To 0.1 %: the displacement is 100 times the length over which friction builds up, which counts by its square."""
    with jax.enable_x64(True):
        rest = jnp.asarray(sheet().rest)
        lying = eqx.tree_at(lambda m: (m.now, m.before), context, (rest, rest - jnp.array([[5e-3, 0.0, 0.0]])))
        slid = EFFECTS["friction"].acts(plain, jnp.array([0.4]), lying)
        force = np.asarray(slid.energy.internal_gradient(rest) - plain.energy.internal_gradient(rest))
        weight = np.asarray(plain.term(Weight).mass) * 9.80665
        np.testing.assert_allclose(force[:, 0], 0.4 * weight, rtol=1e-3)
        np.testing.assert_allclose(force[:, 1:], 0, atol=EXACT)


def test_rotating_the_camera_rotates_about_the_middle(plain, context):
    with jax.enable_x64(True):
        x, membrane = context.now, plain.term(TriangleMembrane)
        theta = jnp.array([1e-3, 0.0, 0.0, 0.0, 0.0, np.pi / 2])
        view = EFFECTS["camera_bias"].acts(plain, theta, context).view
        seen = np.asarray(view(x, tangents=tangents(membrane, x)))
        middle = sheet().rest.mean(axis=0)
        arm = np.asarray(x) - middle
        np.testing.assert_allclose(seen - middle, np.column_stack([1e-3 - arm[:, 1], arm[:, 0], arm[:, 2]]), atol=EXACT)


@pytest.mark.parametrize("site", range(EFFECTS["camera_drift"].sites))
def test_a_drift_at_any_of_its_rates_is_a_pose_that_grows_with_time(site, plain, context):
    rate, began = np.array([1e-4, 0.0, -2e-4, 0.0, 1e-3, 0.0]), 0.5
    with jax.enable_x64(True):
        theta = np.zeros((EFFECTS["camera_drift"].sites, 7))
        theta[site] = [*rate, began]
        drifted = EFFECTS["camera_drift"].acts(plain, jnp.asarray(theta.ravel()), context).view
        pose = (float(context.time) - began) * rate
        expected = EFFECTS["camera_bias"].acts(plain, jnp.asarray(pose), context).view
        np.testing.assert_allclose(drifted.shift, expected.shift, atol=EXACT)
        np.testing.assert_allclose(drifted.rotation, expected.rotation, atol=EXACT)


def test_a_late_report_is_where_the_tool_was(plain, context):
    with jax.enable_x64(True):
        later = EFFECTS["tool_latency"].acts(plain, jnp.array([0.375]), context)
        np.testing.assert_allclose(later.tool, 2.5 * DISPLACEMENT, atol=EXACT)


def test_a_rotated_displacement_keeps_its_length(plain, context):
    with jax.enable_x64(True):
        rotated = EFFECTS["tool_turn"].acts(plain, jnp.array([0.0, np.pi / 2, 0.0]), context)
        x, y, z = 2 * DISPLACEMENT
        np.testing.assert_allclose(rotated.tool, [z, y, -x], atol=EXACT)


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"name": "a name"}, "letters, digits and underscores; got 'a name'"),
        ({"units": ("m", "m")}, "one entry for each parameter; got 2 and 1"),
        ({"prior_sd": (0.0,)}, "prior_sd must be above 0"),
        ({"initial_guesses": ((1.0, 2.0),)}, "each of initial_guesses needs 1 parameters"),
        ({"sites": 2, "site_prior_sd": ((1.0,),)}, "1 numbers above 0 for each of 2 sites"),
        ({"sites": 2, "site_prior_sd": ((2.0,), (1.0,))}, "first those of prior_sd"),
    ],
)
def test_a_users_effect_is_checked(changed, says):
    given = {
        "name": "mine",
        "acts": lambda model, theta, context: model,
        "units": ("m",),
        "prior_sd": (1.0,),
        "source": "me",
    }
    with pytest.raises(ValueError, match=says):
        Effect(**{**given, **changed})


def test_the_surface_of_a_cylinder_has_a_larger_radius(plain, context):
    """The middle surface is bent to a cylinder.

    Normals at vertices of unequal triangles err by part of the sheet's rotation along an edge.
    """
    radius, height = 0.05, 5e-4
    with jax.enable_x64(True):
        rest, membrane = sheet().rest, plain.term(TriangleMembrane)
        angle = rest[:, 0] / radius
        normal = np.column_stack([np.sin(angle), np.zeros(len(rest)), np.cos(angle)])
        middle = np.column_stack([radius * normal[:, 0], rest[:, 1], radius * normal[:, 2]])
        above = middle + np.array([0.0, 0.0, height])
        view = EFFECTS["surface_height"].acts(plain, jnp.array([height]), context).view
        seen = np.asarray(view(jnp.asarray(above), tangents=tangents(membrane, jnp.asarray(above))))
        normal_error = height * sheet().spacing / radius / 2
        inner = np.all(np.abs(rest[:, :2]) < 0.9 * np.abs(rest[:, :2]).max(axis=0), axis=1)
        np.testing.assert_allclose(seen[inner], (middle + height * normal)[inner], rtol=0, atol=normal_error)
        assert np.linalg.norm(seen - above, axis=1).max() > 5 * normal_error


def test_sliding_points_stay_on_a_bent_sheet_and_stop_at_its_edge(plain, context):
    """z = 3 x^2 - 2 x y, which a patch repeats."""
    with jax.enable_x64(True):
        rest, membrane = sheet().rest, plain.term(TriangleMembrane)
        bent = np.column_stack([rest[:, 0], rest[:, 1], 3 * rest[:, 0] ** 2 - 2 * rest[:, 0] * rest[:, 1]])
        derivative = np.zeros((len(rest), 3, 2))
        derivative[:, 0, 0] = derivative[:, 1, 1] = 1.0
        derivative[:, 2] = np.column_stack([6 * rest[:, 0] - 2 * rest[:, 1], -2 * rest[:, 0]])
        by = np.array([0.0071, -0.0043])
        view = (
            EFFECTS["point_slip"].acts(plain, jnp.asarray([*(by / (float(context.time) - 0.25)), 0.25]), context).view
        )
        assert np.allclose(np.mean(np.asarray(tangents(membrane, jnp.asarray(rest))), axis=0), np.eye(3)[:, :2])
        slid, (low, high) = rest[:, :2] + by, (rest[:, :2].min(axis=0), rest[:, :2].max(axis=0))
        inside = np.all((slid > low + 3e-3) & (slid < high - 3e-3), axis=1)
        seen = np.asarray(view(jnp.asarray(bent), tangents=jnp.asarray(derivative)))
        np.testing.assert_allclose(seen[inside, :2], slid[inside], atol=EXACT)
        curve = 3 * slid[:, 0] ** 2 - 2 * slid[:, 0] * slid[:, 1]
        np.testing.assert_allclose(seen[inside, 2], curve[inside], atol=EXACT)
        assert 10 < inside.sum() < len(inside)
        assert np.all((seen[:, :2] > low - 1e-5) & (seen[:, :2] < high + 1e-5))


def test_nothing_slides_at_zero_over_a_sheet_that_is_bent_and_rotated_at_rest(plain, context):
    """Places in the mean plane are closer together there than in the triangles' own planes."""
    with jax.enable_x64(True):
        flat = sheet().rest
        bent = np.column_stack([flat[:, 0], flat[:, 1], 4 * flat[:, 0] ** 2])
        rotated = bent @ Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix().T
        mesh = SheetMesh(rotated, sheet().faces)
        model = SheetModel(
            energy=nominal_energy(mesh, DECLARATION), tool=plain.tool, view=centred(mesh), time=plain.time
        )
        rotated_context = dataclasses.replace(context, rest=jnp.asarray(rotated))
        for theta in (0.0, 1e-12):
            view = EFFECTS["point_slip"].acts(model, jnp.full(3, theta), rotated_context).view
            seen = view(context.now, tangents=tangents(model.term(TriangleMembrane), context.now))
            np.testing.assert_allclose(seen, context.now, atol=ROUNDING)
