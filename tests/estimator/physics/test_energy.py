"""The energy's terms: derivatives against autodiff and differences, invariance, closed forms of membrane and plate."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jiggle_mj.estimator.physics.bending import IsometricBending
from jiggle_mj.estimator.physics.energy import Term
from jiggle_mj.estimator.physics.environment import BedContact, Grip, Tether, Weight
from jiggle_mj.estimator.physics.hanging import Tension
from jiggle_mj.estimator.physics.membrane import EdgeMembrane, TriangleMembrane
from jiggle_mj.estimator.physics.surrogate import surrogate
from tests.support.small_sheet import DECLARATION, dense, equilateral, jittered

K, NU, PLATE = 30.0, 0.45, 3e-6
"""Membrane stiffness [N/m], Poisson's ratio, bending stiffness [N m]."""
ROUNDING = 1e-10
"""Relative to the largest entry, for derivatives written out against autodiff."""
DIFFERENCE = 1e-6
"""Relative to the largest entry, for central differences with a step of 1e-6 m: the truncation is h^2 / 6 times a
fourth derivative of about K / (1 mm)^2, so 2e-7 of K."""
SMALLEST_SCALE = 1e-3
"""Largest entry below which errors are absolute: where energies or forces vanish."""
JITTER_ERROR = 0.05
"""Relative error of the bending energy on a jittered mesh: 4 % at any resolution, as hinge weights are exact for
regular triangles alone."""
MESH = jittered(equilateral(4, 4), 0.15)
ROUGH = dataclasses.replace(MESH, rest=MESH.rest + np.random.default_rng(8).normal(size=MESH.rest.shape) * 2e-4)
TIP = MESH.rest[5] + np.array([1e-3, 0.0, 1e-3])


def terms() -> dict[str, Term]:
    generator = np.random.default_rng(1)
    root = generator.normal(size=(MESH.n, 3, 3))
    tether = Tether(
        vertices=np.arange(MESH.n)[:, None],
        to=jnp.asarray(MESH.rest + 1e-3),
        stiffness=jnp.asarray(root @ root.swapaxes(1, 2)),
    )
    plain = TriangleMembrane.build(MESH, stiffness=K, poisson=NU)
    fibres = jnp.asarray(np.outer([0.6, 0.3, 0.4], [0.6, 0.3, 0.4]))
    tissue = dataclasses.replace(
        plain,
        elasticity=plain.elasticity * jnp.asarray(generator.uniform(0.5, 2, (len(MESH.faces), 1, 1)))
        + 2 * K * fibres[None],
        inelastic=jnp.asarray(generator.normal(size=(len(MESH.faces), 3)) * 0.005),
        stiffening=jnp.asarray(5.0),
    )
    stress = jnp.asarray(generator.normal(size=(len(MESH.faces), 3)))
    tension = Tension(vertices=plain.vertices, shape_gradient=plain.shape_gradient, area=plain.area, stress=stress)
    return {
        "triangles": TriangleMembrane.build(MESH, stiffness=K, poisson=NU),
        "fibres that stiffen and are stretched at rest": tissue,
        "edges": EdgeMembrane.build(MESH, stiffness=K),
        "bending": IsometricBending.build(MESH, stiffness=PLATE),
        "bending of a rough sheet": IsometricBending.build(ROUGH, stiffness=PLATE),
        "weight": Weight.build(MESH.particle_area, areal_density=1.0, gravity=(0.0, 1.0, -9.81)),
        "bed": BedContact.build(MESH.rest, load=np.full(MESH.n, 2e-3), up=np.array([0.0, 0.0, 1.0]), stiffness=10.0),
        "grip": Grip.build(jnp.asarray(MESH.rest), jnp.asarray(TIP), radius=8e-3, stiffness=100.0),
        "tether": tether,
        "tension": tension,
    }


def states() -> dict[str, np.ndarray]:
    x = MESH.rest
    bumps = np.column_stack([0 * x[:, 0], 0 * x[:, 0], np.sin(300 * x[:, 0]) * 1e-3])
    return {
        "flat": x,
        "lifted": Rotation.from_euler("xyz", [0.5, -0.4, 0.2]).apply(x * [1.05, 1.1, 1]) + bumps + [0, 0, 0.01],
        "compressed": x * [0.9, 0.8, 1] + bumps,
        "pressed into the bed": x + bumps - [0, 0, 2e-4],
    }


CASES = [(name, state) for name in terms() for state in states()]


def error(actual, expected) -> float:
    """Return the largest difference, relative to the largest entry."""
    scale = max(float(np.max(np.abs(expected))), SMALLEST_SCALE)
    return float(np.max(np.abs(np.asarray(actual) - np.asarray(expected))) / scale)


@pytest.fixture(scope="module")
def derivatives():
    """Return each term's functions, compiled once for all states."""

    def compiled(term: Term):
        total = lambda y: jnp.sum(term.energy(y))  # noqa: E731
        m = len(term.vertices)

        def curvature(y):
            hessian = jax.jacfwd(jax.grad(total))(y)
            return hessian[jnp.arange(m), :, :, jnp.arange(m)]

        names = ("energy", "gradient", "hessian", "positive_hessian")
        energy, *rest = (jax.jit(lambda y, name=name: getattr(term, name)(y)) for name in names)
        return energy, jax.jit(jax.grad(total)), jax.jit(curvature), *rest

    return {name: (term, *compiled(term)) for name, term in terms().items()}


@pytest.mark.parametrize(("name", "state"), CASES)
def test_gradient_and_hessian_are_the_energys_own_derivatives(derivatives, name, state):
    """Written out = autodiff of the energy; gradient = central difference of energy, Hessian = that of the gradient."""
    term, energy, by_autodiff, curvature, gradient, hessian, _ = derivatives[name]
    x = jnp.asarray(states()[state])[term.vertices]
    assert error(gradient(x), by_autodiff(x)) < ROUNDING
    assert error(hessian(x), curvature(x)) < ROUNDING
    step = 1e-6
    forces, stiffnesses = np.zeros(x.shape), np.zeros((*x.shape, *x.shape[1:]))
    for a in range(x.shape[1]):
        for i in range(3):
            move = jnp.zeros(x.shape).at[:, a, i].set(step)
            forces[:, a, i] = (energy(x + move) - energy(x - move)) / (2 * step)
            stiffnesses[:, :, :, a, i] = (gradient(x + move) - gradient(x - move)) / (2 * step)
    # Where forces vanish: the truncation h^2 / 6 times a third derivative of 100 N/m over 1.4 mm, 1.2e-8 N.
    assert np.max(np.abs(forces - gradient(x))) < 2e-8 + DIFFERENCE * float(jnp.max(jnp.abs(gradient(x))))
    assert error(stiffnesses, hessian(x)) < DIFFERENCE


@pytest.mark.parametrize(("name", "state"), CASES)
def test_positive_hessian_has_no_negative_eigenvalue(derivatives, name, state):
    term, *_, positive = derivatives[name]
    x = jnp.asarray(states()[state])[term.vertices]
    size = 3 * x.shape[1]
    values = np.linalg.eigvalsh(np.asarray(positive(x)).reshape(-1, size, size))
    assert values.min() > -ROUNDING * max(float(np.abs(values).max()), SMALLEST_SCALE)


@pytest.mark.parametrize("name", ["triangles", "edges", "grip"])
def test_positive_hessian_is_the_hessian_where_nothing_is_compressed(derivatives, name):
    """Under tension both are the same, so that Newton steps stay quadratic."""
    term, _, _, _, _, hessian, positive = derivatives[name]
    centre = np.asarray(TIP) if name == "grip" else 0.0
    x = jnp.asarray(centre + 1.2 * (MESH.rest - centre))[term.vertices]
    assert error(positive(x), hessian(x)) < ROUNDING


@pytest.mark.parametrize("length", [0.0, 2e-3])
def test_a_particle_at_the_tip_gives_finite_forces_and_a_solvable_newton_step(length):
    """At |x - u| = 0 the direction of the spring is undefined; nothing may become NaN there."""
    grip = Grip(vertices=np.array([[0]]), tip=jnp.zeros(3), length=jnp.array([length]), stiffness=jnp.array([100.0]))
    x = jnp.zeros((1, 1, 3))
    for value in (grip.energy(x), grip.gradient(x), grip.hessian(x), grip.positive_hessian(x)):
        assert np.isfinite(np.asarray(value)).all()
    np.testing.assert_array_equal(grip.gradient(x), 0)


def test_a_slack_spring_that_closed_on_the_particle_itself_pulls_it_back_from_everywhere():
    """With r = 0 the energy is k/2 |x - u|^2, whose Hessian is k I at the tip too."""
    grip = Grip(vertices=np.array([[0]]), tip=jnp.zeros(3), length=jnp.array([0.0]), stiffness=jnp.array([100.0]))
    for x in (jnp.zeros((1, 1, 3)), jnp.array([[[1e-3, -2e-3, 0.0]]])):
        np.testing.assert_allclose(grip.hessian(x)[0, 0, :, 0], 100 * np.eye(3), atol=100 * ROUNDING)
        np.testing.assert_allclose(grip.positive_hessian(x)[0, 0, :, 0], 100 * np.eye(3), atol=100 * ROUNDING)


@pytest.mark.parametrize("name", ["triangles", "edges", "bending", "bending of a rough sheet"])
@pytest.mark.parametrize("seed", range(5))
def test_rigid_motion_stores_no_energy_and_makes_no_force(derivatives, name, seed):
    """U(R x + t) = U(x), and from rest its gradient is zero; against a 1 mm bump of the same sheet."""
    term, energy, _, _, gradient, _, _ = derivatives[name]
    rotation = Rotation.random(rng=np.random.default_rng(seed))
    shift = np.random.default_rng(seed).normal(size=3)
    rest = (ROUGH if "rough" in name else MESH).rest
    bumped = rest + np.column_stack([0 * rest[:, :2], 1e-3 * np.cos(200 * rest[:, 1])])
    scale = float(jnp.sum(energy(jnp.asarray(bumped)[term.vertices])))
    moved = jnp.asarray(rotation.apply(bumped) + shift)
    # Positions near 1 m have 1e-16 m of rounding, edges are 7 mm long: strains of 1e-13 against 1e-2.
    assert float(jnp.sum(energy(moved[term.vertices]))) == pytest.approx(scale, rel=1e-9)
    at_rest = jnp.asarray(rotation.apply(rest) + shift)[term.vertices]
    # The same strains squared, and times K and an edge's length.
    assert float(jnp.sum(energy(at_rest))) < 1e-12 * scale
    assert float(jnp.max(jnp.abs(gradient(at_rest)))) < 1e-8


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.2])
def test_a_triangle_membrane_in_uniaxial_tension_has_the_typed_modulus_and_poissons_ratio(angle):
    """With E2 = -nu E1, St Venant-Kirchhoff stores k E1^2 / 2 per area, its least over E2; E = (stretch^2 - 1) / 2."""
    mesh = jittered(equilateral(5, 5), 0.2)
    term = TriangleMembrane.build(mesh, stiffness=K, poisson=NU)
    axes = Rotation.from_euler("z", angle).as_matrix()

    def density(first: float, second: float) -> float:
        stretch = axes @ np.diag([np.sqrt(1 + 2 * first), np.sqrt(1 + 2 * second), 1]) @ axes.T
        x = jnp.asarray(mesh.rest @ stretch.T)
        return float(jnp.sum(term.energy(x[term.vertices]))) / mesh.face_area.sum()

    strain = 0.04
    assert density(strain, -NU * strain) == pytest.approx(K * strain**2 / 2, rel=ROUNDING)
    # The energy is quadratic in E, so symmetric about its minimum.
    assert density(strain, -NU * strain + 0.01) == pytest.approx(density(strain, -NU * strain - 0.01), rel=ROUNDING)
    assert density(strain, -NU * strain + 0.01) > density(strain, -NU * strain)


def test_axis_1_of_a_membrane_is_the_worlds_x_where_the_sheet_is_not_edge_on_to_it():
    """A stretch along x is E_11 in a level sheet; in one across x, the stretch along y is."""
    for axis, stretch in (("z", [1.2, 1, 1]), ("y", [1, 1.2, 1])):
        mesh = dataclasses.replace(MESH, rest=Rotation.from_euler(axis, 90, degrees=True).apply(MESH.rest))
        term = TriangleMembrane.build(mesh, stiffness=K, poisson=NU)
        strain = term.strain(jnp.asarray(mesh.rest * stretch)[term.vertices])
        np.testing.assert_allclose(strain, np.tile([0.5 * (1.2**2 - 1), 0, 0], (len(mesh.faces), 1)), atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 0.3, 1.2])
def test_edge_springs_on_equilateral_triangles_have_modulus_k_and_poissons_ratio_a_third(angle):
    """Small uniaxial strain e with lateral -e/3 stores k e^2 / 2 per area in any direction, least over the lateral."""
    mesh = equilateral(5, 5)
    term = EdgeMembrane.build(mesh, stiffness=K)
    axes = Rotation.from_euler("z", angle).as_matrix()

    def density(first: float, second: float) -> float:
        x = jnp.asarray(mesh.rest @ (axes @ np.diag([1 + first, 1 + second, 1]) @ axes.T).T)
        return float(jnp.sum(term.energy(x[term.vertices]))) / mesh.face_area.sum()

    e = 1e-5
    # Springs are linear to first order in e; the next order is of relative size e.
    assert density(e, -e / 3) == pytest.approx(K * e**2 / 2, rel=20 * e)
    assert density(e, -e / 3 + 0.1 * e) == pytest.approx(density(e, -e / 3 - 0.1 * e), rel=20 * e)
    assert density(e, -e / 3 + 0.1 * e) > density(e, -e / 3)


@pytest.mark.parametrize(
    ("jitter", "tolerance"),
    [(0.0, ROUNDING), (0.15, JITTER_ERROR)],
    ids=["equilateral", "jittered"],
)
@pytest.mark.parametrize("angle", [0.0, 0.5, np.pi / 2])
def test_a_sheet_bent_to_a_cylinder_stores_half_b_c_squared_per_area(jitter, tolerance, angle):
    """Plate theory: B c^2 / 2. Summed over inner triangles, with half of each of their three hinges."""
    mesh = jittered(equilateral(16, 16, 3e-3), jitter)
    term = IsometricBending.build(mesh, stiffness=PLATE)
    c = 5.0
    along = mesh.rest[:, :2] @ [np.cos(angle), np.sin(angle)]
    x = mesh.rest + np.column_stack([0 * mesh.rest[:, :2], c * along**2 / 2])
    stored = np.asarray(term.energy(jnp.asarray(x)[term.vertices]))
    number = {tuple(hinge[:2]): i for i, hinge in enumerate(mesh.hinges.tolist())}
    total = area = 0.0
    for face, size in zip(mesh.faces.tolist(), mesh.face_area, strict=True):
        hinges = [number.get(tuple(sorted(pair))) for pair in zip(face, face[1:] + face[:1], strict=True)]
        if None not in hinges:
            total += stored[hinges].sum() / 2
            area += size
    assert total / area == pytest.approx(PLATE * c**2 / 2, rel=tolerance)


def test_the_bed_only_pushes():
    bed = terms()["bed"]
    above, below = (jnp.asarray(MESH.rest + np.array([0, 0, z]))[bed.vertices] for z in (3e-4, -1e-4))
    np.testing.assert_array_equal(bed.gradient(above), 0)
    np.testing.assert_allclose(bed.gradient(below)[:, 0, 2], -10.0 * 3e-4, rtol=1e-9)


def test_the_bed_supports_the_sheet_in_its_rest_shape():
    """The same holds for oblique gravity and for particles of different areas."""
    energy = surrogate(MESH, dataclasses.replace(DECLARATION, gravity=(1.0, -2.0, -9.0)))
    np.testing.assert_allclose(energy.internal_gradient(jnp.asarray(MESH.rest)), 0, atol=1e-12)


def test_weight_pulls_with_areal_density_times_area_times_gravity():
    weight = terms()["weight"]
    total = np.asarray(weight.gradient(jnp.asarray(MESH.rest)[weight.vertices])).sum(axis=(0, 1))
    np.testing.assert_allclose(total, -MESH.face_area.sum() * np.array([0.0, 1.0, -9.81]), rtol=1e-12)


def test_the_assembled_derivatives_are_those_of_the_whole_energy():
    """Gradient and block-tridiagonal Hessian of U with boundary springs = autodiff of `value`."""
    energy = surrogate(MESH, DECLARATION)
    b = jnp.asarray(np.random.default_rng(2).uniform(0, 2, MESH.n))
    x = jnp.asarray(states()["lifted"])
    gradient, hessian = eqx.filter_jit(energy.gradient), eqx.filter_jit(energy.hessian)
    np.testing.assert_allclose(gradient(x, b), jax.jit(jax.grad(energy.value))(x, b), rtol=1e-9, atol=1e-12)
    expected = jax.jit(jax.hessian(energy.value))(x, b).reshape(3 * MESH.n, 3 * MESH.n)
    assert error(dense(energy.layout, hessian(x, b)), expected) < ROUNDING
    assert np.linalg.eigvalsh(dense(energy.layout, hessian(x, b, positive=True))).min() > -10 * ROUNDING * K


@pytest.mark.parametrize("membrane", ["triangles", "edges"])
def test_scaling_every_stiffness_and_weight_scales_the_energy(membrane):
    """Gauge: U(x; s b, s k, s rho) = s U(x; b, k, rho), so positions identify ratios only."""
    scale = 7.0
    scaled = dataclasses.replace(
        DECLARATION,
        membrane_stiffness=scale * DECLARATION.membrane_stiffness,
        areal_density=scale * DECLARATION.areal_density,
    )
    b = jnp.full(MESH.n, 0.5)
    x = jnp.asarray(states()["pressed into the bed"])
    soft, stiff = (surrogate(MESH, declared, membrane=membrane) for declared in (DECLARATION, scaled))
    assert float(stiff.value(x, scale * b)) == pytest.approx(scale * float(soft.value(x, b)), rel=1e-12)
