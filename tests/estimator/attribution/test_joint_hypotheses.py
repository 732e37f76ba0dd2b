"""Sets of shared effects of several recordings, by made-up evidences against sums by hand."""

import numpy as np
import pytest

from jiggle_mj.estimator.attribution.joint_evidence import OwnInformation, SharedPrior
from jiggle_mj.estimator.attribution.joint_hypotheses import (
    Effects,
    EffectsPrior,
    RecordedFit,
    decide_jointly,
    joint_hypotheses,
    within_reach,
    without_each,
)
from jiggle_mj.estimator.attribution.verdict import POWER, HypothesisEvidence, decide

TISSUE, SENSING = ("gravity", "stretch", "inclusion", "poisson"), ("tool_scale", "camera_bias")
OTHERS = tuple(f"other_{k}" for k in range(30))
"""Effects that nothing speaks for."""
SITES = {name: 9 if name == "inclusion" else 1 for name in (*TISSUE, *SENSING, *OTHERS)}
FREE = SharedPrior(sd=np.ones(1), lower=np.full(1, -np.inf))
PRIOR = EffectsPrior(sites=SITES, of_tissue={(name, site): FREE for name in TISSUE for site in range(SITES[name])})
LIBRARY = len(SITES)
SMALL = 3.0
"""Evidence for an effect, after the power, that its prior outweighs by 1.3 nat in one recording."""
SHARP = 400.0
"""Information of a recording on a parameter, whose standard deviation then is a twentieth of its prior's."""


def fit(*names: str, nat: float = 0.0, theta: float = 0.3, site: int = 0, larger: float = 0.0) -> RecordedFit:
    """Return a fit of some effects, with a log evidence after the power, whose parameters are all theta."""
    shared = tuple(sorted((name, site if SITES[name] > 1 else 0) for name in names if name in TISSUE))
    own = tuple(sorted((name, 0) for name in names if name in SENSING))
    size = len(shared)
    information = OwnInformation(
        log_evidence=nat / POWER,
        theta=np.full(size, theta),
        precision=SHARP * np.eye(size),
        slope=np.full(size, theta),
    )
    return RecordedFit(shared=shared, own=own, larger_errors=larger, information=information)


def probabilities(recordings: dict[str, list[RecordedFit]]) -> dict[Effects, float]:
    """Return the probability of each set of shared effects."""
    found = joint_hypotheses(recordings, PRIOR)
    return {
        one.shared: share for one, share in zip(found, decide_jointly(found, PRIOR).probabilities.tolist(), strict=True)
    }


def test_one_recording_has_the_probabilities_that_it_has_alone():
    """Where each set was fitted with one choice of the tool's effects."""
    fits = [fit(), fit("gravity", nat=4.0), fit("inclusion", "tool_scale", nat=7.0, site=3), fit("stretch", nat=1.0)]
    alone = decide(
        [
            HypothesisEvidence(
                effects=tuple(name for name, _ in (*one.shared, *one.own)),
                log_evidence=one.information.log_evidence,
                sites=int(np.prod([SITES[name] for name, _ in one.shared])),
                larger_errors=0.0,
            )
            for one in fits
        ],
        LIBRARY,
    )
    together = probabilities({"a": fits})
    np.testing.assert_allclose([together[one.shared] for one in fits], alone.probabilities)


def test_an_effect_too_small_for_one_recording_is_certain_with_three():
    fits = [fit(), fit("gravity", nat=SMALL)]
    assert decide_jointly(joint_hypotheses({"a": fits}, PRIOR), PRIOR).kind == "no-effect"
    found = joint_hypotheses({name: fits for name in "abc"}, PRIOR)
    assert decide_jointly(found, PRIOR).kind == "effect" and found[0].names == ("gravity",)
    # by hand: each had the prior of the parameter in its evidence, and together it is one parameter, known three times
    shared_once = 3 * np.log(1 + SHARP) - np.log(1 + 3 * SHARP) + 2 * 0.3**2
    assert POWER * found[0].posterior.log_evidence == pytest.approx(3 * SMALL + POWER * shared_once / 2, abs=0.01)


def test_recordings_that_each_have_another_rival_agree_on_one_effect():
    """Each alone takes another one for as likely as gravity."""
    recordings = {
        "a": [fit(), fit("gravity", nat=6.0), fit("stretch", nat=6.0), fit("poisson", nat=1.0)],
        "b": [fit(), fit("gravity", nat=6.0), fit("stretch", nat=1.0), fit("poisson", nat=6.0)],
    }
    for name in recordings:
        assert decide_jointly(joint_hypotheses({name: recordings[name]}, PRIOR), PRIOR).kind == "ambiguous"
    found = joint_hypotheses(recordings, PRIOR)
    decision = decide_jointly(found, PRIOR)
    assert decision.kind == "effect" and found[decision.best].names == ("gravity",)


def test_an_effect_of_different_sizes_is_not_shared():
    """The same evidence in both, of opposite signs, ten standard deviations from 0 each."""
    one, other = [[fit(), fit("gravity", nat=9.0, theta=theta)] for theta in (0.5, -0.5)]
    assert probabilities({"a": one, "b": one})[("gravity", 0),] > 0.99
    assert probabilities({"a": one, "b": other})[()] > 0.9


def test_an_effect_of_the_tool_stays_with_its_recording():
    with_tool = [
        fit(),
        fit("tool_scale", nat=9.0),
        fit("gravity", nat=SMALL),
        fit("gravity", "tool_scale", nat=9.0 + SMALL),
    ]
    found = joint_hypotheses({"a": with_tool, "b": [fit(), fit("gravity", nat=SMALL)]}, PRIOR)
    best = found[0]
    assert best.names == ("gravity",)
    assert best.fits["a"].own == (("tool_scale", 0),) and best.fits["b"].own == ()
    nothing = next(one for one in found if not one.shared)
    assert nothing.fits["a"].own == (("tool_scale", 0),)


def test_a_remainder_of_one_recording_is_one_of_all():
    found = joint_hypotheses({"a": [fit(larger=0.9)], "b": [fit()]}, PRIOR)
    assert decide_jointly(found, PRIOR).kind == "unexplained"


def test_only_sets_that_may_be_likely_are_fitted_where_they_lack():
    """Where gravity was fitted to both and leads by 8 nat, stretch alone is out of reach, unless b speaks for it."""
    recordings = {"a": [fit(), fit("gravity", nat=8.0), fit("stretch", nat=4.0), fit("poisson")], "b": [fit()]}
    none: dict[str, dict] = {"a": {}, "b": {}}
    assert within_reach(recordings, none, PRIOR) == [(("gravity", 0),), (("stretch", 0),)]
    recordings["b"].append(fit("gravity", nat=0.0))
    recordings["a"].append(fit("gravity", "stretch", nat=12.0))
    assert within_reach(recordings, none, PRIOR) == [(("gravity", 0), ("stretch", 0))]
    speaks = {"a": {}, "b": {("stretch", 0): 4.0 / POWER}}
    assert (("stretch", 0),) in within_reach(recordings, speaks, PRIOR)


def test_an_effect_that_no_recording_was_fitted_with_is_in_reach_by_its_scores():
    """Its prior, and that of one of nine sites, is against it; three recordings may outweigh that."""
    recordings = {name: [fit()] for name in "abc"}
    against = np.log(2 * LIBRARY) - 3.0
    for share, expected in ((1.05, [(("poisson", 0),)]), (0.95, [])):
        scores = {name: {("poisson", 0): share * against / POWER / 3} for name in "abc"}
        assert within_reach(recordings, scores, PRIOR) == expected
    at_site = {name: {("inclusion", 4): (against + np.log(9) + 0.1) / POWER / 3} for name in "abc"}
    assert within_reach(recordings, at_site, PRIOR) == [(("inclusion", 4),)]
    elsewhere = at_site | {"c": {("inclusion", 5): 9.0}}
    assert within_reach(recordings, elsewhere, PRIOR) == []


def test_a_score_is_not_counted_beside_what_explains_the_same():
    """In b the tool explains 20 nat, and without it gravity has a score of 20: beside the tool it may have nothing."""
    recordings = {"a": [fit(), fit("stretch", nat=6.0)], "b": [fit(), fit("tool_scale", nat=20.0)]}
    recordings["b"].append(fit("stretch", "tool_scale", nat=26.0))
    scores = {"a": {}, "b": {("gravity", 0): 20.0 / POWER}}
    assert within_reach(recordings, scores, PRIOR) == []
    recordings["b"] = [one for one in recordings["b"] if not one.own] + [fit("stretch", nat=6.0)]
    assert within_reach(recordings, scores, PRIOR) == [(("gravity", 0),)]


def test_four_effects_are_not_shared():
    recordings = {"a": [fit(), fit(*TISSUE, nat=50.0)], "b": [fit()]}
    assert within_reach(recordings, {"a": {}, "b": {}}, PRIOR) == []


def test_the_parameters_without_each_recording_are_those_of_the_others():
    recordings = {name: [fit(), fit("gravity", nat=9.0, theta=theta)] for name, theta in (("a", 0.3), ("b", 0.4))}
    best = joint_hypotheses(recordings, PRIOR)[0]
    without = without_each(best, PRIOR)
    assert without["a"].theta[0] == pytest.approx(0.4) and without["b"].theta[0] == pytest.approx(0.3)
    assert without_each(joint_hypotheses({"a": recordings["a"]}, PRIOR)[0], PRIOR) == {}
