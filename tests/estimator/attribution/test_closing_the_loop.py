"""Closing the loop over lifts by our own engine: what is missing is named, and nothing where nothing is."""

import dataclasses
import json
from functools import cache
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimate import Sheet
from jiggle_mj.estimator import Estimator
from jiggle_mj.estimator.attribution import fit as fitting
from jiggle_mj.estimator.attribution import sheet as predicting
from jiggle_mj.estimator.attribution import unexplained_residual as leaving
from jiggle_mj.estimator.attribution.baselines import in_proportion, unmoved
from jiggle_mj.estimator.attribution.closing import close_the_loop
from jiggle_mj.estimator.attribution.dataset import assumed, collect_dataset
from jiggle_mj.estimator.attribution.discrepancy import discrepancy, suggested
from jiggle_mj.estimator.attribution.fit import doubted, fit, moved
from jiggle_mj.estimator.attribution.hypotheses import jackknife_sd
from jiggle_mj.estimator.attribution.linear import NormalEquations
from jiggle_mj.estimator.attribution.problem import Point, Problem
from jiggle_mj.estimator.attribution.scores import bayes_factor, occam
from jiggle_mj.estimator.attribution.sheet import closed_on, held_way, predict_all
from jiggle_mj.estimator.attribution.still_noise import MODES, STEP, StillNoise, measure
from jiggle_mj.estimator.attribution.suggestion import suggest, told_apart
from jiggle_mj.estimator.attribution.users_effects import check_effects
from jiggle_mj.estimator.blas import one_thread
from jiggle_mj.estimator.effects import LIBRARY, Effect
from jiggle_mj.estimator.filters.evidence import Evidence
from jiggle_mj.estimator.physics.environment import Weight
from jiggle_mj.eval.report.discrepancy_page import story, write_page
from jiggle_mj.eval.runs import closing_the_loop as keeping
from jiggle_mj.observation import DeclaredMesh, MeasuredPoints, Observation, ToolState
from tests.support.small_sheet import (
    DECLARATION,
    GRIP_RADIUS,
    STIFFNESS,
    attached,
    lifts,
    sheet,
    sheet_balance,
    sheet_energy,
)

NOISE = 1e-4
STILL = 10
SMALL = tuple(
    effect for effect in LIBRARY if effect.name in ("gravity", "stretch", "bending", "friction", "tool_scale", "bed")
)


@cache
def lifted(gravity: float) -> tuple[np.ndarray, ...]:
    """States of the shared lifts under a share of the declared gravity, what is held following the tip rigidly."""
    kinds = [type(term) for term in sheet_energy().terms]
    energy = eqx.tree_at(
        lambda e: e.terms[kinds.index(Weight)].gravity, sheet_energy(), replace_fn=lambda g: gravity * g
    )
    balance, k = sheet_balance(1e-4).of(energy), DECLARATION.membrane_stiffness
    s, states = jnp.asarray(attached() * STIFFNESS / (STIFFNESS + k)), []
    first = {lift.grasp: lift.tip for lift in lifts()[::-1]}
    predict = eqx.filter_jit(balance.predict)
    for lift, before in zip(lifts(), (None, *lifts()), strict=False):
        start = sheet().rest if before is None or before.grasp != lift.grasp else states[-1]
        held, to = jnp.asarray(lift.held), sheet().rest + lift.tip - first[lift.grasp]
        precision = jnp.broadcast_to(1e6 * jnp.eye(3)[None], (len(s), 3, 3))
        evidence = Evidence(y=jnp.asarray(to), precision=precision, held=held, force_unknown=held)
        states.append(np.asarray(predict(jnp.asarray(np.where(lift.held[:, None], to, start)), s, evidence)))
    return tuple(states)


def seen(gravity: float, *, tool_scale: float = 1.0) -> list[Observation]:
    """Still frames, then the lifts: tracked points with noise, and the tool as it says."""
    frames = [(sheet().rest, np.array([0.0, 0.0, 0.05]), 0)] * STILL
    frames += [(x, lift.tip, lift.grasp) for x, lift in zip(lifted(gravity), lifts(), strict=True)]
    first = {grasp: tip for _, tip, grasp in frames[::-1]}
    return [
        Observation(
            index=k,
            time=k * 250_000_000,
            tool=ToolState(
                position=first[grasp] + (tip - first[grasp]) / tool_scale,
                quat_wxyz=np.array([1.0, 0, 0, 0]),
                closed=grasp > 0,
                grasp=grasp,
                radius=GRIP_RADIUS,
            ),
            points=MeasuredPoints(
                positions=x + NOISE * np.random.default_rng(k).normal(size=x.shape),
                track_id=np.arange(len(x)),
                sd=NOISE,
            ),
        )
        for k, (x, tip, grasp) in enumerate(frames)
    ]


def closed_over(observations: list[Observation]):
    dataset = collect_dataset(DECLARATION, None, observations)
    with jax.enable_x64(True), one_thread():
        closed = close_the_loop(dataset, library=SMALL)
        return closed, discrepancy(closed, dataset), dataset


@pytest.fixture(scope="module")
def light():
    """Gravity is a fifth of what is declared, which changes the lifted shape by more than the noise."""
    return closed_over(seen(0.2))


def test_an_undeclared_gravity_is_named_with_what_positions_cannot_tell_it_from(light):
    """A fifth of the weight and five times the stretching stiffness look alike but for bending."""
    closed, found, _ = light
    assert {found["effects"][0]["name"], *found["ambiguous_with"]} == {"gravity", "stretch"}, story(found)
    assert found["verdict"] == "ambiguous"
    hypotheses = [*closed.accepted, *closed.rivals[0]]
    gravity = next(one for one in hypotheses if one.effect.name == "gravity")
    assert gravity.theta[2] == pytest.approx(0.8, abs=0.05)
    assert closed.reported is not None
    before, after = (one.rms for one in closed.reported)
    assert after < 0.7 * before
    assert after < 3**0.5 * 2 * NOISE


def test_a_fit_finds_the_same_size_from_nothing_and_from_the_truth(light):
    closed, _, dataset = light
    problem, before = closed.problem, closed.stages[0].fitted
    at, parts = problem.sheet.place("gravity"), {one.part for one in dataset.frames}
    with jax.enable_x64(True), one_thread():
        begun = [moved(problem, before, at, np.array([0.0, 0.0, size])) for size in (0.0, 0.8)]
        nothing, truth = (fit(problem, at, point, parts) for point in begun)
    assert nothing.point.theta[at] == pytest.approx(truth.point.theta[at], abs=0.03)


def test_a_fit_ends_where_its_parameters_fit_best(light):
    """To half a standard deviation, where all is weighed anew."""
    problem, ended = light[0].problem, light[0].stages[-1].fitted
    with jax.enable_x64(True), one_thread():
        anew = fitting._linearise_at(problem, ended.named, ended.point, list(ended.equations))
        left, _ = fitting._at_hand(problem, anew)
        sd = occam(problem, ended)[1]
    np.testing.assert_allclose(left[ended.named] / sd, 0, atol=0.5)


def test_all_stiffnesses_and_parameters_step_together_to_where_both_fit_best(light):
    """By least squares over one factor and the parameters, their priors as rows of their own."""
    problem, fitted = light[0].problem, light[0].stages[0].fitted
    point, n, sd = fitted.point, len(fitted.point.s), problem.sd(fitted.named)
    values, vectors = np.linalg.eigh(fitted.square)
    rows = (np.sqrt(np.maximum(values, 0)) * vectors).T
    prior = np.diag(np.append(np.sqrt(fitting.LEAST), 1 / sd))
    wanted = np.r_[np.c_[rows[:, :n] @ point.s, rows[:, n:-1]], prior]
    off = np.concatenate([rows[:, -1], [0.0], point.theta[fitted.free] / sd])
    factor, *best = -np.linalg.lstsq(wanted, off, rcond=None)[0]
    theta, s = fitting._by_one_factor(problem, fitted)
    assert point.s.any() and factor != 0
    np.testing.assert_allclose(s, factor * point.s, rtol=1e-5, atol=1e-9)
    far = np.clip(best / sd, -fitting.FAR, fitting.FAR)
    np.testing.assert_allclose(theta[fitted.free] / sd, far, rtol=1e-5, atol=1e-8)


def test_all_stiffnesses_may_go_by_one_factor_where_none_is_likelier_attached(light):
    problem, fitted = light[0].problem, light[0].stages[0].fitted
    with jax.enable_x64(True), one_thread():
        nothing = doubted(problem, fitted, 1e9)
        some, none = (fitting._steps(problem, one, together=False) for one in (fitted, nothing))
    assert fitted.attached.any() and not nothing.attached.any()
    assert len(some) == 2 and len(none) == 3
    assert none[-1][1].any()


def test_normal_equations_are_carried_to_another_point():
    rng = np.random.default_rng(0)
    columns, tool, gone = rng.normal(size=(9, 6)), rng.normal(size=(3, 4)), np.append(rng.normal(size=5), 1.0)
    with jax.enable_x64(True):
        found = fitting._transferred(
            NormalEquations(square=jnp.asarray(columns.T @ columns), tool=jnp.asarray(tool)), gone
        )
    there = np.c_[columns[:, :-1], columns @ gone]
    np.testing.assert_allclose(found.square, there.T @ there, atol=1e-12)
    np.testing.assert_allclose(found.tool, np.c_[tool[:, :-1], tool @ gone[2:]], atol=1e-12)


def test_a_fit_ends_before_a_point_that_cannot_be_weighed(light, monkeypatch):
    """Where a sheet has folded, say."""
    closed, *_ = light
    begun = closed.stages[0].fitted
    folded = dataclasses.replace(begun, cost=np.nan)
    there = iter([begun, folded])
    monkeypatch.setattr(fitting, "_reckoned", lambda *_: next(there))
    monkeypatch.setattr(fitting, "_better", lambda *_: (begun.point, begun.cost - 1))
    monkeypatch.setattr(fitting, "_to_its_end", lambda _, ended: ended)
    assert fit(closed.problem, begun.named, begun.point, {1}) is begun
    assert bayes_factor(closed.problem, folded, begun, 1) == (-np.inf, -np.inf)


def test_errors_no_larger_than_the_usual_gain_nothing_wherever_a_last_step_went(light, monkeypatch):
    problem, fitted = light[0].problem, light[0].stages[0].fitted
    at, gains = problem.sheet.place("stretch"), []
    with jax.enable_x64(True), one_thread():
        stepped = dataclasses.replace(fitted, point=moved(problem, fitted, at, fitted.point.theta[at] - 0.2))
        for variances in ((1.0,), (1.0, 1.0 + 1e-9)):
            monkeypatch.setattr(leaving, "VARIANCES", variances)
            gains.append(leaving.unexplained_residual(problem, stepped).gain)
    assert gains[1] == pytest.approx(gains[0], abs=1e-3)


def test_smaller_errors_than_the_usual_leave_nothing_over(light, monkeypatch):
    """Of smooth force fields 16 times as large as they are taken to be."""
    problem, fitted = light[0].problem, light[0].stages[-1].fitted
    monkeypatch.setattr(leaving, "VARIANCES", (1.0,))
    with jax.enable_x64(True), one_thread():
        found = leaving.unexplained_residual(problem.widened(1.0, 16 * problem.amplitude), fitted)
    assert found.amplitude < 1
    assert found.gain == pytest.approx(leaving._of_tool(problem, fitted)[1])


def test_frames_that_are_doubted_say_less_of_the_attachments(light):
    """Weighed where the fit ended: what it says there itself was carried from the step before, and is rounded so."""
    closed, *_ = light
    last = closed.stages[-1].fitted
    with jax.enable_x64(True), one_thread():
        fitted = fitting._linearise_at(closed.problem, last.named, last.point, list(last.equations))
        same, nothing = (doubted(closed.problem, fitted, excess) for excess in (1.0, 1e9))
    np.testing.assert_array_equal(same.probability, fitted.probability)
    assert fitted.attached.any() and not nothing.attached.any()


def test_all_frames_are_compiled_for_as_one(light):
    closed, _, _ = light
    history, states = closed.problem.history, np.array([one.state for one in closed.problem.history.frames])
    with jax.enable_x64(True):
        moments = [history.moment(k, states) for k in range(len(states))]
    kinds = {tuple((leaf.shape, leaf.dtype, leaf.weak_type) for leaf in jax.tree.leaves(one)) for one in moments}
    assert len(kinds) == 1


def test_grasps_are_predicted_side_by_side_and_the_frames_of_each_in_turn(light):
    """With friction, which knows where the frame before it ended."""
    problem, point = light[0].problem, light[0].stages[0].fitted.point
    theta, history = point.theta.copy(), problem.history
    theta[problem.sheet.place("friction")] = 0.5
    with jax.enable_x64(True), one_thread():
        together, _ = predict_all(problem.sheet, theta, point.s, history, point.states)
        states = point.states
        for k in range(len(history.frames)):
            states, _ = predict_all(problem.sheet, theta, point.s, history, states, only=[k])
        np.testing.assert_array_equal(together, states)
        alone, _ = predict_all(problem.sheet, theta, point.s, history, point.states, only=[1])
    assert history.frames[0].grasp == history.frames[1].grasp
    assert np.abs(alone[1] - together[1]).max() > 1e-6


@pytest.mark.slow
def test_what_creeps_is_predicted_until_it_stays(monkeypatch):
    """Anchors that follow what they hold, in the frame itself too: from rest, as from what was predicted so."""
    creep = tuple(effect for effect in LIBRARY if effect.name == "anchor_creep")
    problem = Problem.build(collect_dataset(DECLARATION, None, seen(1.0)), creep)
    theta, s = np.zeros(problem.sheet.size), 0.3 * attached()
    theta[problem.sheet.place("anchor_creep")] = 3.0
    rest = np.array([sheet().rest for _ in problem.history.frames])
    lift, off = [k for k, one in enumerate(problem.history.frames) if one.grasp == 1], {}
    with jax.enable_x64(True), one_thread():
        for rounds in (1, 12):
            monkeypatch.setattr(predicting, "ROUNDS", rounds)
            once, _ = predict_all(problem.sheet, theta, s, problem.history, rest, only=lift)
            again, _ = predict_all(problem.sheet, theta, s, problem.history, once, only=lift)
            off[rounds] = np.abs(again - once).max()
    assert off[12] < 2 * predicting.STAYS < 0.2 * off[1], off


def test_nothing_is_named_where_nothing_is_missing():
    _, found, _ = closed_over(seen(1.0))
    assert found["verdict"] == "no-effect", story(found)
    assert not found["effects"]
    held = found["held_out"]
    assert held["before_rms_m"] == held["after_rms_m"] < 3**0.5 * 2 * NOISE
    assert held["before_rms_m"] < 0.5 * min(held["in_proportion_rms_m"], held["unmoved_rms_m"])


@pytest.mark.slow
def test_a_tool_that_goes_further_than_it_says_is_named():
    _, found, _ = closed_over(seen(1.0, tool_scale=1.1))
    assert found["effects"][0]["name"] == "tool_scale", story(found)
    assert found["effects"][0]["theta"][0] == pytest.approx(np.log(1.1), abs=0.02)
    assert found["effects"][0]["this_session_alone"]


@pytest.mark.slow
def test_two_effects_at_once_are_both_named_with_what_each_cannot_be_told_from():
    closed, found, _ = closed_over(seen(0.2, tool_scale=1.1))
    names = {effect["name"] for effect in found["effects"]}
    assert names <= {"gravity", "stretch", "tool_scale"} and len(names) == 2, story(found)
    assert {"gravity", "tool_scale"} <= names | set(found["ambiguous_with"])
    scale = next(effect for effect in found["effects"] if effect["name"] == "tool_scale")
    assert scale["theta"][0] == pytest.approx(np.log(1.1), abs=0.02)
    assert all(one.fitted is closed.stages[-1].fitted for one in closed.accepted)


def test_a_hold_that_slips_is_not_explained_by_larger_forces():
    """From the second increment of each lift on, the jaws have gone a centimetre further than what they hold."""
    slipped = [dataclasses.replace(one, tool=_further(one.tool)) if _late(one) else one for one in seen(1.0)]
    _, found, _ = closed_over(slipped)
    assert found["unexplained_residual"][-1]["tool_variance"] > 10, story(found)
    assert found["verdict"] in ("unexplained", "effect-with-remainder"), story(found)


def _late(one: Observation) -> bool:
    earlier = [other for other in seen(1.0) if other.tool.grasp == one.tool.grasp and other.index < one.index]
    return one.tool.closed and len(earlier) > 1


def _further(tool: ToolState) -> ToolState:
    return dataclasses.replace(tool, position=tool.position + np.array([0.0, 0.0, 0.01]))


def test_the_file_and_the_page_hold_what_was_found(light, tmp_path):
    closed, found, _ = light
    assert json.loads(json.dumps(found)) == found
    assert {"verdict", "effects", "ambiguous_with", "tested", "held_out", "localisation"} <= set(found)
    correlation = found["localisation"]["correlates_with"]
    assert correlation["height"] is not None and abs(correlation["height"]) <= 1
    for name in ("a", "b"):
        write_page(tmp_path / f"{name}.html", name="light", sheet=_sheet(closed), found=found)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()
    assert f"Added: {found['effects'][0]['name']}" in (tmp_path / "a.html").read_text()


def test_what_was_found_is_kept_before_a_pull_is_looked_for(light, tmp_path, monkeypatch):
    closed, _, dataset = light
    recording = SimpleNamespace(declaration=None, camera=None, metadata={"name": "light"})

    def stopped(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(keeping.Recording, "open", staticmethod(lambda *_, **__: recording))
    monkeypatch.setattr(keeping, "collect_dataset", lambda *_, **__: dataset)
    monkeypatch.setattr(keeping, "close_the_loop", lambda *_, **__: closed)
    monkeypatch.setattr(keeping, "suggest", stopped)
    with pytest.raises(KeyboardInterrupt):
        keeping.close_loop(tmp_path / "run.mcap", tmp_path / "closed", suggestion=True)
    kept = json.loads((tmp_path / "closed" / keeping.DISCREPANCY).read_text())
    assert kept["verdict"] == closed.verdict and kept["suggestion"] is None
    assert "gravity" in (tmp_path / "closed" / keeping.PAGE).read_text()


@pytest.mark.slow
def test_a_pull_is_suggested_that_tells_more_than_the_first_lift_did(light):
    closed, dataset = light[0], light[2]
    with jax.enable_x64(True), one_thread():
        found = suggest(closed, dataset)
        assert found is not None and set(found.between) == {"gravity", "stretch"}
        fits = [one.fitted for one in (closed.accepted[0], *closed.rivals[0])]
        first = [one for one in dataset.frames if one.grasp == 1][:4]
        assert found.expected > told_apart(closed.problem, fits, first) > 0
        assert told_apart(closed.problem, [fits[0], fits[0]], first) == pytest.approx(0, abs=1)
    assert np.linalg.norm(found.pull) <= max(np.linalg.norm(one.frame.way) for one in dataset.frames) + 1e-9
    assert np.min(np.linalg.norm(sheet().rest - found.grasp, axis=1)) < 1e-3
    told = discrepancy(closed, dataset) | {"suggestion": suggested(found)}
    assert ("To distinguish" in " ".join(story(told))) == found.enough


@pytest.mark.parametrize(
    ("acts", "says"),
    [
        (lambda model, theta, moment: eqx.tree_at(lambda m: m.tool, model, model.tool[:2] + theta[0]), "same parts"),
        (lambda model, theta, moment: eqx.tree_at(lambda m: m.tool, model, model.tool + theta[0] + 1.0), "do nothing"),
        (
            lambda model, theta, moment: eqx.tree_at(lambda m: m.tool, model, model.tool + jnp.sqrt(theta[0])),
            "no finite derivative at 0 along the parameters .0.",
        ),
        (lambda model, theta, moment: model, "to first order"),
        (lambda model, theta, moment: model.nothing, "failed: 'SheetModel' object has no attribute 'nothing'"),
    ],
)
def test_an_effect_of_ones_own_is_tried_first(light, acts, says):
    mine = Effect(name="mine", acts=acts, units=("m",), prior_sd=(1e-3,), source="me")
    problem = light[0].problem
    sheet_with = dataclasses.replace(problem.sheet, library=(mine,))
    with jax.enable_x64(True), pytest.raises(ValueError, match=says):
        check_effects(dataclasses.replace(problem, sheet=sheet_with))


def test_without_a_model_particles_stay_or_go_their_share_of_the_way(light):
    """Frames in which each goes its share of the tool's way exactly, half a millimetre off in the last part."""
    rest, share = sheet().rest, np.random.default_rng(0).uniform(size=(len(sheet().rest), 1))
    last = light[2].frames[-1].part
    frames = [
        dataclasses.replace(
            one, frame=dataclasses.replace(one.frame, y=jnp.asarray(rest + share * np.asarray(one.frame.way) + off))
        )
        for one in light[2].frames
        for off in (5e-4 * (one.part == last and bool(np.any(one.frame.way))) / np.sqrt(3),)
    ]
    mine = [one for one in frames if one.part == last]
    moved = np.mean([bool(np.any(one.frame.way)) for one in mine])
    assert in_proportion(frames, last) == pytest.approx(5e-4 * np.sqrt(moved))
    free = ~np.asarray(mine[0].frame.held)
    gone = np.concatenate([(np.asarray(one.frame.y) - rest)[free] for one in mine])
    assert unmoved(frames, last) == pytest.approx(np.sqrt(np.mean(np.sum(gone**2, axis=1))))


def test_the_jackknife_of_a_mean_is_its_standard_error():
    values = np.random.default_rng(0).normal(size=(7, 2))
    means = [np.delete(values, k, axis=0).mean(axis=0) for k in range(7)]
    np.testing.assert_allclose(jackknife_sd(means, 2), values.std(axis=0, ddof=1) / np.sqrt(7))
    np.testing.assert_array_equal(jackknife_sd([], 2), np.zeros(2))


def test_noise_is_measured_from_still_frames_with_its_smooth_part():
    draw, rest = np.random.default_rng(0), sheet().rest
    apart = np.sum((rest[:, None] - rest[None]) ** 2, axis=2)
    root = np.linalg.cholesky(np.exp(-0.5 * apart / 0.012**2) + 1e-9 * np.eye(len(rest)))
    smooth = 2e-4 * np.einsum("ij,tjk->tik", root, draw.normal(size=(40, len(rest), 3)))
    noise = measure([rest[None] + smooth + 1e-4 * draw.normal(size=(40, len(rest), 3))], rest)
    assert noise is not None
    assert noise.sd == pytest.approx(1e-4, rel=0.25)
    assert noise.smooth_sd == pytest.approx(2e-4, rel=0.25)
    assert noise.length == pytest.approx(0.012, rel=0.25)
    fields, white = noise.fields(rest)
    total = np.sum(fields**2, axis=1) + white**2
    assert total.mean() == pytest.approx(noise.sd**2 + noise.smooth_sd**2, rel=0.02)


def test_what_neighbours_share_counts_as_white_where_it_is_little_beside_the_rest():
    rest = sheet().rest
    nearly_white = StillNoise(sd=2e-4, smooth_sd=4e-5, length=0.004, frames=9)
    fields, white = nearly_white.fields(rest)
    assert fields.shape == (len(rest), 0)
    assert white == pytest.approx(np.hypot(nearly_white.sd, nearly_white.smooth_sd))
    shared = StillNoise(sd=1e-4, smooth_sd=2e-4, length=0.02, frames=9).fields(rest)[0]
    assert shared.shape[1] % STEP == 0
    assert 0 < np.sum(np.any(shared != 0, axis=0)) <= MODES


@pytest.mark.parametrize(
    ("costs", "least", "passes"), [((100, 90, 95, 93, 80), 90, 3), ((100, 90, 95, 80, 85, 70), 70, 5)]
)
def test_a_fit_that_leads_away_and_back_is_taken_where_it_cost_least(monkeypatch, costs, least, passes):
    points = [object.__new__(fitting.Fitted) for _ in costs]
    for point, cost in zip(points, costs, strict=True):
        object.__setattr__(point, "cost", float(cost))
    reckoned = iter(points)
    monkeypatch.setattr(Problem, "frames", lambda self, parts: [])
    monkeypatch.setattr(fitting, "_reckoned", lambda *_: next(reckoned))
    monkeypatch.setattr(fitting, "_steps", lambda *_: [])
    monkeypatch.setattr(fitting, "_better", lambda problem, now, steps: (object.__new__(Point), now.cost - 5))
    monkeypatch.setattr(fitting, "_to_its_end", lambda problem, now: now)
    nothing, named = object.__new__(Problem), np.zeros(0, dtype=int)
    assert fit(nothing, named, object.__new__(Point), {0}, passes=passes).cost == least


def test_a_jump_between_still_frames_is_no_noise():
    draw, rest = np.random.default_rng(0), sheet().rest
    still = rest[None] + 1e-4 * draw.normal(size=(20, len(rest), 3))
    jumped = still + np.where(np.arange(20) < 17, 0.0, 3e-3)[:, None, None]
    plain, noise = measure([still], rest), measure([jumped], rest)
    assert plain is not None and noise is not None
    assert (noise.sd, noise.smooth_sd) == pytest.approx((plain.sd, plain.smooth_sd), abs=5e-6)


def test_where_the_jaws_closed_is_seen_by_the_moved_camera_too(light):
    """A constant shift of all that is seen leaves how far the held particles went, and brings the hold back."""
    problem = light[0].problem
    with jax.enable_x64(True):
        sheet = dataclasses.replace(problem.sheet, library=tuple(one for one in LIBRARY if one.name == "camera_bias"))
        k, shift = 2, jnp.array([1e-3, -2e-3, 3e-3, 0.0, 0.0, 0.0])
        states = light[0].stages[0].fitted.point.states
        frame, moment = problem.history.frames[k].frame, problem.history.moment(k, states)
        moved = dataclasses.replace(frame, y=frame.y + shift[None, :3], rotated=frame.rotated + shift[None, :3])
        closed = closed_on(sheet, shift, moved, moment)
        np.testing.assert_allclose(closed, frame.rotated, atol=1e-12)
        x, nothing = jnp.asarray(states[k]), jnp.zeros(6)
        ways = [
            held_way(sheet.model(theta, moment, one.way), one, closed_on(sheet, theta, one, moment), x)
            for theta, one in ((nothing, frame), (shift, moved))
        ]
        np.testing.assert_allclose(*ways, atol=1e-12)


def test_without_still_frames_the_noise_is_assumed_and_said_to_be():
    assert measure([np.zeros((2, 5, 3))], np.zeros((5, 3))) is None
    observations = [one for one in seen(1.0) if one.tool.closed][:6]
    rest = dataclasses.replace(observations[0], tool=dataclasses.replace(observations[0].tool, closed=False, grasp=0))
    rest = dataclasses.replace(rest, points=seen(1.0)[0].points)
    dataset = collect_dataset(DECLARATION, None, [rest, *observations])
    assert dataset.noise == assumed(NOISE)


def test_time_runs_from_when_the_sheet_lay_as_its_rest_shape_has_it():
    """The mean of the frames before the first grasp; the first where the mesh is declared, or the jaws never open."""
    observations = seen(1.0)
    lying, (first, second) = observations[:STILL], observations[STILL : STILL + 2]
    estimator = Estimator(DECLARATION, None)
    assert all(estimator.update(one) is None for one in lying)
    assert estimator.rest_time == np.mean([one.time for one in lying])
    began = dataclasses.replace(first, index=STILL - 1, time=first.time - 10**9, points=lying[0].points)
    mesh = DeclaredMesh(vertices=sheet().rest, faces=sheet().faces, track_id=lying[0].points.track_id)
    frames = collect_dataset(dataclasses.replace(DECLARATION, mesh=mesh), None, [began, first, second]).frames
    np.testing.assert_allclose([one.time for one in frames][-2:], [1.0, 1.25])


def _sheet(closed):
    return Sheet(rest=np.asarray(closed.problem.history.rest), faces=sheet().faces)


def test_attached_particles_stay_found(light):
    closed = light[0]
    assert np.sum(closed.stages[-1].fitted.attached != attached()) <= 2
