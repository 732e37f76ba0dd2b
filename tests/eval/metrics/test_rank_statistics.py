"""Rank statistics: a conjugate Gaussian model, whose posterior is exact, too narrow, too wide or off."""

import numpy as np
import pytest
from scipy.stats import binom

from jiggle_mj.eval.metrics.rank_statistics import (
    BAND_LEVEL,
    CURVE_LEVEL,
    DRAWS,
    Ranked,
    RankStatistics,
    curve_band,
    n_bins,
    rank_statistics,
    ranked,
    ranked_by_normal,
    ranked_by_probability,
)

TRUTHS = 300
NOISE = 0.5
"""Standard deviation of the measurement of a standard normal truth."""
SEEDS = 200
"""Studies from which the rate of false alarms is counted."""


def conjugate(seed: int, *, width: float = 1.0, shift: float = 0.0, by_draws: bool = True) -> RankStatistics:
    """Return the statistics of x ~ N(0, 1), y ~ N(x, NOISE^2), with a posterior `width` times as wide and off by
    `shift` of its sd."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(TRUTHS):
        truth = rng.normal()
        y, variance = truth + NOISE * rng.normal(), 1 / (1 + NOISE**-2)
        mean, sd = variance * y * NOISE**-2 + shift * np.sqrt(variance), width * np.sqrt(variance)
        by_normal = ranked_by_normal(truth, mean=mean, sd=sd)
        found.append(ranked(truth, mean + sd * rng.normal(size=DRAWS), rng) if by_draws else by_normal)
    return rank_statistics(found)


@pytest.mark.parametrize("by_draws", [True, False])
def test_an_exact_posterior_gives_uniform_ranks(by_draws):
    """At the levels of the bands; the median size of 300 normal errors has a standard error of 0.07."""
    found = conjugate(0, by_draws=by_draws)
    assert found.uniform and found.p_value > 1 - BAND_LEVEL
    assert found.coverage_band[0] <= found.coverage <= found.coverage_band[1]
    assert found.mean_rank_band[0] <= found.mean_rank <= found.mean_rank_band[1]
    assert found.error_ratio == pytest.approx(1, abs=0.25)


@pytest.mark.parametrize(("width", "ratio"), [(0.5, 2.0), (2.0, 0.5)])
def test_a_posterior_of_another_width_is_found(width, ratio):
    found = conjugate(0, width=width)
    assert not found.uniform and found.p_value < 1e-6
    assert found.error_ratio == pytest.approx(ratio, rel=0.3)
    outside = found.histogram[0] + found.histogram[-1]
    assert (outside > 2 * found.band[1]) == (width < 1)
    assert not found.coverage_band[0] <= found.coverage <= found.coverage_band[1]


def test_a_posterior_that_is_off_is_found_with_its_sign():
    found = conjugate(0, shift=-0.5)
    assert not found.uniform and found.p_value < 1e-6
    assert found.error_in_sd == pytest.approx(-0.5, abs=4 / np.sqrt(TRUTHS))
    assert found.mean_rank > found.mean_rank_band[1]


def test_the_band_of_the_whole_curve_raises_as_many_false_alarms_as_it_states():
    """The number of alarms is binomial; its own 99.9 % interval."""
    rng = np.random.default_rng(1)
    alarms = 0
    for _ in range(SEEDS):
        ranks = rng.integers(DRAWS + 1, size=TRUTHS)
        alarms += not rank_statistics([Ranked(rank=int(rank), truth=1.0, mean=1.0, sd=1.0) for rank in ranks]).uniform
    low, high = binom.interval(0.999, SEEDS, 1 - CURVE_LEVEL)
    assert low <= alarms <= high


def test_the_band_holds_the_mean_and_is_narrow_at_the_ends():
    """The band of Dvoretzky, Kiefer and Wolfowitz for the same level is as wide at the ends as in the middle."""
    low, high = curve_band(TRUTHS)
    expected = TRUTHS * np.arange(1, DRAWS + 2) / (DRAWS + 1)
    assert (low <= expected).all() and (expected <= high).all()
    even = np.sqrt(TRUTHS * np.log(2 / (1 - CURVE_LEVEL)) / 2)
    assert high[0] < expected[0] + even / 2 and low[-2] > expected[-2] - even / 2
    assert low[-1] == high[-1] == TRUTHS


def test_ties_are_broken_at_random_and_a_point_mass_covers_its_ranks():
    rng = np.random.default_rng(2)
    draws = np.repeat([0.0, 1.0], [60, DRAWS - 60])
    ranks = [ranked(0.0, draws, rng).rank for _ in range(2000)]
    assert min(ranks) == 0 and max(ranks) == 60
    ends = [ranked_by_probability(0.0, 0.0, 0.6, mean=0.4, sd=0.5, u=u).rank for u in (0.0, 0.999)]
    assert ends == [0, 59]
    assert ranked_by_probability(2.0, 1.0, 0.0, mean=0.4, sd=0.5, u=0.0).rank == DRAWS


def test_few_truths_have_few_bins():
    assert [n_bins(n) for n in (9, 10, 24, 25, 50, 1000)] == [1, 2, 4, 5, 10, 10]


def test_wrong_numbers_of_draws_are_refused():
    with pytest.raises(ValueError, match="ranked takes 99 draws; got 3"):
        ranked(0.0, np.zeros(3), np.random.default_rng(0))
    with pytest.raises(ValueError, match="at least one rank"):
        rank_statistics([])
