"""Policies in closed loop with a small reference: their actions, their limits, and the reason why they end."""

import itertools
import json
import signal
from dataclasses import replace
from itertools import islice, pairwise
from typing import Any

import numpy as np
import pytest

from jiggle_mj.actions import Action, Grasp, Move, Release, Wait
from jiggle_mj.cli.terminal import deferred_interrupt
from jiggle_mj.errors import ActionError, OptionError
from jiggle_mj.estimator import Estimator, EstimatorConfig
from jiggle_mj.estimator.planning.information_config import InformationPolicyConfig
from jiggle_mj.estimator.planning.information_policy import InformationPolicy
from jiggle_mj.estimator.planning.policy import STEP, Policy
from jiggle_mj.estimator.planning.procedures import Detach
from jiggle_mj.eval.runs.acting import actions, check_policy_fits, most_actions, policy_named
from jiggle_mj.eval.runs.experiment import run_scene
from jiggle_mj.limits import Limits
from jiggle_mj.observation import Declaration
from jiggle_mj.options import POLICIES
from jiggle_mj.scenes import Reference, load_scene, programme
from tests.support.result_keys import KEYS_OF_POINTS, keys
from tests.support.tiny_scene import SCENE, call, scene_file

DISC_RADIUS = 12e-3
"""Radius of the attached disc in the middle of the tiny scene [m]."""
MAX_REFIT_ERROR = 0.95
"""Largest squared error after refits, as a share of that without: a refit must gain more than rounding."""
ROUNDING = 1e-9
"""Rounding of a distance between two tips [m]."""
PAPERS = ("pmp-up", *(pytest.param(name, marks=pytest.mark.slow) for name in ("sl-d", "lg-d", "lg-h")))


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return load_scene(str(scene_file(tmp_path_factory.mktemp("scene"))))


class Loop:
    """Run of a policy on a tissue, with its actions and entropies."""

    def __init__(self, scene, policy: Policy, *, steps: int):
        with Reference(scene, seed=0, sensing="particles") as reference:
            config = EstimatorConfig(refinement="frames")
            self.estimator = Estimator(reference.declaration, reference.camera, config=config)
            self.done, self.entropy = [], []
            for action in actions(scene, policy, self.estimator, steps):
                found = self.estimator.update(reference.step(action))
                self.done.append(action)
                self.entropy += [] if found is None else [found.entropy]


@pytest.fixture(scope="module")
def ours(scene) -> tuple[Policy, Loop]:
    policy = policy_named("information", scene, seed=0)
    assert policy is not None
    return policy, Loop(scene, policy, steps=8)


def test_ours_looks_grasps_and_pulls_in_steps_and_learns(ours):
    policy, loop = ours
    assert [type(action) for action in loop.done[:3]] == [Wait, Wait, Grasp]
    tips = [
        action.point if isinstance(action, Grasp) else action.to
        for action in loop.done[2:]
        if not isinstance(action, Release)
    ]
    moved = [np.linalg.norm(b - a) for a, b in pairwise(tips)]
    assert moved[0] == pytest.approx(STEP)
    assert len(policy.decisions) == 8 and policy.ended == "all 8 steps are done"
    assert all(one.why and one.plan_s > 0 for one in policy.decisions)
    words = [one.does for one in policy.decisions]
    assert words[0].startswith("grasp at (") and words[1].startswith("move to (") and words[1].endswith(") mm")
    closed, moved = loop.entropy[:2]  # where the jaws close nothing has moved, and hardly anything is learned
    assert loop.entropy[-1] < moved < min(closed, loop.estimator.prior_entropy)


@pytest.mark.slow
def test_the_same_seed_plans_the_same(scene, ours):
    again = policy_named("information", scene, seed=0)
    assert again is not None
    for old, new in zip(ours[1].done, Loop(scene, again, steps=4).done, strict=False):
        assert type(old) is type(new)
        if isinstance(new, Move):
            np.testing.assert_array_equal(old.to, new.to)


def test_a_refit_after_each_frame_is_nearer_to_the_truth(scene):
    """Mean squared error of P(attached) over the frames of the first lift, of the disc in the middle."""
    error = {}
    for refinement in ("grasps", "frames"):
        with Reference(scene, seed=0, sensing="particles") as reference:
            estimator = Estimator(
                reference.declaration, reference.camera, config=EstimatorConfig(refinement=refinement)
            )
            found = [estimator.update(reference.step(action)) for action in islice(programme(scene), 6)]
        attached = np.linalg.norm(estimator.sheet.rest[:, :2], axis=1) < DISC_RADIUS
        estimates = [estimate for estimate in found if estimate is not None]
        error[refinement] = np.mean([(estimate.probability - attached) ** 2 for estimate in estimates])
    assert error["frames"] < MAX_REFIT_ERROR * error["grasps"]


@pytest.mark.parametrize("name", PAPERS)
def test_the_papers_policies_move_the_grasp_that_they_are_given(scene, name):
    policy = policy_named(name, scene, seed=0)
    assert policy is not None
    loop = Loop(scene, policy, steps=3)
    assert sum(isinstance(action, Grasp) for action in loop.done) == 1
    planned = [one.action for one in policy.decisions]
    assert planned and all(isinstance(action, Move) for action in planned)
    tips = [action.to for action in loop.done if isinstance(action, Move)]
    assert max(np.linalg.norm(b - a) for a, b in pairwise(tips[-len(planned) - 1 :])) <= STEP + ROUNDING


def test_where_nothing_is_safe_nothing_is_grasped_and_it_says_so(scene):
    policy = InformationPolicy(Limits(force=1e-9, energy=1e-20), radius=8e-3, seed=0)
    loop = Loop(scene, policy, steps=8)
    assert not any(isinstance(action, Grasp) for action in loop.done)
    assert policy.ended.startswith("no safe pull teaches ") and "not decided" in policy.ended


@pytest.mark.slow
def test_where_nothing_is_safe_the_command_says_why_nothing_was_estimated(tmp_path, monkeypatch, capsys):
    unsafe = scene_file(tmp_path, text=SCENE + "[limits]\nforce = 1e-9\nenergy = 1e-20\n")
    for policy, why in (
        ("information", "no safe pull teaches "),
        ("suture", "no stretch of "),
    ):
        arguments = ("--sensing", "particles", "--policy", policy, "--overwrite")
        assert call(monkeypatch, "run", unsafe, "--out", tmp_path / "out", *arguments) == 1
        assert f"the policy {policy} has ended, as {why}" in capsys.readouterr().err


def test_ours_without_regrasping_closes_the_jaws_and_lifts_nothing_unasked(scene):
    policy = policy_named("one-grasp", scene, seed=0)
    assert policy is not None
    first = list(islice(actions(scene, policy, Estimator(Declaration()), 5), 3))
    assert [type(action) for action in first] == [Wait, Wait, Grasp]
    assert most_actions(scene, "one-grasp", 5) == 3 + 5


def test_a_grasp_from_which_little_is_to_be_learned_is_left(ours):
    policy = InformationPolicy(Limits(), radius=8e-3, seed=0, regrasps=False, min_gain=np.inf)
    assert policy.plan(ours[1].estimator) == "little is left to learn"


@pytest.mark.parametrize(("cost", "goes"), [(3, True), (1e9, False)])
def test_another_place_is_worth_going_to_if_it_teaches_more_than_it_costs_to_get_there(ours, cost, goes):
    _, loop = ours
    here = loop.estimator.tool.position + np.array([0, 0, STEP])

    class OnePull(InformationPolicy):
        def best_pull(self, estimator, predictor):
            return here, 1e-3

    config = InformationPolicyConfig(regrasp_steps=cost, min_gain=0.0)
    action, why = OnePull(Limits(), radius=8e-3, seed=0, config=config).plan(loop.estimator)
    assert (why == "another place teaches more") is goes
    back = np.linalg.norm(loop.estimator.tool.position - loop.estimator.hold.tip) < 0.1 * STEP
    if goes and back:
        assert isinstance(action, Release)
    else:
        assert isinstance(action, Move)
        np.testing.assert_array_equal(action.to, loop.estimator.hold.tip if goes else here)


def test_where_every_attachment_is_decided_enough_is_known(ours, monkeypatch):
    _, loop = ours
    opened = replace(loop.estimator.tool, closed=False)
    monkeypatch.setattr(Estimator, "tool", property(lambda _: opened))
    nothing = np.zeros(len(loop.estimator.sheet.rest), bool)
    reason = InformationPolicy(Limits(), radius=8e-3, seed=0, about=nothing).plan(loop.estimator)
    assert reason == "enough is known: every P(attached) is below 0.05 or above 0.95"


def test_a_run_that_is_stopped_writes_what_it_has(scene, tmp_path):
    asked = itertools.count()
    figures: Any = run_scene(scene, tmp_path / "out", sensing="particles", stop=lambda: next(asked) > 4)
    assert figures["ended"] == "it was interrupted" and figures["n_frames"] == 5
    assert figures["detection"]["n_attached"] > 0 and (tmp_path / "out" / "report.html").exists()


def test_the_first_interrupt_ends_the_run_and_the_second_stops_at_once():
    before = signal.getsignal(signal.SIGINT)
    with deferred_interrupt() as stopped:
        assert not stopped()
        signal.raise_signal(signal.SIGINT)
        assert stopped()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before


def test_a_grasp_that_slipped_is_let_go(ours, monkeypatch):
    _, loop = ours
    if loop.estimator.hold is None:
        pytest.fail("the last step of the run has tissue in the jaws")
    monkeypatch.setattr(Estimator, "slip", property(lambda _: 2 * InformationPolicyConfig().max_slip))
    fresh = InformationPolicy(Limits(), radius=8e-3, seed=0)
    action, why = fresh.plan(loop.estimator)
    assert isinstance(action, Release) and "slipped out of the jaws by 10 mm" in why


def test_jaws_that_closed_unseen_are_opened(ours, monkeypatch):
    _, loop = ours
    monkeypatch.setattr(Estimator, "hold", property(lambda _: None))
    action, why = InformationPolicy(Limits(), radius=8e-3, seed=0).plan(loop.estimator)
    assert isinstance(action, Release) and "no frame has shown" in why


def test_a_tip_out_of_reach_is_taken_back_and_it_says_where_it_was(ours, monkeypatch):
    _, loop = ours
    far = replace(loop.estimator.tool, position=np.array([0.0, 0.0, 0.2]))
    monkeypatch.setattr(Estimator, "tool", property(lambda _: far))
    action, why = InformationPolicy(Limits(), radius=8e-3, seed=0).plan(loop.estimator)
    assert isinstance(action, Move) and "the tip at (0, 0, 200) mm is out of reach" in why
    np.testing.assert_array_equal(action.to, loop.estimator.hold.tip)


def test_a_tool_that_touches_the_bed_everywhere_grasps_nothing(ours, scene, monkeypatch):
    """Upside down, its shaft would have to go through the bed."""
    _, loop = ours
    upturned = replace(loop.estimator.tool, quat_wxyz=np.array([0.0, 1.0, 0.0, 0.0]), closed=False)
    monkeypatch.setattr(Estimator, "tool", property(lambda _: upturned))
    policy = policy_named("information", scene, seed=0)
    assert policy is not None
    assert policy.plan(loop.estimator) == "no place of the sheet is within the tool's reach"


class Interrupted(Policy):
    def plan(self, estimator):
        if self.decisions:
            raise KeyboardInterrupt
        return Wait(), "to begin with"


def test_an_interrupted_plan_is_the_end_of_the_run_not_of_the_results():
    policy = Interrupted()
    done = list(policy.actions(Estimator(Declaration()), steps=5))
    assert len(done) == 1 and policy.ended == "it was interrupted"


def test_a_run_with_a_policy_writes_all_and_counts_frames_over_the_limits(tmp_path, monkeypatch, capsys):
    path = scene_file(tmp_path, text=SCENE + "[limits]\nforce = 1e-5\n")
    arguments = ("--sensing", "particles", "--policy", "pmp-up", "--steps", 3, "--json")
    assert call(monkeypatch, "run", path, "--out", tmp_path / "out", *arguments) == 0
    figures = json.loads(capsys.readouterr().out)
    changed = {"settings": KEYS_OF_POINTS["settings"] | {"estimator": {"refinement": None}}}  # as a policy needs it
    assert keys(figures) == KEYS_OF_POINTS | changed
    assert figures["policy"] == "pmp-up" and figures["ended"] == "all 3 steps are done"
    assert [decision["does"][:7] for decision in figures["decisions"]] == ["move to"] * 3
    assert "Actions and reasons" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert figures["timing"]["plan_s"] > 0 and figures["safety"]["limit_n"] == 1e-5
    safety = figures["safety"]
    assert safety["force_violations"] > 0 and safety["max_force_n"] > 1e-5
    assert (safety["violations"] > 0) == (safety["max_mean_boundary_energy_j"] > safety["limit_j"])
    assert safety["limit_j"] == 1e-7
    assert figures["procedure"] is None


class Corners(InformationPolicy):
    """Four corner lifts, wherever the corners lie, in place of plans that take minutes."""

    refused = Policy.refused

    def __init__(self):
        Policy.__init__(self)
        self.regrasps = False
        corners = ((-1, -1), (1, -1), (1, 1), (-1, 1))
        self._planned = [(corner, height) for corner in corners for height in (None, 0.01, 0.02, 0.03, 0.0, "open")]

    def plan(self, estimator: Estimator) -> tuple[Action, str] | str:
        if not self._planned:
            return "enough was seen"
        direction, height = self._planned.pop(0)
        if height == "open":
            return Release(), "the next"
        if height is None:
            corner = np.argmax(estimator.begin().rest[:, :2] @ np.array(direction))
            self._point = estimator.positions[corner]
            return Grasp(point=self._point, radius=8e-3), "the next"
        return Move(to=self._point + np.array([0, 0, height])), "higher"


@pytest.mark.slow
@pytest.mark.parametrize("fails", [False, True])
def test_a_procedure_cuts_what_is_found_and_says_whether_it_worked(tmp_path, fails):
    scene = load_scene(str(scene_file(tmp_path, text=SCENE + f"[procedure]\ncut_fails = {int(fails)}\n")))
    planner = Detach(lambda **_: Corners())
    figures: Any = run_scene(scene, tmp_path / "out", sensing="particles", policy="detach", planner=planner, steps=60)
    done = figures["procedure"]
    assert keys(figures) == KEYS_OF_POINTS | {"procedure": dict.fromkeys(("name", "cycles", "success", "acts"))}
    assert done["name"] == "detach" and done["success"] is not fails
    for act in done["acts"][:-1] if fails else done["acts"]:
        assert act["kind"] == "cut" and act["succeeded"] is not fails
        assert (act["log_bayes_factor"] > 0) is not fails
    assert done["cycles"] == 1 or fails
    assert figures["ended"].startswith("all 60 steps" if fails else "nothing is found attached any more")


class Misses(Corners):
    """Grasps one corner, and then a place above the tissue."""

    def plan(self, estimator: Estimator) -> tuple[Action, str] | str:
        planned = super().plan(estimator)
        if len(self.decisions) > 2 and not isinstance(planned, str) and isinstance(planned[0], Grasp):
            return Grasp(point=np.array([0.0, 0.0, 0.5]), radius=8e-3), "above the tissue"
        return planned


def test_a_grasp_that_misses_ends_the_run_and_loses_nothing(scene, tmp_path):
    figures: Any = run_scene(scene, tmp_path / "out", sensing="particles", policy="information", planner=Misses())
    assert figures["ended"].startswith("an action could not be carried out: grasp at")
    assert figures["detection"]["n_attached"] > 0 and (tmp_path / "out" / "report.html").exists()


def test_where_a_grasp_of_ours_has_missed_it_grasps_elsewhere(scene, tmp_path, monkeypatch):
    """The first grasp meets no tissue."""
    tried: list[np.ndarray] = []
    step = Reference.step

    def misses_first(self, action):
        if isinstance(action, Grasp):
            tried.append(action.point)
            if len(tried) == 1:
                raise ActionError("it holds nothing")
        return step(self, action)

    monkeypatch.setattr(Reference, "step", misses_first)
    figures: Any = run_scene(scene, tmp_path / "out", sensing="particles", policy="information", steps=3)
    assert len(tried) == 2 and np.linalg.norm(tried[1] - tried[0]) > 8e-3
    assert figures["ended"] == "all 3 steps are done"


def test_options_that_do_not_fit_are_refused(scene):
    with pytest.raises(OptionError, match="policy = 'best': must be one of corners, information"):
        policy_named("best", scene, seed=0)
    with pytest.raises(OptionError, match="steps = 0: must be at least 1"):
        most_actions(scene, "information", 0)
    policy = policy_named("detach", scene, seed=0)
    assert policy is not None
    with pytest.raises(OptionError, match="plan with the filter 'implicit'; got 'adam'"):
        check_policy_fits(policy, replace(EstimatorConfig(), filter="adam"))


def test_every_policy_has_a_length(scene):
    assert {name: most_actions(scene, name, 7) > 7 for name in POLICIES} == dict.fromkeys(POLICIES, True)
