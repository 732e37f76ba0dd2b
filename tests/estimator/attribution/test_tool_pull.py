"""The force of the tool as a residual: its derivatives, its offset, and the scale of all forces that it shows."""

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator.attribution.dataset import OPEN_ALONE, Dataset, collect_dataset
from jiggle_mj.estimator.attribution.every_frame import linearised, residual, weighed
from jiggle_mj.estimator.attribution.gauss_newton import start
from jiggle_mj.estimator.attribution.grasped_frames import ClosedFrame, FramePull
from jiggle_mj.estimator.attribution.noise_scales import NoiseScales
from jiggle_mj.estimator.attribution.problem import Point, Problem
from jiggle_mj.estimator.attribution.tool_pull import MODEL_SHARE, frame_pulls, predicted_pull, pull_products
from jiggle_mj.estimator.blas import one_thread
from jiggle_mj.estimator.effects import LIBRARY
from jiggle_mj.estimator.filters.evidence import MeasuredPull
from jiggle_mj.eval.report.discrepancy_page import story
from tests.support.lifted_recording import OFFSET, closed_over, observed, with_forces
from tests.support.small_fit import small_problem
from tests.support.small_sheet import DECLARATION, attached

STEP = 1e-3
"""Step of a central difference [prior standard deviations, or 1 for s]."""
SLOPE_ERROR = 1e-3
"""Largest difference of a derivative and a central difference [largest of the derivatives]."""
FRAMES = (3, 7)
"""Frames that are compared."""
ROUNDING = 1e-9
"""Relative rounding of a residual that is computed in two ways."""
AT_EACH_STATE = (
    "gravity",
    "stretch",
    "bending",
    "poisson",
    "pre_strain",
    "anchor_shift",
    "tethering",
    "camera_bias",
    "force_scale",
)
"""Effects whose derivatives are compared."""
TIGHT = 1e-8
"""Variance of force errors with which equilibria are found [assumed one]: their tolerance goes with its root."""


@pytest.fixture(scope="module")
def forced() -> Problem:
    """Return the problem of the lifts with a measured force."""
    library = tuple(effect for effect in LIBRARY if effect.name in AT_EACH_STATE)
    return Problem.build(collect_dataset(DECLARATION, None, with_forces(observed(1.0), 1.0)), library)


@dataclass(frozen=True)
class Predicted:
    """Forces of the tool in some frames, in units of their sd, at an equilibrium."""

    point: Point
    pulls: np.ndarray


def predicted(problem: Problem, theta: np.ndarray, s: np.ndarray, states: np.ndarray) -> Predicted:
    """Return the forces at the equilibria of the compared frames, searched from some states."""
    point, found = start(problem, theta, s, states, list(FRAMES)), []
    for k in FRAMES:
        frame, context = problem.history.frames[k].frame, problem.history.context(k, point.states)
        model, x = problem.sheet.model(jnp.asarray(theta), context, frame.displacement), jnp.asarray(point.states[k])
        found.append(
            np.asarray(frame.pull.weight * predicted_pull(problem.sheet.balance, model, frame, jnp.asarray(s), x))
        )
    return Predicted(point, np.array(found))


@pytest.fixture(scope="module")
def unforced() -> Dataset:
    """Return the dataset of the lifts without a force."""
    return collect_dataset(DECLARATION, None, observed(1.0))


def test_the_derivatives_are_those_of_the_predicted_equilibrium(forced):
    """Against central differences of predictions, by s of particles and by the parameters of effects."""
    problem, n = forced.with_scales(NoiseScales(force=TIGHT, pull=1.0)), len(attached())
    s, theta = np.where(attached(), 0.1, 0.0), np.zeros(problem.sheet.size)
    held = np.flatnonzero(np.asarray(problem.history.frames[FRAMES[0]].frame.held))
    directions = [np.eye(n)[i] for i in (*np.flatnonzero(attached())[::6], held[0])]
    with jax.enable_x64(True), one_thread():
        states = np.array([one.state for one in problem.history.frames])
        here = predicted(problem, theta, s, states)
        weights = weighed(problem, here.point, list(FRAMES))
        every = residual(problem, weights, here.point)
        equations = linearised(problem, here.point, weights, every, np.eye(problem.sheet.size))
        rows = np.array([np.asarray(equations[k].pull) for k in FRAMES])
        np.testing.assert_allclose(rows[:, :, -1], [np.asarray(every[k].own.pull) for k in FRAMES], rtol=ROUNDING)
        for direction in directions:
            up, down = (predicted(problem, theta, s + sign * STEP * direction, here.point.states) for sign in (1, -1))
            _compare(rows[:, :, :n] @ direction, (up.pulls - down.pulls) / (2 * STEP))
        for effect in problem.sheet.library:
            direction = np.zeros(problem.sheet.size)
            direction[problem.sheet.place(effect.name)] = np.ravel(effect.prior_sds)
            up, down = (predicted(problem, theta + sign * STEP * direction, s, here.point.states) for sign in (1, -1))
            _compare(rows[:, :, n : n + len(theta)] @ direction, (up.pulls - down.pulls) / (2 * STEP), effect.name)


def _compare(derivative: np.ndarray, difference: np.ndarray, name: str = "s") -> None:
    np.testing.assert_allclose(
        derivative, difference, rtol=0, atol=SLOPE_ERROR * np.abs(difference).max(), err_msg=name
    )


def test_the_offset_of_the_sensor_is_common_to_the_frames_after_it():
    """The rows' products under noise with a shared offset, against the inverse of that covariance."""
    rng, number, weight, offset = np.random.default_rng(0), np.array([1, 1, 2, 2, 2]), 300.0, 4e-3
    rows = rng.normal(size=(5, 3, 4))
    frames = [pulled(np.zeros(3), weight=weight, offset_sd=offset, offset_number=int(which)) for which in number]
    shared = (weight * offset) ** 2 * (number[:, None] == number)
    inverse = np.linalg.inv(np.eye(5) + shared)
    expected = np.einsum("tia,tu,uib->ab", rows, inverse, rows)
    np.testing.assert_allclose(pull_products(rows, frames), expected, rtol=ROUNDING, atol=ROUNDING)


def test_a_frame_without_a_force_has_no_weight_among_others():
    known = MeasuredPull(
        index=jnp.asarray(1),
        pull=jnp.array([0.0, 0.0, 0.1]),
        covariance=jnp.asarray(1e-6 * np.eye(3)),
        offset_sd=jnp.asarray(0.0),
        offset_number=jnp.asarray(1),
    )
    unknown = eqx.tree_at(lambda one: one.covariance, known, jnp.full((3, 3), jnp.nan))
    first, second, third = frame_pulls([None, known, unknown])
    assert first is not None and second is not None and third is not None
    assert float(first.weight) == float(third.weight) == 0
    assert float(second.weight) == pytest.approx((1e-6 + (MODEL_SHARE * 0.1) ** 2) ** -0.5)
    assert frame_pulls([None, unknown]) == [None, None]


@pytest.mark.slow
def test_stiffnesses_twice_as_large_as_declared_are_found_by_the_force():
    """Twice the stiffness and the weight of everything moves nothing, and doubles the force."""
    closed, found, _ = closed_over(with_forces(observed(1.0, repeats=2), 2.0))
    assert [one["name"] for one in found["effects"]] == ["force_scale"], story(found)
    (one,), force = found["effects"], found["force"]
    assert one["theta"][0] == pytest.approx(np.log(2), abs=2 * one["sd"][0])
    assert one["sd"][0] < 0.1 and force["stiffness_factor_log_sd"] < 0.05
    assert force["membrane_stiffness_n_per_m"] == pytest.approx(
        2 * DECLARATION.membrane_stiffness, rel=2 * one["sd"][0]
    )
    errors = force["held_out_rms_n"]
    assert errors["after"] < 0.5 * errors["before"] < 0.5 * errors["measured"]
    assert np.sum(closed.final.fitted.attached != attached()) <= 2
    assert any(line.startswith("Stiffnesses are absolute") for line in story(found))


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        (lambda force, closed: None if closed else force, OPEN_ALONE),
        (lambda force, closed: replace(force, on_tool=-force.on_tool), "with the opposite sign"),
        (
            lambda force, closed: replace(force, on_tool=1e3 * force.on_tool, sd=1e3 * force.sd),
            "forces are in N (is it",
        ),
        (
            lambda force, closed: replace(force, on_tool=force.on_tool - OFFSET, sd=None) if closed else None,
            "the noise of the force is not known",
        ),
    ],
)
def test_a_force_that_cannot_be_used_is_named_and_in_no_frame(changed, why, unforced):
    forced = [replace(one, force=changed(one.force, one.tool.closed)) for one in with_forces(observed(1.0), 1.0)]
    library = tuple(effect for effect in LIBRARY if effect.name in AT_EACH_STATE)
    given = collect_dataset(DECLARATION, None, forced)
    assert why in given.force_doubt and unforced.force_doubt is None
    left, right = (jax.tree.leaves(one.frames[-1].frame) for one in (given, unforced))
    for a, b in zip(left, right, strict=True):
        np.testing.assert_array_equal(a, b)
    problem = Problem.build(given, library)
    assert problem.scales.pull is None and "force_scale" not in [effect.name for effect in problem.sheet.library]


def pulled(force: np.ndarray, *, weight: float, offset_sd: float, offset_number: int) -> ClosedFrame:
    """Return a frame with a measured force."""
    pull = FramePull(
        force=jnp.asarray(force),
        weight=jnp.asarray(weight),
        offset_sd=jnp.asarray(offset_sd),
        offset_number=jnp.asarray(offset_number),
    )
    return replace(small_problem().history.frames[0].frame, pull=pull)
