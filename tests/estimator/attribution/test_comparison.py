"""Comparison of effects with each other and with none, by made-up numbers."""

from dataclasses import replace
from unittest.mock import ANY

import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.errors import RecordingError
from jiggle_mj.estimator.attribution import search
from jiggle_mj.estimator.attribution.close_loop import SearchStep, carried_over, check_finite
from jiggle_mj.estimator.attribution.comparison import against, behind, best, indistinguishable, outdone
from jiggle_mj.estimator.attribution.held_out import HeldOut, Variances
from jiggle_mj.estimator.attribution.hypotheses import FitContext, Hypothesis, reported_sd
from jiggle_mj.estimator.attribution.linear import NormalEquations
from jiggle_mj.estimator.attribution.scores import Score
from jiggle_mj.estimator.attribution.unexplained_residual import UnexplainedResidual
from jiggle_mj.estimator.effects import LIBRARY
from tests.support.small_fit import small_fit, small_problem

EFFECTS = {effect.name: effect for effect in LIBRARY}


def ignore(message: str) -> None:
    """Drop a progress message."""


def held_out(*errors_mm: float) -> list[HeldOut]:
    """Return the predictions of parts with the given errors."""
    return [
        HeldOut(
            residual=np.array([[1e-3 * error, 0.0, 0.0]]),
            compute_variances=lambda: Variances(stiffness=np.zeros((1, 3)), others=np.ones((1, 3))),
        )
        for error in errors_mm
    ]


def unexplained(gain: float) -> UnexplainedResidual:
    """Return an unexplained residual of a given gain [nat]."""
    return UnexplainedResidual(gain=gain, variance=1.0, amplitude=1.0, tool_variance=1.0)


def hypothesis(name: str, gain: float, *errors_mm: float, left: float = 0.0, size: float = 0.01) -> Hypothesis:
    """Return an effect with a log Bayes factor [nat], held-out errors, unexplained gain [nat] and size [prior sds]."""
    effect = EFFECTS[name]
    theta = size * np.asarray(effect.prior_sd)
    score = Score(name=name, log_bayes_factor=gain, site=0, theta=theta, p_value=0.0, kept=1.0)
    return Hypothesis(
        score=score,
        effect=effect,
        fitted=small_fit(theta=theta),
        log_bayes_factor=gain,
        at=np.arange(len(theta)),
        sds=np.zeros(len(theta)),
        unexplained=unexplained(left),
        folds=held_out(*errors_mm),
    )


def context(*errors_mm: float, left: float = 0.0) -> FitContext:
    """Return a fit with given held-out errors and an unexplained gain [nat]."""
    return FitContext(fitted=small_fit(), unexplained=unexplained(left), folds=held_out(*errors_mm), scores=[])


def names(hypotheses: list[Hypothesis]) -> list[str]:
    """Return the names of the hypotheses' effects."""
    return [one.effect.name for one in hypotheses]


def test_the_best_explains_much_and_predicts_well():
    likely, sharp, blunt = (
        hypothesis("gravity", 300.0, 0.54, 0.54),
        hypothesis("stretch", 200.0, 0.4, 0.4),
        hypothesis("bed", 320.0, 0.9, 0.9),
    )
    assert best([blunt, likely, sharp]) is likely
    assert "predicts held-out parts better, to 0.54 mm against 0.90 mm" in behind(blunt, likely)
    assert behind(sharp, likely) == "gravity is likelier by 100 nat"


def test_without_held_out_parts_the_likeliest_is_the_best():
    likely, less = hypothesis("gravity", 300.0), hypothesis("stretch", 200.0)
    assert best([less, likely]) is likely
    assert behind(less, likely) == "gravity is likelier by 100 nat"


@pytest.mark.parametrize(
    ("name", "gain", "error", "distinguishable"),
    [
        ("friction", 290.0, 0.5, False),  # as likely, as good
        ("friction", 200.0, 0.5, True),  # less likely
        ("friction", 290.0, 0.6, False),
        ("friction", 290.0, 0.65, True),  # predicts worse
        ("stretch", 100.0, 0.8, False),  # often confused: less is required
        ("stretch", 100.0, 0.9, True),
        ("friction", 310.0, 0.8, False),  # explains more and predicts worse
        ("heterogeneity", 290.0, 0.5, True),  # has more parameters and explains less
        ("heterogeneity", 298.0, 0.5, False),
    ],
)
def test_which_effects_are_indistinguishable_from_the_best(name, gain, error, distinguishable):
    first = hypothesis("gravity", 300.0, 0.5, 0.5)
    assert indistinguishable(hypothesis(name, gain, error, error), first) is not distinguishable


@pytest.mark.parametrize(
    ("one", "why"),
    [
        (hypothesis("gravity", 300.0, 0.5, 0.5, 0.5, 0.5), None),
        (hypothesis("gravity", 300.0, 0.5, 0.5, 1.01, 1.01), None),  # better in half of them
        (hypothesis("gravity", 300.0, 0.5, 1.01, 1.01, 1.01), "better in 1 of 4"),
        (
            hypothesis("gravity", 25.0, 0.9, 0.9, 0.9, 0.9, left=10.0),
            "its log Bayes factor is 25 nat, below 30 nat",
        ),
        (hypothesis("gravity", 45.0, 0.98, 0.98, 0.98, 0.98, left=15.0), None),  # certain, and leaves little
        (hypothesis("gravity", 45.0, 0.98, 0.98, 0.98, 0.98, left=25.0), "0.98 mm with it and 1.00 mm without"),
        (hypothesis("gravity", 45.0, 1.5, 1.01, 0.99, 0.99), None),  # certain: one part aside
        (hypothesis("gravity", 45.0, 1.5, 1.05, 0.99, 0.99), "1.15 mm with it and 1.00 mm without, better in 2 of 4"),
        (hypothesis("gravity", 45.0, 1.5, 1.01, 0.99, 0.99, left=25.0), "1.14 mm with it and 1.00 mm without"),
        (hypothesis("gravity", 45.0, 1.01, 1.01, 1.01, 0.5), "0.91 mm with it and 1.00 mm without, better in 1 of 4"),
        (hypothesis("gravity", 35.0, 0.9, 0.9, 0.9, 0.9, left=-10.0), "larger errors without a named cause explain"),
        (hypothesis("gravity", 15.0, 0.7, 0.7, 0.7, 0.7), None),  # held-out predictions decide
        (hypothesis("gravity", 300.0, 0.5, 0.5, 0.5, 0.5, size=4.0), "beyond 3.5 prior standard deviations"),
    ],
)
def test_which_effects_are_not_added_and_why(one, why):
    reason = against(one, context(1.0, 1.0, 1.0, 1.0, left=20.0))
    assert reason is None if why is None else why in (reason or "")


@pytest.mark.parametrize(("gain", "added"), [(230.0, True), (220.0, False)])
def test_an_effect_far_less_likely_than_a_refused_one_is_not_added_in_its_place(gain, added):
    implausible = hypothesis("bed", 900.0, 0.5, size=4.0)
    reason = outdone(
        hypothesis("stretch", gain, 0.5),
        [implausible, hypothesis("friction", 20.0, 1.0), hypothesis("gravity", 300.0, 1.0)],
    )
    assert reason is None if added else reason == "gravity is likelier by 80 nat, and was refused itself"


def test_an_effect_that_accounts_for_the_whole_unexplained_residual_need_only_predict_no_worse():
    before = context(1.0, 1.0, left=100.0)
    assert against(hypothesis("gravity", 300.0, 0.99, 0.99, left=40.0), before) is None
    assert against(hypothesis("gravity", 300.0, 0.99, 0.99, left=80.0), before) is not None
    assert against(hypothesis("gravity", 300.0, 1.01, 1.01, left=40.0), before) is not None


def test_of_two_parts_none_is_set_aside():
    assert against(hypothesis("gravity", 45.0, 1.5, 0.99), context(1.0, 1.0, left=20.0)) is not None


def test_a_head_start_does_not_make_a_weak_effect_likely():
    weak = hypothesis("tool_scale", 15.0, 0.9, 0.9, 0.9, 0.9)
    assert "its log Bayes factor is 15 nat" in (
        against(weak, context(1.0, 1.0, 1.0, 1.0, left=20.0), head_start=300.0) or ""
    )


@pytest.mark.parametrize(("first_mm", "passed"), [(1.1, []), (0.9, ["gravity", "stretch"])])
def test_until_one_improves_none_is_added_in_place_of_a_far_likelier_one(monkeypatch, first_mm, passed):
    hypotheses = [
        hypothesis("gravity", 90.0, first_mm),
        hypothesis("friction", 85.0, 1.1),
        hypothesis("stretch", 60.0, 0.9),
    ]
    monkeypatch.setattr(search, "fitted_hypotheses", lambda *_: hypotheses)
    monkeypatch.setattr(search, "refined", lambda problem, one, used, log: one)
    before = context(1.0, left=20.0)
    found, refused = search.tested_hypotheses(small_problem(), before, [(before, 0.0)], [], set(), ignore)
    assert names(found) == passed
    assert refused[-1][0].effect.name == ("friction" if passed else "stretch")
    assert passed or "gravity is likelier by 30 nat" in refused[-1][1]


def test_each_but_the_last_is_compared_again_with_its_alternatives(monkeypatch):
    """The first is replaced by a better alternative, the second stays, and the order stays."""
    first, second, third = (hypothesis(name, 300.0, 0.5) for name in ("gravity", "tool_scale", "friction"))
    rival, unlikely = hypothesis("stretch", 250.0, 0.5), hypothesis("bed", 100.0, 0.5)
    added = [
        search.AddedHypothesis(
            hypothesis=first, rivals=[rival], others=[(unlikely, "less likely"), (third, "added later")]
        ),
        search.AddedHypothesis(hypothesis=second, rivals=[], others=[]),
        search.AddedHypothesis(hypothesis=third, rivals=[], others=[]),
    ]
    compared = []

    def beside(problem, last, one, others, used, log):
        compared.append(names([one, *others]))
        gains = {"gravity": 100.0, "stretch": 280.0, "tool_scale": 300.0}
        return small_fit(), [hypothesis(other.effect.name, gains[other.effect.name], 0.5) for other in (one, *others)]

    monkeypatch.setattr(search, "alternatives_beside", beside)
    found = search.revised(small_problem(), added, set(), ignore)
    assert compared == [["gravity", "stretch"], ["tool_scale"]]
    assert names([one.hypothesis for one in found]) == ["stretch", "tool_scale", "friction"]
    assert names(found[0].rivals) == ["gravity"]


def test_a_rival_stays_one_after_the_effect_it_was_a_rival_of_is_dropped(monkeypatch):
    """An alternative far less likely than the dropped effect was a rival only with that effect in the model."""
    first, second, third = (hypothesis(name, 300.0, 0.5) for name in ("gravity", "stretch", "friction"))
    rivals, bending = (
        [hypothesis("bending", 250.0, 0.5), hypothesis("bed", 250.0, 0.5)],
        hypothesis("bending", 200.0, 0.5),
    )
    added = [
        search.AddedHypothesis(
            hypothesis=first, rivals=[hypothesis("stretch", 250.0, 0.5)], others=[(bending, "predicts worse")]
        ),
        search.AddedHypothesis(hypothesis=second, rivals=rivals, others=[]),
        search.AddedHypothesis(hypothesis=third, rivals=[], others=[]),
    ]
    needless = hypothesis("gravity", -16.0, 0.5)
    monkeypatch.setattr(search, "alternatives_beside", lambda *_: (small_fit(), [needless]))
    monkeypatch.setattr(search, "refitted", lambda problem, one, fitted: one)
    monkeypatch.setattr(search, "refined", lambda problem, one, used, log: one)
    found = search.revised(small_problem(), added, set(), ignore)
    assert names([one.hypothesis for one in found]) == ["stretch", "friction"]
    assert [names(one.rivals) for one in found] == [["bending", "gravity"], []]


@pytest.mark.parametrize(("second_mm", "added"), [(0.4, ["gravity", "tool_scale"]), (0.55, [])])
def test_of_two_effects_added_together_the_second_predicts_better_than_the_first_alone(monkeypatch, second_mm, added):
    first, second = hypothesis("gravity", 300.0, 0.5, 0.5), hypothesis("tool_scale", 200.0, second_mm, second_mm)
    monkeypatch.setattr(search, "fitted_hypotheses", lambda *_: [second])
    monkeypatch.setattr(search, "refined", lambda problem, one, used, log: one)
    before = context(1.0, 1.0, left=100.0)
    found = search.two_effects(small_problem(), before, [], [first], 0.0, set(), ignore)
    assert names([one.hypothesis for one in found]) == added


def test_the_reported_sd_is_that_of_one_part_and_of_the_nuisance_parameter():
    """By hand: twice the standard deviation for four parts, and 0.3 of the nuisance parameter 1 in squares."""
    problem = replace(small_problem(), own=np.array([1, 7]), own_sd=np.array([0.3, 9.0]))
    fitted = small_fit(theta=np.zeros(8), named=np.array([0, 1, 2, 5]))
    one = hypothesis("bed", 300.0, 0.5, 0.5, 0.5, 0.5)
    one = replace(one, fitted=fitted, sds=np.array([0.1, 0.2, 0.3, 0.4]))
    np.testing.assert_allclose(reported_sd(problem, one), [0.2, 0.5, 0.6])


def test_effects_that_predict_the_reported_part_worse_are_taken_out_again():
    """Two effects: the first improves the part that chose none from 4.8 to 4.0 mm, the second makes it 6.6 mm."""
    first, second = (
        search.AddedHypothesis(hypothesis=hypothesis(name, 100.0, 0.5), rivals=[], others=[])
        for name in ("gravity", "bed")
    )
    steps = [SearchStep([], context()), SearchStep([first], context()), SearchStep([first, second], context())]
    kept, predicted, dropped = carried_over(steps, held_out(4.8, 4.0, 6.6))
    assert kept == steps[:2] and [1e3 * one.rms for one in predicted] == pytest.approx([4.8, 4.0])
    ((one, why),) = dropped
    assert one is second.hypothesis
    assert why.endswith("predicted to 6.60 mm with it and 4.80 mm with what is declared")
    assert carried_over(steps, held_out(4.8, 4.9, 6.6))[0] == steps[:1]
    assert carried_over(steps, held_out(4.8, 4.9, 4.7)) == (steps, ANY, [])


def test_a_frame_that_the_declared_model_does_not_predict_is_named():
    """The problem's only frame is frame 0, and one of its products is no number."""
    square = np.eye(3)
    equations = {0: NormalEquations(square=jnp.asarray(square), tool=jnp.zeros((3, 1)))}
    check_finite(small_problem(), replace(small_fit(), equations=equations))
    square[1, 1] = np.nan
    equations = {0: NormalEquations(square=jnp.asarray(square), tool=jnp.zeros((3, 1)))}
    with pytest.raises(RecordingError, match=r"1 of the 1 frames .* frame 0"):
        check_finite(small_problem(), replace(small_fit(), equations=equations))
