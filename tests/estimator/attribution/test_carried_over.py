"""What is added after the evidences have decided, and what is reported of it, by made-up numbers."""

from dataclasses import replace
from typing import Any
from unittest.mock import ANY

import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.errors import RecordingError
from jiggle_mj.estimator.attribution.close_loop import Closed, check_finite, jackknife_sd, upheld
from jiggle_mj.estimator.attribution.discrepancy import refused, reported_sd
from jiggle_mj.estimator.attribution.held_out import HeldOut, Variances
from jiggle_mj.estimator.attribution.hypotheses import Hypothesis
from jiggle_mj.estimator.attribution.linear import NormalEquations
from jiggle_mj.estimator.attribution.remainder import FittedRemainder
from tests.support.made_up_hypotheses import hypothesis
from tests.support.small_fit import small_fit, small_problem


def held_out(*errors_mm: float) -> list[HeldOut]:
    """Return the predictions of parts with the given errors."""
    return [
        HeldOut(
            residual=np.array([[1e-3 * error, 0.0, 0.0]]),
            compute_variances=lambda: Variances(fit=np.zeros((1, 3)), others=np.ones((1, 3))),
        )
        for error in errors_mm
    ]


def closed(final: Hypothesis, **others: Any) -> Closed:
    """Return a closed loop that ended with a hypothesis."""
    nothing = FittedRemainder(mean=np.zeros((0, 1, 3)), variance=np.zeros((0, 1)), variances={}, degrees=10.0)
    known: dict[str, Any] = {
        "verdict": "effect",
        "declared": hypothesis(),
        "rivals": [],
        "hypotheses": [(final, 1.0)],
        "dropped": {},
        "folds": ([], []),
        "sds": np.zeros(1),
        "reported": None,
        "remainder": nothing,
        "with_remainder": None,
        "problem": small_problem(),
    }
    return Closed(final=final, **(known | others))


def test_effects_that_predict_the_reported_part_worse_are_taken_out_again():
    """Two effects: the first improves the part that chose none from 4.8 to 4.0 mm, the second makes it 6.6 mm."""
    path = hypothesis("gravity", "bed").path
    assert [one.names for one in path] == [(), ("gravity",), ("gravity", "bed")]
    kept, predicted, dropped = upheld(path, held_out(4.8, 4.0, 6.6))
    assert kept == path[:2] and [1e3 * one.rms for one in predicted] == pytest.approx([4.8, 4.0])
    assert list(dropped) == ["bed"]
    assert dropped["bed"].endswith("predicted to 6.60 mm with it and 4.00 mm without")
    assert upheld(path, held_out(4.8, 4.0, 4.1))[0] == path[:2]
    assert upheld(path, held_out(4.8, 4.9, 6.6))[0] == path[:1]
    assert upheld(path, held_out(4.8, 4.9, 4.7)) == (path, ANY, {})
    assert upheld(path, []) == (path, [], {})


def test_an_effect_whose_size_is_as_large_as_it_may_be_is_taken_out_with_what_is_found_beside_it():
    """Both predict the reported part better; the size of the second one is at its bound of four prior sd."""
    path = hypothesis("gravity", "bed").path
    assert [one.at_bound for one in path] == [(), (), ()]
    path[2] = at_bound(path[2], "bed")
    kept, _, dropped = upheld(path, held_out(4.8, 4.0, 3.0))
    assert kept == path[:2] and list(dropped) == ["bed"] and "as large as it may be" in dropped["bed"]
    assert upheld(path, [])[0] == path[:2]
    path[1] = at_bound(path[1], "gravity")
    kept, _, dropped = upheld(path, held_out(4.8, 4.0, 3.0))
    assert kept == path[:1] and dropped["gravity"] == "it is found beside bed, of the largest size that may be"


def at_bound(one: Hypothesis, name: str) -> Hypothesis:
    """Return a hypothesis with an effect that alone has a parameter at its bound."""
    fitted = one.fitted
    at = np.array([1])
    theta = np.zeros(len(fitted.problem.prior_sd))
    theta[at] = -4 * fitted.problem.prior_sd[at]
    there = replace(fitted, point=replace(fitted.point, theta=theta))
    added = tuple(replace(each, at=at if each.effect.name == name else np.array([0])) for each in one.added)
    return replace(one, added=added, fits=one.fits._replace(likeliest=there))


def test_the_force_decides_whether_its_scale_carries_over():
    path = hypothesis("force_scale").path
    assert upheld(path, held_out(4.8, 4.9), [0.02, 0.01])[0] == path
    assert upheld(path, held_out(4.8, 4.7), [0.02, 0.03])[0] == path[:1]


def test_each_effect_that_was_fitted_and_is_not_named_has_a_reason():
    best, rival, pair = hypothesis("gravity", nat=9.0), hypothesis("stretch", nat=8.0), hypothesis("gravity", "bed")
    fitted = [(best, 0.6), (rival, 0.3), (pair, 0.1), (hypothesis("bed", nat=2.0), 0.0)]
    found = refused(closed(best, rivals=[rival], dropped={"friction": "it did not carry over"}, hypotheses=fitted))
    assert [one["name"] for one in found] == ["friction", "bed"]
    assert found[1]["why"] == "its probability beside gravity is 0.1; gravity leads by 9 nat"


def test_the_reported_sd_is_that_of_one_part_and_of_the_nuisance_parameter():
    """By hand: twice the standard deviation for four parts, and 0.3 of the nuisance parameter 1 in squares."""
    problem = replace(small_problem(), own=np.array([1, 7]), own_sd=np.array([0.3, 9.0]))
    four = closed(hypothesis(), problem=problem, folds=([], held_out(0.5, 0.5, 0.5, 0.5)))
    sd = reported_sd(four, np.array([0, 1, 2]), np.array([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(sd, [0.2, 0.5, 0.6])


def test_the_jackknife_of_a_mean_is_its_standard_error():
    values = np.random.default_rng(0).normal(size=(7, 2))
    means = [np.delete(values, k, axis=0).mean(axis=0) for k in range(7)]
    np.testing.assert_allclose(jackknife_sd(means, 2), values.std(axis=0, ddof=1) / np.sqrt(7))
    np.testing.assert_array_equal(jackknife_sd([], 2), np.zeros(2))


def test_a_frame_that_the_declared_model_does_not_predict_is_named():
    """The problem's only frame is frame 0, and one of its products is no number."""
    square = np.eye(3)
    check_finite(
        replace(small_fit(), equations={0: NormalEquations(square=jnp.asarray(square), tool=jnp.zeros((3, 1)))})
    )
    square[1, 1] = np.nan
    equations = {0: NormalEquations(square=jnp.asarray(square), tool=jnp.zeros((3, 1)))}
    with pytest.raises(RecordingError, match=r"1 of the 1 frames .* frame 0"):
        check_finite(replace(small_fit(), equations=equations))
