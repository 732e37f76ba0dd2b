"""Search over hypotheses: the frames that it is over, and what of it is fitted to all frames."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from jiggle_mj.estimator.attribution import fit as fitting
from jiggle_mj.estimator.attribution import hypotheses
from jiggle_mj.estimator.attribution.fit import Fits
from jiggle_mj.estimator.attribution.gauss_newton import linearise_at, moved, start
from jiggle_mj.estimator.attribution.hypotheses import (
    Hypothesis,
    confused,
    left_out,
    of_all_frames,
    searched_frames,
    with_declared,
)
from jiggle_mj.estimator.attribution.scores import Score
from jiggle_mj.estimator.attribution.starts import ObservedStates
from jiggle_mj.estimator.blas import one_thread
from tests.support.made_up_hypotheses import EFFECTS, hypothesis

NO_STEP = {"site": 0, "theta": np.zeros(1), "p_value": 1.0, "kept": 1.0}
"""What the search does not use of a score."""
SCALES_ERROR = 0.5
"""Error of the likeliest variances, by which a fit may end below its start [nat]."""


@pytest.mark.parametrize("largest", [1, 3, 5, 1000])
def test_the_search_is_over_frames_of_all_parts_with_the_last_of_each(light, monkeypatch, largest):
    problem = light[0].problem
    frames = list(range(len(problem.history.frames)))
    monkeypatch.setattr(hypotheses, "N_SEARCHED", largest)
    monkeypatch.setattr(hypotheses, "MAX_SEARCHED", largest)
    found = searched_frames(problem, frames)
    assert found == sorted(set(found)) and set(found) <= set(frames)
    parts = problem.by_part(frames)
    assert {those[-1] for those in parts.values()} <= set(found)
    assert min(largest, len(frames)) <= len(found) <= max(min(largest, len(frames)) + len(parts), len(parts))
    assert largest < len(frames) or found == frames


def test_a_frame_is_predicted_after_all_before_it_in_its_grasp(light):
    problem = light[0].problem
    grasps = [one.grasp for one in problem.history.frames]
    k = next(k for k in range(1, len(grasps)) if grasps[k] == grasps[k - 1] and grasps[k] != grasps[0])
    assert problem.up_to([k]) == [j for j in range(k + 1) if grasps[j] == grasps[k]]
    assert problem.up_to([0, k]) == [0, *problem.up_to([k])]


def refitted(monkeypatch: pytest.MonkeyPatch, evidences: dict[tuple[str, ...], float]) -> list[tuple[str, ...]]:
    """Let fits to all frames have these evidences; return the list that they are noted in."""
    fitted: list[tuple[str, ...]] = []

    def made_up(fits: object, added: tuple, before: Hypothesis | None) -> Hypothesis:
        names = tuple(one.effect.name for one in added)
        fitted.append(names)
        return hypothesis(*names, nat=evidences[names], before=before)

    monkeypatch.setattr(hypotheses, "fit_to_more", lambda fits, frames, before: fits)
    monkeypatch.setattr(hypotheses, "hypothesis_of", made_up)
    return fitted


def test_hypotheses_within_reach_are_fitted_to_all_frames_and_others_extrapolated(monkeypatch):
    """With three times the frames a lead of 40 nat counts 120, which is out of reach; one of 1 nat is not."""
    fitted = refitted(monkeypatch, {(): 7.0, ("gravity",): 150.0, ("bed",): 151.0})
    found = [nothing := hypothesis()]
    found += [
        hypothesis(name, nat=nat, before=nothing) for name, nat in (("gravity", 50), ("bed", 49), ("stretch", 10))
    ]
    now = of_all_frames(found, [0, 1, 2], lambda text: None)
    assert fitted == [(), ("gravity",), ("bed",)]
    assert [one.log_evidence for one in now] == [7.0, 150.0, 151.0, 7.0 + 3 * 10]


def test_what_comes_within_reach_once_the_best_is_fitted_is_fitted_too(monkeypatch):
    fitted = refitted(monkeypatch, {(): 0.0, ("gravity",): 20.0, ("bed",): 90.0})
    found = [nothing := hypothesis()]
    found += [hypothesis(name, nat=nat, before=nothing) for name, nat in (("gravity", 50), ("bed", 30))]
    now = of_all_frames(found, [0, 1, 2], lambda text: None)
    assert fitted == [(), ("gravity",), ("bed",)]
    assert [one.log_evidence for one in now] == [0.0, 20.0, 90.0]


def test_what_the_search_did_not_distinguish_from_the_best_is_fitted_too(monkeypatch):
    """Although its lead over the declared model grew by more than that of the other one."""
    fitted = refitted(monkeypatch, {(): 0.0, ("gravity",): 400.0, ("bed",): 410.0})
    found = [nothing := hypothesis()]
    found += [hypothesis(name, nat=nat, before=nothing) for name, nat in (("gravity", 50), ("bed", 49))]
    now = of_all_frames(found, [0, 1, 2], lambda text: None)
    assert fitted == [(), ("gravity",), ("bed",)] and now[2].log_evidence == 410.0


def test_a_pair_is_fitted_to_all_frames_after_what_it_was_reached_through(monkeypatch):
    refitted(monkeypatch, {(): 0.0, ("gravity",): 5.0, ("gravity", "bed"): 80.0})
    one = hypothesis("gravity", nat=3, before=(nothing := hypothesis()))
    now = of_all_frames([nothing, hypothesis("gravity", "bed", nat=50, before=one)], [0, 1], lambda text: None)
    assert [one.log_evidence for one in now] == [0.0, 80.0]
    assert [one.log_evidence for one in now[1].path] == [0.0, 5.0, 80.0]


def test_fits_to_all_frames_are_not_fitted_again(monkeypatch):
    fitted = refitted(monkeypatch, {})
    found = [hypothesis(), hypothesis("gravity", nat=50)]
    assert of_all_frames(found, [0], lambda text: None) == found and not fitted


def test_another_fit_of_the_declared_model_is_before_all_others():
    one = hypothesis("gravity", nat=5, before=(nothing := hypothesis()))
    pair = hypothesis("gravity", "bed", nat=9, before=one)
    nothing.scores.append(Score(name="bed", log_bayes_factor=1.0, **NO_STEP))
    again = hypothesis(nat=2)
    now = with_declared([nothing, pair, one], again)
    assert [found.names for found in now] == [(), ("gravity",), ("gravity", "bed")]
    assert [found.log_evidence for found in now] == [2, 5, 9] and now[0].fits is again.fits
    assert now[0].scores == nothing.scores
    assert now[2].path == now


def test_effects_that_the_best_is_confused_with_are_those_that_show_at_all():
    nothing = hypothesis()
    scores = {"bed": 3.0, "stretch": -1.0, "friction": 8.0}
    nothing.scores.extend(Score(name=name, log_bayes_factor=nat, **NO_STEP) for name, nat in scores.items())
    assert {"bed", "stretch"} <= set(EFFECTS["gravity"].confounded_with)
    assert [one.name for one in confused(hypothesis("gravity", before=nothing))] == ["bed"]


def test_a_search_begins_anew_where_the_declared_model_fits_better_without_the_best_effect(monkeypatch):
    """An effect that ends at a size of 0 has found no effect, but a better fit of what is declared."""
    begun, left = list[float](), {10.0: 400.0, 400.0: 395.0}
    gain = {10.0: 390.0, 400.0: 50.0}

    def scored(one: Hypothesis, log: object) -> list[Score]:
        begun.append(one.log_evidence)
        return [] if one.added else [Score(name="tethering", log_bayes_factor=30.0, **NO_STEP)]

    monkeypatch.setattr(hypotheses, "likely", scored)
    monkeypatch.setattr(
        hypotheses,
        "added_to",
        lambda before, score, *_: hypothesis(
            score.name, nat=before.log_evidence + gain[before.log_evidence], before=before
        ),
    )
    monkeypatch.setattr(hypotheses, "left_out", lambda last, *_: hypothesis(nat=left[last.path[0].log_evidence]))
    declared = hypothesis(nat=10.0)
    nowhere = ObservedStates(
        problem=declared.fitted.problem, point=declared.fitted.point, frames=[], square=np.zeros((2, 2))
    )
    found = hypotheses.search(declared, nowhere, lambda text: None)
    assert [(one.names, one.log_evidence) for one in found] == [((), 400.0), (("tethering",), 450.0)]
    assert begun == [10.0, 400.0, 450.0]


@pytest.mark.slow
def test_what_is_left_out_at_a_size_of_0_leaves_a_hypothesis_as_likely(light, monkeypatch):
    """Its fit begins where the effect's ended, here without any steps, and with fits without attachments beside it."""
    last = light[0].final
    fitted, one = last.fitted, last.added[-1]
    frames = list(last.fits.assumed.equations)
    monkeypatch.setattr(fitting, "gauss_newton", lambda begun, **_: begun)
    with jax.enable_x64(True), one_thread():
        at_0 = linearise_at(fitted.problem, fitted.named, moved(fitted, one.at, np.zeros(len(one.at))), frames)
        empty = start(fitted.problem, at_0.point.theta, 0 * at_0.point.s, at_0.point.states, frames)
        worse = linearise_at(fitted.problem, np.zeros(0, dtype=int), empty, frames)
        nothing = replace(last.path[0], fits=Fits(worse, worse))
        again = left_out(replace(last, fits=Fits(worse, at_0), before=nothing), one, lambda text: None)
    assert worse.log_posterior < at_0.log_posterior - 1
    assert again.fitted.log_posterior > at_0.log_posterior - SCALES_ERROR
