"""The tool's force: the rows of a frame, the factor on the stiffnesses, and what is named in place of being used."""

import re
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.actions import Cut
from jiggle_mj.estimate import Sheet
from jiggle_mj.estimator import EstimatorConfig, summaries
from jiggle_mj.estimator.belief.topology import region_of
from jiggle_mj.estimator.filters.config import FilterConfig
from jiggle_mj.estimator.filters.evidence import Evidence, MeasuredPull
from jiggle_mj.estimator.filters.force_axes import doubt
from jiggle_mj.estimator.filters.force_evidence import ForceEvidence, LogFactor, StackedForces, fitted
from jiggle_mj.estimator.filters.force_fit import StiffnessScale
from jiggle_mj.estimator.filters.implicit import ImplicitFilter
from jiggle_mj.estimator.filters.kept_frames import kept_frames, resumed
from jiggle_mj.estimator.filters.posterior_summary import prior_summary
from jiggle_mj.estimator.filters.tool_force import FRICTION, WEIGHT_ERROR, FrameForce, frame_force
from jiggle_mj.estimator.perception.mesh_field import MeshField
from jiggle_mj.estimator.physics.environment import Weight
from jiggle_mj.estimator.physics.surrogate import surrogate
from jiggle_mj.estimator.tracked_sheet import TrackedSheet
from jiggle_mj.observation import Declaration
from tests.support.small_sheet import (
    DECLARATION,
    NOISE,
    STIFFNESS,
    attached,
    follow,
    lifts,
    observed,
    sheet,
    sheet_balance,
    sheet_energy,
    sheet_prior,
)

K = DECLARATION.membrane_stiffness
FORCE_SD, ROUGH_SD = 1e-4, 1e-1
SENSOR_SD = 1e-3
"""Noise of a component of the force [N]; the lifts pull with up to 0.1 N."""
BALANCED = 1e-6
"""Force that the equilibrium of a lift leaves, summed over the particles [N]."""
SLOPE_ERROR = 1e-2
"""Difference of the derivative of E and a central difference of it, in which the weights change with s as well [1]."""


def pull_of(lift, b: np.ndarray) -> np.ndarray:
    """Return the force of the tool on the tissue in a lift: what the balance of the held particles lacks [N]."""
    internal = np.asarray(eqx.filter_jit(sheet_energy().internal_gradient)(jnp.asarray(lift.x)))
    return (internal + b[:, None] * (lift.x - sheet().rest))[lift.held].sum(axis=0)


def with_force(evidence: Evidence, pull: np.ndarray, sd: float = SENSOR_SD, index: int = 0) -> Evidence:
    """Return the evidence of a frame with a measured force."""
    force = MeasuredPull(
        index=jnp.asarray(index),
        pull=jnp.asarray(pull),
        covariance=jnp.asarray(sd**2 * np.eye(3)),
        offset_sd=jnp.asarray(0.0),
        offset_number=jnp.asarray(0),
    )
    return replace(evidence, force=force)


def exact(lift) -> Evidence:
    """Return the evidence of positions without noise."""
    return replace(observed(lift, 0), y=jnp.asarray(lift.x))


@eqx.filter_jit
def force_at(balance, x, s, evidence) -> FrameForce | None:
    frame = balance.linearise(x, s, evidence)
    return frame_force(balance, frame, balance.fit(frame))


@pytest.mark.parametrize("lift", [3, 7])
def test_attachments_weight_and_bed_take_up_what_the_tool_pulls(lift):
    """E + loads = P at equilibrium; where forces err by more than anchors, E is the attachments' force alone."""
    frame, b = lifts()[lift], STIFFNESS * attached()
    pull, s = pull_of(frame, b), jnp.asarray(b / (b + K))
    seen = with_force(exact(frame), pull)
    found, rough = (force_at(sheet_balance(sd), jnp.asarray(frame.x), s, seen) for sd in (FORCE_SD, ROUGH_SD))
    np.testing.assert_allclose(found.elastic + found.loads, pull, atol=BALANCED)
    springs = (b[:, None] * (frame.x - sheet().rest)).sum(axis=0)
    np.testing.assert_allclose(rough.elastic, springs, atol=1e-3 * np.linalg.norm(springs))


def test_the_errors_of_anchors_positions_friction_and_weight_are_in_the_covariances():
    """Where forces err by far more than anchors, E is sum b d, and errs by that of each position and each anchor. What
    presses on the bed is the weight less what the tool lifts; friction is a share of it, across the vertical."""
    frame, b = lifts()[3], STIFFNESS * attached()
    balance, s = sheet_balance(ROUGH_SD), jnp.asarray(b / (b + K))
    found = force_at(balance, jnp.asarray(frame.x), s, with_force(exact(frame), pull_of(frame, b)))
    expected = float(np.sum(b**2)) * (NOISE**2 + float(balance.anchor_sd) ** 2)
    np.testing.assert_allclose(np.diagonal(found.model_covariance)[:2], expected, rtol=0.01)
    weight = -float(sum(term.force.sum(axis=0)[2] for term in sheet_energy().terms if isinstance(term, Weight)))
    lifted = float(found.loads[2])
    assert 0.1 < lifted / weight < 0.9
    horizontal, vertical = (FRICTION * (weight - lifted)) ** 2, (WEIGHT_ERROR * lifted) ** 2
    of_sensor = np.diagonal(found.load_covariance) - SENSOR_SD**2
    np.testing.assert_allclose(of_sensor, [horizontal, horizontal, vertical], rtol=1e-6)


def test_a_factor_that_varies_with_the_stiffnesses_widens_or_narrows_each():
    """Against 20 000 draws of s and log c together, b = c b_ref s / (1 - s): within four standard errors of an sd."""
    rng, s, factor = np.random.default_rng(0), np.full(sheet().n, 0.1), 1.5
    root = 0.003 * np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [8.0, -8.0, 2.0]])
    whole = root @ root.T
    drawn = rng.normal(size=(20_000, 3)) @ root.T
    cross = np.append(whole[:2, 2], np.zeros(len(s) - 2))
    scale = StiffnessScale(factor=factor, log_sd=float(whole[2, 2] ** 0.5), log_with_s=cross)
    summary = replace(
        prior_summary(sheet_prior(), len(s)), b=jnp.asarray(K * s / (1 - s)), sd=jnp.full(len(s), 0.003 * K / 0.9**2)
    )
    b, sd = summaries.stiffness(summary, scale)
    sample = factor * np.exp(drawn[:, 2:]) * K * (0.1 + drawn[:, :2]) / (0.9 - drawn[:, :2])
    np.testing.assert_allclose(sd[:2], sample.std(axis=0), rtol=4 / np.sqrt(2 * len(sample)))
    np.testing.assert_allclose(b, factor * K / 9)
    z = sample / (sample + factor * K)
    expected = np.cov(z.T) - whole[:2, :2]
    size = np.abs(expected).max()
    np.testing.assert_allclose(scale.added_covariance(s)[:2, :2], expected, atol=0.05 * size)


def test_a_weld_counts_by_the_forces_around_it():
    """At s = 1 the position of a weld says nothing of its force; what the sheet brings to it does."""
    frame = lifts(np.inf)[7]
    s = jnp.asarray(attached().astype(float))
    pull = pull_of(frame, np.zeros(sheet().n))
    found = force_at(sheet_balance(FORCE_SD), jnp.asarray(frame.x), s, with_force(exact(frame), pull))
    sd = np.sqrt(np.diagonal(found.model_covariance))
    assert np.isfinite(found.dE_ds).all() and (sd < 0.1 * np.linalg.norm(pull)).all()
    assert (np.abs(found.elastic + found.loads - pull) < 3 * sd).all()


def test_the_derivative_by_s_is_that_of_the_state_fitted_for_each_s():
    balance = eqx.tree_at(lambda b: b.force_sd, sheet_balance(FORCE_SD), jnp.asarray(FORCE_SD))
    balance = replace(balance, config=FilterConfig(error_weight=1e-9))
    frame, b = lifts()[3], STIFFNESS * attached()
    s, x = b / (b + K), jnp.asarray(frame.x)
    evidence, step = with_force(exact(frame), pull_of(frame, b)), 1e-5
    here = force_at(balance, x, jnp.asarray(s), evidence)
    direction = attached() * np.random.default_rng(0).uniform(0.5, 1.5, sheet().n)
    ahead, behind = (force_at(balance, x, jnp.asarray(s + move * direction), evidence) for move in (step, -step))
    slope = (np.asarray(ahead.elastic) - np.asarray(behind.elastic)) / (2 * step)
    np.testing.assert_allclose(here.dE_ds @ direction, slope, atol=SLOPE_ERROR * np.linalg.norm(slope))


def synthetic(
    factor: float, noise: float, seed: int = 0, n: int = 12, t: int = 30, offset_sd: float = 0.0
) -> tuple[StackedForces, np.ndarray]:
    """Return forces of a linear E(s) with E(0) = 0 and the true s, for a true factor on the declared stiffness.

    The sensor's offset errs anew in each third of the frames.
    """
    rng = np.random.default_rng(seed)
    dE_ds, s = rng.normal(1.0, 0.3, (t, 3, n)), rng.uniform(0.05, 0.15, n)
    loads = rng.normal(size=(t, 3))
    pull = loads + factor * dE_ds @ s + noise * rng.normal(size=(t, 3))
    each, number = np.broadcast_to(noise**2 * np.eye(3), (t, 3, 3)), np.arange(t) // (t // 3)
    pull += offset_sd * rng.normal(size=(3, 3))[number]
    forces = StackedForces(
        dE_ds=dE_ds,
        offset=np.zeros((t, 3)),
        pull=pull,
        loads=loads,
        model_covariance=0 * each,
        load_covariance=each,
        offset_sd=np.full(t, offset_sd),
        offset_number=number,
    )
    return forces, s


@pytest.mark.parametrize(("factor", "shape_sd", "offset_sd"), [(0.2, 0.02, 0.0), (5.0, 0.02, 0.0), (1.5, 0.002, 0.3)])
def test_the_factor_on_a_declared_stiffness_is_found_within_its_error(factor, shape_sd, offset_sd):
    """z of log c over 100 draws of shape and noise has mean square 1, to 0.3: two standard errors of 100 squares.

    Taken for noise of single frames, an offset as large as it gives a mean square of 5.
    """
    scores = []
    for seed in range(100):
        forces, s = synthetic(factor, 0.3, seed, offset_sd=offset_sd)
        precision, rng = np.eye(len(s)) / shape_sd**2, np.random.default_rng(seed + 1000)
        shift = precision @ (s + shape_sd * rng.normal(size=len(s)))
        evidence, _ = fitted(forces, precision, shift, before=LogFactor(sd=2.0))
        covariance = np.linalg.inv(precision + evidence.marginal.precision)
        log_factor, sd, _ = evidence.given(covariance @ (shift + evidence.marginal.shift), covariance)
        scores.append((log_factor - np.log(factor)) / sd)
    assert np.mean(np.square(scores)) == pytest.approx(1, abs=0.3)


def test_with_a_sure_declared_stiffness_the_force_halves_the_error_of_the_sum():
    forces, s = synthetic(1.0, 0.3)
    precision = np.eye(len(s)) / 0.02**2
    marginal = ForceEvidence.of(forces, s, 0.0, before=LogFactor(sd=0.01)).marginal
    before, after = (np.sum(np.linalg.inv(p)) ** 0.5 for p in (precision, precision + marginal.precision))
    assert after < 0.5 * before


PREDICTED = np.array([[0.02, 0.03, 0.1], [-0.04, 0.02, 0.2], [0.03, -0.05, 0.15], [-0.02, -0.03, 0.1]])
LOADS = np.array([0.0, 0.0, 0.03])
SD = np.full(PREDICTED.shape, 5e-3)
ROUGH = np.array([[0.03, 0, 0.05], [0, 0.03, -0.05], [-0.03, 0, 0.05], [0, -0.03, -0.1]])
"""Difference that errors of the model may make [N], where they are as large as the force."""
DEAD_SENSOR = np.random.default_rng(0).normal(size=SD.shape) * SD


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: 1.6 * (f - LOADS) + LOADS, None),
        (lambda f: -f, "with the opposite sign"),
        (lambda f: f[:, [1, 2, 0]] * [-1, 1, 1], r"\(x, y, z\) = \(z, -x, y\)"),
        (lambda f: 1000 * f, "is it in mN"),
        (lambda f: f[::-1] * [1, 1, 0], "whatever its scale and axes"),
        (lambda f: 0 * f + 0.1, "whatever its scale and axes"),
        (lambda f: 0 * f, "is the sensor on"),
        (lambda f: 0 * f - 1e-17, "is the sensor on"),
        (lambda f: DEAD_SENSOR, "is the sensor on"),
    ],
)
def test_a_force_of_another_sign_axes_or_unit_is_named(change, words):
    with np.errstate(all="raise"):
        why = doubt(PREDICTED, change(PREDICTED + LOADS), np.tile(LOADS, (4, 1)), SD, SD)
    if words is None:
        assert why is None
    else:
        assert why is not None
        assert re.search(words, why), why


def test_a_unit_is_named_where_the_model_errs_as_much_as_the_force():
    """The errors of a sheet are in proportion to its force, so that mN called N are far outside of them."""
    measured, sd = PREDICTED + ROUGH, np.full(SD.shape, 0.05)
    assert doubt(PREDICTED, measured, 0 * SD, sd, sd) is None
    why = doubt(PREDICTED, 1000 * measured, 0 * SD, sd, sd)
    assert why is not None and "is it in mN" in why, why


def test_a_dead_sensor_is_named_by_the_weight_that_it_does_not_show():
    """The attachments are hardly known, and the sheet weighs 0.4 N."""
    unsure, weight = np.full(SD.shape, 0.1), np.tile([0.0, 0.0, 0.4], (4, 1))
    why = doubt(PREDICTED, np.zeros_like(SD), weight, unsure, SD)
    assert why is not None and "is the sensor on" in why, why


def test_no_force_is_not_doubted_where_none_is_expected():
    """Nothing holds the sheet, and it weighs nothing."""
    none = np.zeros_like(SD)
    assert doubt(none, none, none, SD, SD) is None


def test_a_force_below_its_noise_is_not_doubted():
    assert doubt(PREDICTED, -PREDICTED, np.zeros((4, 3)), 100 * SD, 100 * SD) is None


def filter_of(stiffness: float) -> ImplicitFilter:
    """Return the filter of the shared sheet, declared with another membrane stiffness."""
    energy = surrogate(sheet(), Declaration(membrane_stiffness=stiffness))
    balance = sheet_balance(FORCE_SD).with_energy(energy)
    balance = eqx.tree_at(lambda b: b.reference, balance, jnp.asarray(stiffness))
    prior = eqx.tree_at(lambda p: p.reference, sheet_prior(), jnp.asarray(stiffness))
    return ImplicitFilter(declared_balance=balance, prior=prior)


def measured() -> list[Evidence]:
    """Return the evidence of all lifts, each with a noisy force."""
    b, rng = STIFFNESS * attached(), np.random.default_rng(3)
    pulls = [pull_of(lift, b) + SENSOR_SD * rng.normal(size=3) for lift in lifts()]
    return [with_force(observed(lift, k), pulls[k], index=k) for k, lift in enumerate(lifts())]


@pytest.mark.parametrize(("sign", "words"), [(1, None), (-1, "opposite sign")])
def test_a_grasp_gives_its_force_to_the_belief_but_not_with_the_wrong_sign(sign, words):
    filter, frames = filter_of(K), slice(0, 4)
    seen = [eqx.tree_at(lambda e: e.force.pull, each, sign * each.force.pull) for each in measured()[frames]]
    state, _, summary = follow(filter, lifts()[frames], seen)
    fit = filter.force(state)
    assert fit is not None and fit.index.tolist() == [0, 1, 2, 3]
    if words is None:
        assert fit.doubt is None and fit.evidence is not None
    else:
        assert fit.evidence is None and fit.scale(summary.belief) is None
        assert fit.doubt is not None and words in fit.doubt


EXACT_FORCE_SD = 1e-5
"""Noise of a sensor by which the factor and the stiffnesses are nearly one unknown [N]."""


@pytest.fixture(scope="module")
def tracked() -> TrackedSheet:
    """Return a sheet after two lifts with nearly exact forces, released."""
    filter, b, first = filter_of(K), STIFFNESS * attached(), lifts()[:8]
    seen = [with_force(observed(lift, k), pull_of(lift, b), EXACT_FORCE_SD, k) for k, lift in enumerate(first)]
    state, *_ = follow(filter, first, seen)
    rest, field = sheet().rest, MeshField(sheet().rest[:, :2], sheet().faces)
    parts = Sheet(rest=rest, faces=sheet().faces)
    return TrackedSheet(
        sheet=parts,
        filter=filter,
        field=field,
        grip_sd=EstimatorConfig().grip_sd,
        prior_entropy=0.0,
        state=state,
        x=rest,
        open_x=rest,
        corrected=None,
    )


def test_between_releases_the_factor_is_that_of_the_present_belief(tracked):
    """Frames without a force narrow the stiffnesses, and with them the factor: the covariance stays one."""
    state, frames = tracked.state, lifts()[8:12]
    for k, lift in enumerate(frames, start=8):
        state, _ = tracked.filter.update(state, observed(lift, k), jnp.asarray(observed(lift, k).y))
    later = replace(tracked, state=state)
    assert later.stiffness_scale is not None
    assert np.linalg.eigvalsh(summaries.belief(state.summary, later.stiffness_scale).covariance).min() > 0


def test_a_cut_leaves_the_factor_as_it_was_known(tracked):
    """The tool pulled at the attachments of before, so that fewer of them make the sheet no stiffer."""
    cut = Cut(path=np.array([[-0.02, 0.006], [0.02, 0.006]]), width=0.016)
    region = region_of(cut, sheet().rest)
    assert (region & attached()).sum() > attached().sum() / 2
    state = tracked.filter.change(tracked.state, cut, region=region, index=8)
    before, after = tracked.stiffness_scale, replace(tracked, state=state).stiffness_scale
    assert before is not None and after is not None
    assert (after.factor, after.log_sd) == pytest.approx((before.factor, before.log_sd))
    assert not after.log_with_s.any()


@pytest.mark.slow
def test_frames_are_kept_with_their_forces():
    """The noise of a force need not be known."""
    filter, frames = filter_of(K), slice(0, 2)
    unknown = eqx.tree_at(lambda e: e.force.covariance, measured()[1], jnp.full((3, 3), jnp.nan))
    state, *_ = follow(filter, lifts()[frames], [measured()[0], unknown])
    kept = kept_frames(state)
    assert kept is not None and kept.force_index.tolist() == [0, 1]
    again = resumed(filter, state.key, kept, np.asarray(state.summary.b))
    found = [frame.evidence.force for grasp in again.grasps for frame in grasp.frames]
    for force, given in zip(found, (measured()[0].force, unknown.force), strict=True):
        assert force is not None and given is not None
        for name in ("pull", "covariance", "offset_sd", "offset_number"):
            np.testing.assert_array_equal(getattr(force, name), getattr(given, name))


@pytest.mark.slow
def test_stiffnesses_are_absolute_with_a_wrong_declared_stiffness():
    """Declared with half of its stiffness, the sheet is found twice as stiff, and the sum of b is right."""
    filter, b = filter_of(K / 2), STIFFNESS * attached()
    state, _, summary = follow(filter, lifts(), measured())
    fit = filter.force(state)
    assert fit is not None and fit.doubt is None
    scale = fit.scale(summary.belief)
    assert scale is not None
    assert abs(np.log(scale.factor / 2)) < 3 * scale.log_sd
    assert scale.factor * float(jnp.sum(summary.b)) == pytest.approx(b.sum(), rel=3 * scale.log_sd)
