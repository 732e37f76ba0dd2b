"""Swing of a hanging sheet: its period is that of the lowest mode, and it follows its grip as an oscillator does."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import eigh

from jiggle_mj.estimator.attribution.close_loop import close_the_loop
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

SWING, LATE = (next(effect for effect in LIBRARY if effect.name == name) for name in ("swing", "image_latency"))
G = -DECLARATION.gravity[2]
AIR = dataclasses.replace(DECLARATION, bed=False)
CHAIN_ERROR = 0.05
"""Error of the chain's squared frequency for a sheet."""
PERIOD_ERROR = 0.03
"""Error of the chain's period for the reference's sheet."""
MASS_ERROR = 0.05
"""Error of the fitted share of the mass: the reference has more than one mode, and is damped."""
REPORTS = np.array([0.0, 0.05, 0.11, 0.11, 0.2, 0.24, 0.4, 0.5])
DISPLACEMENTS = np.random.default_rng(3).normal(scale=0.01, size=(8, 3))
DISPLACEMENTS[3] = DISPLACEMENTS[2]  # as when an observation comes at the time of a report


@pytest.fixture(scope="module")
def hung():
    """Return a sheet in the plane of x and z."""
    flat = equilateral(9, 11)
    return SheetMesh(flat.rest[:, [0, 2, 1]], flat.faces)


def pull(hung: SheetMesh, at: float, theta: list[float], late: float = 0.0) -> np.ndarray:
    """Return the force of the swing by mass [m/s^2]."""
    with jax.enable_x64(True):
        model, context = at_rest(hung, AIR, at=at, times=REPORTS, ways=DISPLACEMENTS)
        delayed = LATE.acts(model, jnp.asarray([late]), context)
        force = SWING.acts(delayed, jnp.asarray(theta), context).term(DeadLoad).force
        per_mass = np.asarray(force / model.term(Weight).mass[:, None])
        np.testing.assert_allclose(per_mass, np.broadcast_to(per_mass[0], per_mass.shape), atol=1e-12)
        return per_mass[0]


def oscillator(square: float, theta: list[float], at: float) -> np.ndarray:
    """Return the same by Runge and Kutta, from impulse to impulse."""
    times, first = np.unique(REPORTS, return_index=True)
    displacements = DISPLACEMENTS[first]
    velocity = np.vstack([np.zeros(3), np.diff(displacements, axis=0) / np.diff(times)[:, None], np.zeros(3)])
    state = np.zeros(6)
    for k, begins in enumerate(times):
        if begins >= at:
            break
        state[3:] -= velocity[k + 1] - velocity[k]
        ends = min(at, times[k + 1] if k + 1 < len(times) else np.inf)

        def derivative(_, y):
            return np.concatenate([y[3:], -2 * theta[1] * y[3:] - square / theta[0] * y[:3]])

        state = solve_ivp(derivative, (begins, ends), state, rtol=1e-9, atol=1e-12).y[:, -1]
    return square * state[:3] * [1, 1, 0]


@pytest.mark.parametrize("theta", [[1.0, 2.0], [1.6, 0.0], [0.3, 60.0]])
@pytest.mark.parametrize("at", [0.03, 0.22, 0.9])
def test_it_follows_its_grip_as_the_oscillator_does(hung, theta, at):
    """To the tolerance of the numerical solution, over several impulses."""
    square = (BESSEL / 2) ** 2 * G / np.ptp(hung.rest[:, 2])
    np.testing.assert_allclose(pull(hung, at, theta), oscillator(square, theta, at), rtol=1e-5, atol=1e-7)


def test_a_late_image_shows_it_as_it_was(hung):
    np.testing.assert_allclose(pull(hung, 0.6, [1.2, 1.0], late=0.2), pull(hung, 0.4, [1.2, 1.0]), atol=1e-12)


def test_without_mass_nothing_swings(hung):
    assert not pull(hung, 0.3, [0.0, 1.0]).any()


def test_its_period_is_that_of_the_lowest_mode_of_a_sheet_that_hangs(hung):
    """By the eigenvalues of the sheet's own stiffness and mass at its equilibrium under gravity.

    To 5 % of the square: a chain has neither width nor bending stiffness.
    """
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
    np.testing.assert_allclose(lowest, square, rtol=CHAIN_ERROR)


def test_it_swings_by_that_period_in_the_reference_too():
    """By the zeros of the free edge's displacement after the grip has moved. To 3 %: a chain has no stretch."""
    sheet = HangingSheet()
    positions, tips = sheet.swung(lambda t: np.array([0.0, 0.0, 0.02 * smooth(t / 0.2)]), 2.5)
    low, length = positions[0, :, 1].argmin(), np.ptp(positions[0, :, 1])
    deflection = (positions[:, low, 2] - tips[:, 2])[round(0.4 / REPORT) :]
    k = np.flatnonzero(np.diff(np.sign(deflection)))
    zeros = k + deflection[k] / (deflection[k] - deflection[k + 1])
    period = 2 * np.diff(zeros).mean() * REPORT
    assert len(zeros) > 5
    np.testing.assert_allclose(period, 2 * np.pi / np.sqrt((BESSEL / 2) ** 2 * G / length), rtol=PERIOD_ERROR)


@pytest.mark.slow
def test_a_swing_in_the_reference_is_named_first_with_its_own_mass_and_improves_held_out_predictions():
    """`material_damping` may be named beside it: the reference has more than one mode, and is damped."""
    dataset = collect_dataset(SHEET, None, recording(4, seed=0))
    with jax.enable_x64(True), one_thread():
        found = discrepancy(close_the_loop(dataset), dataset)
    names = [effect["name"] for effect in found["effects"]]
    assert names[0] == "swing", story(found)
    assert {*names} <= {"swing", "material_damping"}, story(found)
    assert found["verdict"] == "effect"
    assert found["effects"][0]["theta"][0] == pytest.approx(1.0, abs=MASS_ERROR)
    assert found["held_out"]["after_rms_m"] < 0.4 * found["held_out"]["before_rms_m"]
