"""Effects: nothing where their parameters are 0, derivatives that finite differences confirm, and closed forms."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jiggle_mj.estimator.effects import LIBRARY, Effect
from jiggle_mj.estimator.effects.sheet_model import STOOD, FrameContext, SheetModel, centred, nominal_energy, tangents
from jiggle_mj.estimator.physics.environment import Weight
from jiggle_mj.estimator.physics.membrane import TriangleMembrane
from jiggle_mj.estimator.physics.mesh import SheetMesh
from tests.support.small_sheet import DECLARATION, lifts, sheet, sheet_energy

STEP = 1e-4
"""Of finite differences, in prior standard deviations."""
ENOUGH = 2e-3
"""Share of a derivative by which differences may miss it."""
WAY = np.array([1e-3, 2e-3, 6e-3])
EFFECTS = {effect.name: effect for effect in LIBRARY}


@pytest.fixture(scope="module")
def moment():
    """The third frame of the first grasp."""
    states = jnp.asarray(np.stack([one.x for one in lifts()[:4]]))
    times = jnp.array([0.0, 0.5, 1.25, 2.0])
    ways = jnp.asarray(np.outer([0.0, 1.0, 2.0, 3.0], WAY))
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
        reports=ways,
        past=states,
        began=jnp.array([0.0, 0.0, 0.5, 1.25]),
        ended=times,
    )


@pytest.fixture(scope="module")
def plain(moment):
    return SheetModel(
        energy=nominal_energy(sheet(), DECLARATION),
        tool=jnp.asarray(2 * WAY),
        view=centred(sheet()),
        time=moment.time,
    )


def shown(effect: Effect, plain: SheetModel, moment: FrameContext):
    """Forces at the frame's state, where it is seen, the tool's way and the anchors, in comparable units."""
    x, membrane = moment.now, plain.term(TriangleMembrane)
    force, length = 1e-4, 1e-4

    @jax.jit
    def all_of(theta):
        model = effect.acts(plain, theta, moment)
        seen = model.view(x, tangents=tangents(membrane, x))
        parts = (
            model.energy.internal_gradient(x) / force,
            seen / length,
            model.tool / length,
            model.energy.rest / length,
        )
        return jnp.concatenate([part.ravel() for part in parts])

    return all_of


@pytest.mark.parametrize("name", EFFECTS)
def test_nothing_at_zero_and_derivatives_are_finite_differences(name, plain, moment):
    effect = EFFECTS[name]
    with jax.enable_x64(True):
        all_of, sd = shown(effect, plain, moment), np.tile(effect.prior_sd, effect.sites)
        zero = jnp.zeros(effect.size)
        without = shown(dataclasses.replace(effect, acts=lambda model, theta, moment: model), plain, moment)(zero)
        np.testing.assert_allclose(all_of(zero), without, rtol=0, atol=1e-9)
        draw = np.random.default_rng(0)
        for at in (np.zeros(effect.size), 0.3 * sd * draw.normal(size=effect.size)):
            way = sd * draw.normal(size=effect.size)
            _, derivative = jax.jvp(all_of, (jnp.asarray(at),), (jnp.asarray(way),))
            difference = (all_of(at + STEP * way) - all_of(at - STEP * way)) / (2 * STEP)
            scale = float(jnp.max(jnp.abs(derivative)))
            np.testing.assert_allclose(derivative, difference, rtol=0, atol=ENOUGH * scale + 1e-9)
            assert scale > 0 or (name in ("inertia", "friction") and not at.any()), "it does nothing at all"


def test_the_energy_with_room_for_effects_is_the_declared_one(plain):
    with jax.enable_x64(True):
        x = jnp.asarray(lifts()[2].x)
        declared, b = sheet_energy().gradient(x, jnp.zeros(len(x))), jnp.zeros(len(x))
        np.testing.assert_allclose(plain.energy.gradient(x, b), declared, rtol=0, atol=1e-12)


def test_another_poissons_ratio_is_the_membrane_built_with_it(plain, moment):
    with jax.enable_x64(True):
        k, nu = DECLARATION.membrane_stiffness, DECLARATION.poisson
        changed = EFFECTS["poisson"].acts(plain, jnp.array([-0.2]), moment).term(TriangleMembrane)
        built = TriangleMembrane.build(sheet(), stiffness=k, poisson=nu - 0.2)
        np.testing.assert_allclose(changed.elasticity, built.elasticity, rtol=1e-9)


def test_gravity_and_drag_are_their_closed_forms(plain, moment):
    with jax.enable_x64(True):
        forces = lambda model: np.asarray(model.energy.internal_gradient(moment.now))  # noqa: E731
        mass = np.asarray(plain.term(Weight).mass)
        heavier = EFFECTS["gravity"].acts(plain, jnp.array([0.0, 0.0, -1.0]), moment)
        np.testing.assert_allclose(
            forces(heavier) - forces(plain), mass[:, None] * [[0, 0, 9.80665]], rtol=0, atol=1e-12
        )
        dragged = EFFECTS["viscous_drag"].acts(plain, jnp.array([1e-3]), moment)
        speed = np.asarray((moment.now - moment.before) / moment.gap)
        k = DECLARATION.membrane_stiffness
        np.testing.assert_allclose(forces(dragged) - forces(plain), 1e-3 * k * speed, rtol=0, atol=1e-12)


def test_what_lags_still_has_to_go_what_an_exponential_leaves(moment):
    """Of a tool that went evenly up to the frame, in the first half of the time alone, and not at all."""
    lag, gap = 0.5, float(moment.gap)
    even = lag / gap * (1 - np.exp(-gap / lag))
    half = gap / 2
    times = jnp.array([0.5, 0.5 + half, 1.25, 2.0])
    stood = eqx.tree_at(
        lambda m: (m.report_times, m.reports), moment, (times, jnp.asarray(np.outer([1.0, 2.0, 2.0, 3.0], WAY)))
    )
    still = eqx.tree_at(lambda m: m.reports, moment, jnp.asarray(np.outer([0.0, 1.0, 1.0, 3.0], WAY)))
    with jax.enable_x64(True):
        constant = jnp.asarray(lag)
        stays, share = np.exp(-gap / lag), STOOD / (STOOD + np.linalg.norm(WAY))
        assert float(moment.left_behind(constant)) == pytest.approx((1 - share) * even + share * stays)
        late = lag / half * (np.exp(-half / lag) - stays)
        assert float(stood.left_behind(constant)) == pytest.approx((1 - share) * late + share * stays)
        assert float(still.left_behind(constant)) == pytest.approx(stays)


def test_damped_tissue_resists_what_it_does_since_the_frame_before(plain, moment):
    """And hardly anything else: of a hinge that is stretched within its plane the rest shape knows nothing."""
    with jax.enable_x64(True):
        damped = EFFECTS["material_damping"].acts(plain, jnp.array([0.3]), moment)
        there = lambda model, x: np.asarray(model.energy.internal_gradient(x))  # noqa: E731
        more = there(damped, moment.now) - there(plain, moment.now)
        none = there(damped, moment.before) - there(plain, moment.before)
        np.testing.assert_allclose(none, 0, atol=0.01 * np.abs(more).max())
        assert np.sum(more * np.asarray(moment.now - moment.before)) > 0
        np.testing.assert_allclose(more.sum(axis=0), 0, atol=1e-12)


def test_friction_resists_the_way_along_the_bed_with_its_share_of_the_load(plain, moment):
    with jax.enable_x64(True):
        rest = jnp.asarray(sheet().rest)
        lying = eqx.tree_at(lambda m: (m.now, m.before), moment, (rest, rest - jnp.array([[5e-3, 0.0, 0.0]])))
        rubbed = EFFECTS["friction"].acts(plain, jnp.array([0.4]), lying)
        force = np.asarray(rubbed.energy.internal_gradient(rest) - plain.energy.internal_gradient(rest))
        weight = np.asarray(plain.term(Weight).mass) * 9.80665
        np.testing.assert_allclose(force[:, 0], 0.4 * weight, rtol=1e-3)
        np.testing.assert_allclose(force[:, 1:], 0, atol=1e-12)


def test_turning_the_camera_is_a_rotation_about_the_middle(plain, moment):
    with jax.enable_x64(True):
        x, membrane = moment.now, plain.term(TriangleMembrane)
        theta = jnp.array([1e-3, 0.0, 0.0, 0.0, 0.0, np.pi / 2])
        view = EFFECTS["camera_bias"].acts(plain, theta, moment).view
        seen = np.asarray(view(x, tangents=tangents(membrane, x)))
        middle = sheet().rest.mean(axis=0)
        off = np.asarray(x) - middle
        np.testing.assert_allclose(seen - middle, np.column_stack([1e-3 - off[:, 1], off[:, 0], off[:, 2]]), atol=1e-12)


def test_a_late_report_is_where_the_tool_was(plain, moment):
    with jax.enable_x64(True):
        later = EFFECTS["tool_latency"].acts(plain, jnp.array([0.375]), moment)
        np.testing.assert_allclose(later.tool, 2.5 * WAY, atol=1e-12)


def test_a_turned_way_is_as_long(plain, moment):
    with jax.enable_x64(True):
        rotated = EFFECTS["tool_turn"].acts(plain, jnp.array([0.0, np.pi / 2, 0.0]), moment)
        x, y, z = 2 * WAY
        np.testing.assert_allclose(rotated.tool, [z, y, -x], atol=1e-12)


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"name": "a name"}, "letters, digits and underscores; got 'a name'"),
        ({"units": ("m", "m")}, "one entry for each parameter; got 2 and 1"),
        ({"prior_sd": (0.0,)}, "prior_sd must be above 0"),
        ({"initial_guesses": ((1.0, 2.0),)}, "each of initial_guesses needs 1 parameters"),
    ],
)
def test_a_users_effect_is_checked(changed, says):
    given = {
        "name": "mine",
        "acts": lambda model, theta, moment: model,
        "units": ("m",),
        "prior_sd": (1.0,),
        "source": "me",
    }
    with pytest.raises(ValueError, match=says):
        Effect(**{**given, **changed})


def test_the_surface_of_a_cylinder_has_a_larger_radius(plain, moment):
    """The middle is bent to one; normals of unequal triangles are off by part of what the sheet turns along an edge."""
    radius, height = 0.05, 5e-4
    with jax.enable_x64(True):
        rest, membrane = sheet().rest, plain.term(TriangleMembrane)
        angle = rest[:, 0] / radius
        normal = np.column_stack([np.sin(angle), np.zeros(len(rest)), np.cos(angle)])
        middle = np.column_stack([radius * normal[:, 0], rest[:, 1], radius * normal[:, 2]])
        above = middle + np.array([0.0, 0.0, height])
        view = EFFECTS["surface_height"].acts(plain, jnp.array([height]), moment).view
        seen = np.asarray(view(jnp.asarray(above), tangents=tangents(membrane, jnp.asarray(above))))
        off = height * sheet().spacing / radius / 2
        inner = np.all(np.abs(rest[:, :2]) < 0.9 * np.abs(rest[:, :2]).max(axis=0), axis=1)
        np.testing.assert_allclose(seen[inner], (middle + height * normal)[inner], rtol=0, atol=off)
        assert np.linalg.norm(seen - above, axis=1).max() > 5 * off


def test_what_slides_is_seen_where_a_bent_sheet_is_and_stops_at_its_edge(plain, moment):
    """z = 3 x^2 - 2 x y, which a patch repeats."""
    with jax.enable_x64(True):
        rest, membrane = sheet().rest, plain.term(TriangleMembrane)
        bent = np.column_stack([rest[:, 0], rest[:, 1], 3 * rest[:, 0] ** 2 - 2 * rest[:, 0] * rest[:, 1]])
        slope = np.zeros((len(rest), 3, 2))
        slope[:, 0, 0] = slope[:, 1, 1] = 1.0
        slope[:, 2] = np.column_stack([6 * rest[:, 0] - 2 * rest[:, 1], -2 * rest[:, 0]])
        by = np.array([0.0071, -0.0043])
        view = EFFECTS["point_slip"].acts(plain, jnp.asarray([*(by / (float(moment.time) - 0.25)), 0.25]), moment).view
        assert np.allclose(np.mean(np.asarray(tangents(membrane, jnp.asarray(rest))), axis=0), np.eye(3)[:, :2])
        slid, (low, high) = rest[:, :2] + by, (rest[:, :2].min(axis=0), rest[:, :2].max(axis=0))
        inside = np.all((slid > low + 3e-3) & (slid < high - 3e-3), axis=1)
        seen = np.asarray(view(jnp.asarray(bent), tangents=jnp.asarray(slope)))
        np.testing.assert_allclose(seen[inside, :2], slid[inside], atol=1e-12)
        curve = 3 * slid[:, 0] ** 2 - 2 * slid[:, 0] * slid[:, 1]
        np.testing.assert_allclose(seen[inside, 2], curve[inside], atol=1e-12)
        assert 10 < inside.sum() < len(inside)
        assert np.all((seen[:, :2] > low - 1e-5) & (seen[:, :2] < high + 1e-5))


def test_nothing_slides_at_zero_over_a_sheet_that_was_bent_and_turned_at_rest(plain, moment):
    """Where places in the mean plane are closer together than in the triangles' own."""
    with jax.enable_x64(True):
        flat = sheet().rest
        bent = np.column_stack([flat[:, 0], flat[:, 1], 4 * flat[:, 0] ** 2])
        rotated = bent @ Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix().T
        mesh = SheetMesh(rotated, sheet().faces)
        model = SheetModel(
            energy=nominal_energy(mesh, DECLARATION), tool=plain.tool, view=centred(mesh), time=plain.time
        )
        there = dataclasses.replace(moment, rest=jnp.asarray(rotated))
        for theta in (0.0, 1e-12):
            view = EFFECTS["point_slip"].acts(model, jnp.full(3, theta), there).view
            seen = view(moment.now, tangents=tangents(model.term(TriangleMembrane), moment.now))
            np.testing.assert_allclose(seen, moment.now, atol=1e-9)
