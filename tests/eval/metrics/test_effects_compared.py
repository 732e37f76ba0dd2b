"""Sizes of an effect in several recordings: their common size against least squares, and when they are compared."""

import numpy as np
import pytest

from jiggle_mj.eval.metrics.effects_compared import MIN_P_VALUE, common_size, effects_compared
from tests.support.closed_loops import discrepancy, effect

DRAWS = 4000
"""Drawn sets of recordings; the share that is said to differ then has a standard deviation of 0.0034."""


def test_the_common_size_is_that_of_weighted_least_squares():
    """`numpy.polyfit` of degree 0 with weights 1/s; its unscaled covariance is the variance of the mean."""
    sizes, sds = [0.5, 0.7, 0.62, 0.8], [0.1, 0.05, 0.2, 0.08]
    (mean,), covariance = np.polyfit(range(4), sizes, 0, w=1 / np.array(sds), cov="unscaled")
    found = common_size(sizes, sds)
    assert found is not None
    assert (found.mean, found.sd) == pytest.approx((mean, covariance[0, 0] ** 0.5))


def test_the_p_value_of_two_sizes_is_that_of_their_difference():
    """Q of two is the square of their difference over its standard deviation, and chi-square of one degree |normal|."""
    from scipy.stats import norm

    found = common_size([1.0, 1.6], [0.3, 0.4])
    assert found is not None
    assert found.p_value == pytest.approx(2 * norm.sf(0.6 / 0.5))


def test_equal_sizes_are_said_to_differ_as_often_as_the_level_says():
    draw, sds = np.random.default_rng(0), [0.1, 0.3, 0.2]
    found = [common_size(draw.normal(2.0, sds).tolist(), sds) for _ in range(DRAWS)]
    differing = np.mean([one is not None and one.p_value < MIN_P_VALUE for one in found])
    assert differing == pytest.approx(MIN_P_VALUE, abs=4 * 0.0034)


@pytest.mark.parametrize(
    ("sizes", "sds"), [([1.0], [0.1]), ([1.0, 2.0], [0.1, 0.0]), ([1.0, np.nan], [0.1, 0.1]), ([1, 2], [np.inf, 1])]
)
def test_what_has_no_common_size(sizes, sds):
    assert common_size(sizes, sds) is None


def test_an_effect_of_several_recordings_is_compared_over_all_its_parameters():
    """The second parameter differs by 5 of its standard deviations; Bonferroni doubles its p-value."""
    found = {
        "a": discrepancy(effect("bed", [0.001, 0.5], [0.001, 0.1])),
        "b": discrepancy(effect("bed", [0.001, 1.0], [0.001, 1e-6]), effect("gravity", [0.7], [0.1])),
        "c": discrepancy(ambiguous_with=["gravity"]),
    }
    bed, gravity = effects_compared(found)
    alone = common_size([0.5, 1.0], [0.1, 1e-6])
    assert alone is not None
    assert bed["p_value"] == pytest.approx(2 * alone.p_value) and bed["agree"] is False
    assert bed["mean"] == pytest.approx([0.001, 1.0])
    assert [one["recording"] for one in bed["found"]] == ["a", "b"]
    assert gravity["ambiguous_in"] == ["c"] and gravity["agree"] is None and gravity["mean"] is None


def test_sizes_at_different_sites_are_compared_only_where_sites_differ_in_their_prior_alone():
    found = {
        "a": discrepancy(effect("inclusion", [1.0], [0.1], site=3)),
        "b": discrepancy(effect("inclusion", [1.0], [0.1], site=4)),
    }
    (apart,), (alike,) = effects_compared(found), effects_compared(found, same_at_sites=("inclusion",))
    assert apart["same_site"] is False and apart["agree"] is None
    assert alike["same_site"] is True and alike["agree"] is True and alike["p_value"] == pytest.approx(1.0)
