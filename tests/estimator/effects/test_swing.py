"""A sheet that hangs: the period of its swing is the lowest mode's, and it follows its grip as an oscillator does."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import eigh

from jiggle_mj.estimator.attribution.closing import close_the_loop
from jiggle_mj.estimator.attribution.dataset import collect_dataset
from jiggle_mj.estimator.attribution.discrepancy import discrepancy
from jiggle_mj.estimator.blas import one_thread
from jiggle_mj.estimator.effects import LIBRARY
from jiggle_mj.estimator.effects.sheet_model import nominal_energy
from jiggle_mj.estimator.effects.swing import BESSEL
from jiggle_mj.estimator.effects.terms import DeadLoad
from jiggle_mj.estimator.physics.environment import Weight
from jiggle_mj.estimator.physics.mesh import SheetMesh
from jiggle_mj.eval.report.discrepancy_page import story
from tests.support.hanging_sheet import REPORT, SHEET, HangingSheet, recording, smooth
from tests.support.small_sheet import DECLARATION, at_rest, equilateral

SWING, LATE = (next(one for one in LIBRARY if one.name == name) for name in ("swing", "image_latency"))
G = -DECLARATION.gravity[2]
AIR = dataclasses.replace(DECLARATION, bed=False)
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
        model, moment = at_rest(hung, AIR, at=at, times=REPORTS, ways=WAYS)
        then = LATE.acts(model, jnp.asarray([late]), moment)
        force = SWING.acts(then, jnp.asarray(theta), moment).term(DeadLoad).force
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
    limp = dataclasses.replace(AIR, membrane_stiffness=300.0, thickness=1e-4, poisson=0.0)
    with jax.enable_x64(True):
        energy = nominal_energy(hung, limp)
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


def test_it_swings_by_that_period_in_the_reference_too():
    """By the zeros of the free edge's way, once it has been swung."""
    sheet = HangingSheet()
    positions, tips = sheet.swung(lambda t: np.array([0.0, 0.0, 0.02 * smooth(t / 0.2)]), 2.5)
    low, length = positions[0, :, 1].argmin(), np.ptp(positions[0, :, 1])
    way = (positions[:, low, 2] - tips[:, 2])[round(0.4 / REPORT) :]
    k = np.flatnonzero(np.diff(np.sign(way)))
    zeros = k + way[k] / (way[k] - way[k + 1])
    period = 2 * np.diff(zeros).mean() * REPORT
    assert len(zeros) > 5
    np.testing.assert_allclose(period, 2 * np.pi / np.sqrt((BESSEL / 2) ** 2 * G / length), rtol=0.03)


@pytest.mark.slow
def test_what_swings_in_the_reference_is_named_first_by_its_own_mass_and_foretold():
    """Beside it `material_damping` may be named: what swings there has more than one mode, and is damped."""
    dataset = collect_dataset(SHEET, None, recording(4, seed=0))
    with jax.enable_x64(True), one_thread():
        found = discrepancy(close_the_loop(dataset), dataset)
    names = [one["name"] for one in found["effects"]]
    assert names[0] == "swing", story(found)
    assert {*names} <= {"swing", "material_damping"}, story(found)
    assert found["verdict"] == "effect"
    assert found["effects"][0]["theta"][0] == pytest.approx(1.0, abs=0.05)
    assert found["held_out"]["after_rms_m"] < 0.4 * found["held_out"]["before_rms_m"]
