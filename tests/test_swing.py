"""A sheet that hangs: the period of its swing is the lowest mode's, and it follows its grip as an oscillator does."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jiggle_mj.estimator.effects import LIBRARY
from jiggle_mj.estimator.effects.sheet_model import Moment, SheetModel, centred, undisturbed
from jiggle_mj.estimator.effects.swing import BESSEL
from jiggle_mj.estimator.effects.terms import Load
from jiggle_mj.estimator.environment import Weight
from jiggle_mj.estimator.mesh import SheetMesh
from jiggle_mj.estimator.surrogate import surrogate
from scipy.integrate import solve_ivp
from scipy.linalg import eigh
from small_sheet import DECLARATION, equilateral

SWING, LATE = (next(one for one in LIBRARY if one.name == name) for name in ("swing", "image_latency"))
G = -DECLARATION.gravity[2]
REPORTS = np.array([0.0, 0.05, 0.11, 0.11, 0.2, 0.24, 0.4, 0.5])
WAYS = np.random.default_rng(3).normal(scale=0.01, size=(8, 3))
WAYS[3] = WAYS[2]  # as when the tool is told at a report's own time


@pytest.fixture(scope="module")
def hung():
    """A sheet in the plane of x and z."""
    flat = equilateral(9, 11)
    return SheetMesh(flat.rest[:, [0, 2, 1]], flat.faces)


def pull(hung: SheetMesh, at: float, theta: list[float], late: float = 0.0) -> np.ndarray:
    """Force by mass [m/s^2]."""
    with jax.enable_x64(True):
        rest = jnp.asarray(hung.rest)
        model = SheetModel(
            energy=undisturbed(hung, dataclasses.replace(DECLARATION, bed=False)),
            tool=jnp.zeros(3),
            view=centred(hung.rest),
            time=jnp.asarray(at),
        )
        moment = Moment(
            rest=rest,
            time=jnp.asarray(at),
            gap=jnp.asarray(0.1),
            earlier_gap=jnp.asarray(0.1),
            closed=jnp.asarray(at),
            now=rest,
            before=rest,
            earlier=rest,
            report_times=jnp.asarray(REPORTS),
            reports=jnp.asarray(WAYS),
            past=rest[None],
            began=jnp.zeros(1),
            ended=jnp.zeros(1),
        )
        then = LATE.acts(model, jnp.asarray([late]), moment)
        force = SWING.acts(then, jnp.asarray(theta), moment).term(Load).force
        per_mass = np.asarray(force / model.term(Weight).mass[:, None])
        np.testing.assert_allclose(per_mass, np.broadcast_to(per_mass[0], per_mass.shape), atol=1e-12)
        return per_mass[0]


def oscillator(square: float, theta: list[float], at: float) -> np.ndarray:
    """The same by Runge and Kutta, from kick to kick."""
    times, first = np.unique(REPORTS, return_index=True)
    ways = WAYS[first]
    speed = np.vstack([np.zeros(3), np.diff(ways, axis=0) / np.diff(times)[:, None], np.zeros(3)])
    state = np.zeros(6)
    for k, begins in enumerate(times):
        if begins >= at:
            break
        state[3:] -= speed[k + 1] - speed[k]
        ends = min(at, times[k + 1] if k + 1 < len(times) else np.inf)

        def moves(_, y):
            return np.concatenate([y[3:], -2 * theta[1] * y[3:] - square / theta[0] * y[:3]])

        state = solve_ivp(moves, (begins, ends), state, rtol=1e-9, atol=1e-12).y[:, -1]
    return square * state[:3] * [1, 1, 0]


@pytest.mark.parametrize("theta", [[1.0, 2.0], [1.6, 0.0], [0.3, 60.0]])
@pytest.mark.parametrize("at", [0.03, 0.22, 0.9])
def test_it_follows_its_grip_as_the_oscillator_does(hung, theta, at):
    square = (BESSEL / 2) ** 2 * G / np.ptp(hung.rest[:, 2])
    np.testing.assert_allclose(pull(hung, at, theta), oscillator(square, theta, at), rtol=1e-5, atol=1e-7)


def test_a_late_image_shows_it_as_it_was(hung):
    np.testing.assert_allclose(pull(hung, 0.6, [1.2, 1.0], late=0.2), pull(hung, 0.4, [1.2, 1.0]), atol=1e-12)


def test_what_has_no_mass_to_show_does_not_swing(hung):
    assert not pull(hung, 0.3, [0.0, 1.0]).any()


def test_its_period_is_that_of_the_lowest_mode_of_a_sheet_that_hangs(hung):
    """By the eigenvalues of the sheet's own stiffness and mass, about where its weight takes it."""
    limp = dataclasses.replace(DECLARATION, bed=False, membrane_stiffness=300.0, thickness=1e-4, poisson=0.0)
    with jax.enable_x64(True):
        energy = undisturbed(hung, limp)
        mass = next(np.repeat(np.asarray(term.mass), 3) for term in energy.terms if isinstance(term, Weight))
        free = np.repeat(hung.rest[:, 2] < hung.rest[:, 2].max() - 1e-6, 3)
        force = jax.jit(lambda x: energy.internal_gradient(x.reshape(-1, 3)).ravel())
        stiffness, x = jax.jit(jax.jacfwd(force)), hung.rest.ravel().copy()
        for _ in range(30):
            H = np.asarray(stiffness(jnp.asarray(x)))[np.ix_(free, free)]
            x[free] -= np.linalg.solve(H + 1e-3 * np.eye(len(H)), np.asarray(force(jnp.asarray(x)))[free])
        H = np.asarray(stiffness(jnp.asarray(x)))[np.ix_(free, free)]
        assert np.abs(np.asarray(force(jnp.asarray(x)))[free]).max() < 1e-8
    lowest = eigh(H, np.diag(mass[free]), eigvals_only=True, subset_by_index=[0, 0])[0]
    square = (BESSEL / 2) ** 2 * G / np.ptp(hung.rest[:, 2])
    np.testing.assert_allclose(lowest, square, rtol=0.05)


def test_a_sheet_that_hangs_leaning_is_pulled_within_its_plane_and_one_that_is_held_up_is_not():
    flat = equilateral(4, 5)
    for lean, taken in ((np.radians(5), True), (np.radians(-8), True), (np.radians(30), False)):
        turned = np.array([[1, 0, 0], [0, np.cos(lean), -np.sin(lean)], [0, np.sin(lean), np.cos(lean)]])
        mesh = SheetMesh(flat.rest[:, [0, 2, 1]] @ turned.T, flat.faces)
        terms = surrogate(mesh, dataclasses.replace(DECLARATION, bed=False)).terms
        pulled = next(np.asarray(term.gravity) for term in terms if isinstance(term, Weight))
        np.testing.assert_allclose(pulled, turned @ [0, 0, -G] if taken else [0, 0, -G], atol=1e-12)
