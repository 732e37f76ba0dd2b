"""Verdicts from made-up evidences, against sums by hand."""

import numpy as np
import pytest

from jiggle_mj.estimator.attribution.verdict import POWER, HypothesisEvidence, decide, log_prior

LIBRARY = 10
"""Number of effects that were tested."""


def evidence(*effects: str, nat: float, sites: int = 1, larger: float = 0.0) -> HypothesisEvidence:
    """Return the evidence of a hypothesis, above that of nothing by some nat after the power."""
    return HypothesisEvidence(effects=effects, log_evidence=nat / POWER, sites=sites, larger_errors=larger)


def test_prior_probabilities_sum_to_one_over_all_sets_and_sites():
    """A half, a quarter, an eighth: what is left is that of larger sets."""
    single = 10 * 3 * np.exp(log_prior(1, 3, LIBRARY))
    pairs = 45 * np.exp(log_prior(2, 1, LIBRARY))
    assert np.exp(log_prior(0, 1, LIBRARY)) == pytest.approx(0.5)
    assert single == pytest.approx(0.25) and pairs == pytest.approx(0.125)


def test_probabilities_follow_prior_and_evidence():
    """With as much evidence, nothing is 20 times as likely as one of ten effects."""
    found = decide([evidence(nat=0.0), evidence("gravity", nat=0.0)], LIBRARY)
    np.testing.assert_allclose(found.probabilities, [20 / 21, 1 / 21])
    assert found.kind == "no-effect" and found.best == 0
    found = decide([evidence(nat=0.0), evidence("point_pull", nat=np.log(20 * 4), sites=4)], LIBRARY)
    np.testing.assert_allclose(found.probabilities, [0.5, 0.5])


@pytest.mark.parametrize(
    ("leads", "kind", "rivals"),
    [
        ((10.0, 2.0), "effect", []),
        ((10.0, 9.0), "ambiguous", [2]),
        ((1.0, 0.0), "no-effect", []),
        ((4.0, 0.0), "ambiguous", [0]),  # nothing at all is a rival too
    ],
)
def test_one_is_named_alone_only_with_its_probability(leads, kind, rivals):
    first, second = leads
    found = decide([evidence(nat=0.0), evidence("gravity", nat=first), evidence("stretch", nat=second)], LIBRARY)
    assert found.kind == kind and list(found.rivals) == rivals


def test_an_effect_with_and_without_another_one_is_certain():
    """Neither gravity alone nor gravity and friction have 0.95, but together they do."""
    some = [evidence("gravity", nat=9.0), evidence("gravity", "friction", nat=11.0), evidence("bed", nat=4.0)]
    found = decide(some, LIBRARY)
    assert found.probabilities.max() < 0.95 and found.kind == "effect" and found.rivals == ()
    both = decide([*some[:2], evidence("bed", nat=9.0)], LIBRARY)
    assert both.kind == "ambiguous" and both.rivals == (2,)


def test_larger_errors_are_a_residual_without_a_name():
    nothing, one = evidence(nat=0.0, larger=0.9), evidence("gravity", nat=20.0, larger=0.2)
    assert decide([nothing], LIBRARY).kind == "unexplained"
    assert decide([nothing, one], LIBRARY).kind == "effect"
    assert decide([nothing, evidence("gravity", nat=20.0, larger=0.6)], LIBRARY).kind == "effect-with-remainder"


def test_the_order_of_hypotheses_does_not_matter():
    some = [evidence(nat=0.0), evidence("gravity", nat=6.0), evidence("stretch", nat=5.0), evidence("bed", nat=2.0)]
    forwards, backwards = decide(some, LIBRARY), decide(some[::-1], LIBRARY)
    np.testing.assert_allclose(forwards.probabilities, backwards.probabilities[::-1])
    assert [some[k].effects for k in forwards.rivals] == [some[::-1][k].effects for k in backwards.rivals]


def test_a_hypothesis_without_finite_evidence_has_no_probability():
    found = decide([evidence(nat=0.0), evidence("gravity", nat=np.nan)], LIBRARY)
    np.testing.assert_array_equal(found.probabilities, [1.0, 0.0])
    with pytest.raises(ValueError, match="finite evidence"):
        decide([evidence("gravity", nat=np.nan)], LIBRARY)
