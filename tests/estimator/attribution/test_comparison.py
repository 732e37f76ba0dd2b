"""Effects against each other and against none, by numbers made up for it."""

from types import SimpleNamespace

import numpy as np
import pytest

from jiggle_mj.estimator.attribution import search
from jiggle_mj.estimator.attribution.comparison import against, behind, best, not_told_from, outdone
from jiggle_mj.estimator.attribution.held_out import HeldOut
from jiggle_mj.estimator.attribution.hypotheses import FitContext, Hypothesis, reported_sd
from jiggle_mj.estimator.attribution.problem import Problem
from jiggle_mj.estimator.attribution.unexplained_residual import UnexplainedResidual
from jiggle_mj.estimator.effects import LIBRARY

EFFECTS = {one.name: one for one in LIBRARY}


def held_out(*errors_mm: float) -> list[HeldOut]:
    """Parts that are each missed by so much."""
    return [HeldOut(off=np.array([[1e-3 * one, 0.0, 0.0]]), reckon=lambda: np.ones((1, 3))) for one in errors_mm]


def leaving(gain: float) -> UnexplainedResidual:
    return UnexplainedResidual(gain=gain, variance=1.0, amplitude=1.0, tool_variance=1.0)


def hypothesis(name: str, gain: float, *errors_mm: float, left: float = 0.0, theta: float = 0.01) -> Hypothesis:
    """An effect of so much evidence, with nothing else of a fit than its first parameter."""
    effect, one = EFFECTS[name], object.__new__(Hypothesis)
    point = SimpleNamespace(theta=np.full(len(effect.prior_sd), theta * np.asarray(effect.prior_sd)))
    vars(one).update(
        effect=effect,
        fitted=SimpleNamespace(point=point),
        at=np.arange(len(effect.prior_sd)),
        log_bayes_factor=gain,
        left=leaving(left),
        folds=held_out(*errors_mm),
    )
    return one


def context(*errors_mm: float, left: float = 0.0) -> FitContext:
    one = object.__new__(FitContext)
    vars(one).update(folds=held_out(*errors_mm), left=leaving(left))
    return one


def test_the_best_explains_much_and_foretells_well():
    likely, sharp, blunt = (
        hypothesis("gravity", 300.0, 0.54, 0.54),
        hypothesis("stretch", 200.0, 0.4, 0.4),
        hypothesis("bed", 320.0, 0.9, 0.9),
    )
    assert best([blunt, likely, sharp]) is likely
    assert "foretells better, to 0.54 mm against 0.90" in behind(blunt, likely)
    assert behind(sharp, likely) == "gravity is likelier by 100 nat"


def test_without_parts_left_out_the_likeliest_is_the_best():
    likely, less = hypothesis("gravity", 300.0), hypothesis("stretch", 200.0)
    assert best([less, likely]) is likely
    assert behind(less, likely) == "gravity is likelier by 100 nat"


@pytest.mark.parametrize(
    ("name", "gain", "error", "told"),
    [
        ("friction", 290.0, 0.5, False),  # as likely, as good
        ("friction", 200.0, 0.5, True),  # less likely
        ("friction", 290.0, 0.6, False),
        ("friction", 290.0, 0.65, True),  # foretells worse
        ("stretch", 100.0, 0.8, False),  # often confused: less is enough
        ("stretch", 100.0, 0.9, True),
        ("friction", 310.0, 0.8, False),  # explains more where it foretells worse
        ("heterogeneity", 290.0, 0.5, True),  # has more parameters and explains less
        ("heterogeneity", 298.0, 0.5, False),
    ],
)
def test_what_cannot_be_told_from_the_best(name, gain, error, told):
    first = hypothesis("gravity", 300.0, 0.5, 0.5)
    assert not_told_from(hypothesis(name, gain, error, error), first) is not told


@pytest.mark.parametrize(
    ("one", "why"),
    [
        (hypothesis("gravity", 300.0, 0.5, 0.5, 0.5, 0.5), None),
        (hypothesis("gravity", 300.0, 0.5, 0.5, 1.01, 1.01), None),  # half of them is enough
        (hypothesis("gravity", 300.0, 0.5, 1.01, 1.01, 1.01), "better in 1 of 4"),
        (
            hypothesis("gravity", 25.0, 0.9, 0.9, 0.9, 0.9, left=10.0),
            "25 nat, less than the 30 from which one is added",
        ),
        (hypothesis("gravity", 45.0, 0.98, 0.98, 0.98, 0.98, left=15.0), None),  # certain, and leaves little
        (hypothesis("gravity", 45.0, 0.98, 0.98, 0.98, 0.98, left=25.0), "0.98 mm with it and 1.00 mm without"),
        (hypothesis("gravity", 45.0, 1.5, 1.01, 0.99, 0.99), None),  # certain: one part aside
        (hypothesis("gravity", 45.0, 1.5, 1.05, 0.99, 0.99), "1.15 mm with it and 1.00 mm without, better in 2 of 4"),
        (hypothesis("gravity", 45.0, 1.5, 1.01, 0.99, 0.99, left=25.0), "1.14 mm with it and 1.00 mm without"),
        (hypothesis("gravity", 45.0, 1.01, 1.01, 1.01, 0.5), "0.91 mm with it and 1.00 mm without, better in 1 of 4"),
        (hypothesis("gravity", 35.0, 0.9, 0.9, 0.9, 0.9, left=-10.0), "larger errors without a cause explain"),
        (hypothesis("gravity", 15.0, 0.7, 0.7, 0.7, 0.7), None),  # foretelling decides
        (hypothesis("gravity", 300.0, 0.5, 0.5, 0.5, 0.5, theta=4.0), "beyond 3.5 prior standard deviations"),
    ],
)
def test_what_is_not_added_and_why(one, why):
    said = against(one, context(1.0, 1.0, 1.0, 1.0, left=20.0))
    assert said is None if why is None else why in (said or "")


@pytest.mark.parametrize(("gain", "added"), [(230.0, True), (220.0, False)])
def test_what_is_far_less_likely_than_one_that_is_refused_is_not_added_in_its_place(gain, added):
    absurd = hypothesis("bed", 900.0, 0.5, theta=4.0)
    said = outdone(
        hypothesis("stretch", gain, 0.5), [absurd, hypothesis("friction", 20.0, 1.0), hypothesis("gravity", 300.0, 1.0)]
    )
    assert said is None if added else said == "gravity is likelier by 80 nat, and refused itself"


def test_what_accounts_for_all_that_was_left_over_need_only_foretell_no_worse():
    before = context(1.0, 1.0, left=100.0)
    assert against(hypothesis("gravity", 300.0, 0.99, 0.99, left=40.0), before) is None
    assert against(hypothesis("gravity", 300.0, 0.99, 0.99, left=80.0), before) is not None
    assert against(hypothesis("gravity", 300.0, 1.01, 1.01, left=40.0), before) is not None


def test_of_two_parts_none_is_put_aside():
    assert against(hypothesis("gravity", 45.0, 1.5, 0.99), context(1.0, 1.0, left=20.0)) is not None


def test_what_another_explains_makes_none_likely():
    weak = hypothesis("tool_scale", 15.0, 0.9, 0.9, 0.9, 0.9)
    assert "it explains 15 nat" in (against(weak, context(1.0, 1.0, 1.0, 1.0, left=20.0), head_start=300.0) or "")


@pytest.mark.parametrize(("first_mm", "passed"), [(1.1, []), (0.9, ["gravity", "stretch"])])
def test_until_one_is_better_none_is_added_in_place_of_a_far_likelier_one(monkeypatch, first_mm, passed):
    hypotheses = [
        hypothesis("gravity", 90.0, first_mm),
        hypothesis("friction", 85.0, 1.1),
        hypothesis("stretch", 60.0, 0.9),
    ]
    monkeypatch.setattr(search, "fitted_hypotheses", lambda *_: hypotheses)
    monkeypatch.setattr(search, "refined", lambda problem, one, used, log: one)
    before = context(1.0, left=20.0)
    found, refused = search._tried(object.__new__(Problem), before, [(before, 0.0)], [], set(), lambda said: None)
    assert [one.effect.name for one in found] == passed
    assert refused[-1][0].effect.name == ("friction" if passed else "stretch")
    assert passed or "gravity is likelier by 30 nat" in refused[-1][1]


def test_each_but_the_last_is_compared_again_with_what_was_tried_in_its_place(monkeypatch):
    """The first is exchanged for what does better beside the others, the second stays, and the order with them."""
    first, second, third = (hypothesis(name, 300.0, 0.5) for name in ("gravity", "tool_scale", "friction"))
    rival, unlikely = hypothesis("stretch", 250.0, 0.5), hypothesis("bed", 100.0, 0.5)
    added = [
        search.AddedHypothesis(
            hypothesis=first, rivals=[rival], others=[(unlikely, "less likely"), (third, "added later")]
        ),
        search.AddedHypothesis(hypothesis=second, rivals=[], others=[]),
        search.AddedHypothesis(hypothesis=third, rivals=[], others=[]),
    ]
    asked = []

    def beside(problem, last, one, others, used, log):
        asked.append([one.effect.name, *(other.effect.name for other in others)])
        gains = {"gravity": 100.0, "stretch": 280.0, "tool_scale": 300.0}
        return None, [hypothesis(other.effect.name, gains[other.effect.name], 0.5) for other in (one, *others)]

    monkeypatch.setattr(search, "_beside", beside)
    monkeypatch.setattr(search, "_with", lambda one, last: one)
    monkeypatch.setattr(
        search,
        "replace",
        lambda one, hypothesis: search.AddedHypothesis(hypothesis=hypothesis, rivals=one.rivals, others=[]),
    )
    found = search.revised(object.__new__(Problem), added, set(), lambda said: None)
    assert asked == [["gravity", "stretch"], ["tool_scale"]]
    assert [one.hypothesis.effect.name for one in found] == ["stretch", "tool_scale", "friction"]
    assert [one.effect.name for one in found[0].rivals] == ["gravity"]


def test_what_was_not_told_from_an_effect_that_is_dropped_is_still_not_told_from_it(monkeypatch):
    """And what was far less likely than that one was only beside it as good as the one that stays."""
    first, second, third = (hypothesis(name, 300.0, 0.5) for name in ("gravity", "stretch", "friction"))
    rivals, bending = (
        [hypothesis("bending", 250.0, 0.5), hypothesis("bed", 250.0, 0.5)],
        hypothesis("bending", 200.0, 0.5),
    )
    added = [
        search.AddedHypothesis(
            hypothesis=first, rivals=[hypothesis("stretch", 250.0, 0.5)], others=[(bending, "foretells worse")]
        ),
        search.AddedHypothesis(hypothesis=second, rivals=rivals, others=[]),
        search.AddedHypothesis(hypothesis=third, rivals=[], others=[]),
    ]
    needless = hypothesis("gravity", -16.0, 0.5)
    monkeypatch.setattr(search, "_beside", lambda *_: (None, [needless]))
    monkeypatch.setattr(search, "_with", lambda one, last: one)
    monkeypatch.setattr(search, "refitted", lambda problem, one, fitted: one)
    monkeypatch.setattr(search, "refined", lambda problem, one, used, log: one)
    found = search.revised(object.__new__(Problem), added, set(), lambda said: None)
    assert [one.hypothesis.effect.name for one in found] == ["stretch", "friction"]
    assert [[rival.effect.name for rival in one.rivals] for one in found] == [["bending", "gravity"], []]


@pytest.mark.parametrize(("second_mm", "added"), [(0.4, ["gravity", "tool_scale"]), (0.55, [])])
def test_of_two_that_are_added_together_the_second_foretells_better_than_the_first_alone(monkeypatch, second_mm, added):
    first, second = hypothesis("gravity", 300.0, 0.5, 0.5), hypothesis("tool_scale", 200.0, second_mm, second_mm)
    monkeypatch.setattr(search, "fitted_hypotheses", lambda *_: [second])
    monkeypatch.setattr(search, "refined", lambda problem, one, used, log: one)
    monkeypatch.setattr(search, "replace", lambda one, **changed: one)
    monkeypatch.setattr(search, "FitContext", lambda **said: context(0.5, 0.5))
    before = context(1.0, 1.0, left=100.0)
    found = search._two(object.__new__(Problem), before, [], [first], 0.0, set(), lambda said: None)
    assert [one.hypothesis.effect.name for one in found] == added


def test_a_size_is_as_sure_as_one_part_alone_makes_it_and_as_what_any_sheet_has():
    problem, one = object.__new__(Problem), hypothesis("bed", 300.0, 0.5, 0.5, 0.5, 0.5)
    vars(problem).update(own=np.array([1, 7]), own_sd=np.array([0.3, 9.0]))
    vars(one).update(fitted=SimpleNamespace(named=np.array([0, 1, 2, 5])), sds=np.array([0.1, 0.2, 0.3, 0.4]))
    np.testing.assert_allclose(reported_sd(problem, one), [0.2, 0.5, 0.6])
