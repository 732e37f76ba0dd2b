"""Rank statistics of simulation-based calibration: where the truth lies among draws of its posterior.

Draw a truth from the prior, data from the truth, and L draws from the posterior of these data. If the posterior is
right, the rank of the truth among the draws is uniform on 0..L [Talts et al. 2018, arXiv:1804.06788]. Too many low and
high ranks mean a posterior that is too narrow; too many high ranks, one that is too low.

Uniformity is judged by Pearson's chi2 over bins, each of which has a binomial band of its own, and by the largest
deviation of the empirical distribution function, in a band that holds for all its points together [Säilynoja, Bürkner &
Vehtari 2022, doi:10.1007/s11222-022-10090-6].
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float, Int
from scipy.stats import binom, chi2, norm

DRAWS = 99
"""Draws of the posterior, L: 100 ranks, which 5, 10 and 20 bins divide evenly."""
BINS = 10
"""Most bins of a histogram of ranks."""
MIN_EXPECTED = 5
"""Fewest ranks that a bin should expect, so that chi2 follows its distribution [Cochran 1954, doi:10.2307/3001616]."""
BAND_LEVEL = 0.99
"""Probability of the band of each bin, as in the source."""
CURVE_LEVEL = 0.95
"""Probability that a uniform sample's whole distribution function lies within its band."""
CURVE_SIMULATIONS = 4000
"""Uniform samples from which that band is found; its level then errs by 0.004."""
INTERVAL = (5, 94)
"""Lowest and highest of 0..99 ranks within the central 90 % interval of the draws."""


@dataclass(frozen=True, kw_only=True)
class Ranked:
    """One truth and its posterior."""

    rank: int
    """Number of posterior draws below the truth, in 0..DRAWS; ties are broken at random."""
    truth: float
    mean: float
    """Mean of the posterior."""
    sd: float
    """Standard deviation of the posterior."""


@dataclass(frozen=True, kw_only=True)
class RankStatistics:
    """Figures of the ranks of one quantity over many truths."""

    count: int
    """Number of truths."""
    histogram: tuple[int, ...]
    """Number of ranks in each of equal bins."""
    band: tuple[int, int]
    """Range of that number in one bin, with a probability of `BAND_LEVEL`."""
    p_value: float
    """Probability that uniform ranks have as large a chi2 over the bins."""
    deviation: tuple[float, ...]
    """Share of the ranks up to each of 0..DRAWS, less the share of uniform ranks."""
    curve_band: tuple[tuple[float, ...], tuple[float, ...]]
    """Lower and upper end of that deviation, with a probability of `CURVE_LEVEL` for all together."""
    coverage: float
    """Share of the truths within the central 90 % interval."""
    coverage_band: tuple[float, float]
    """Range of that share for a right posterior, with a probability of `BAND_LEVEL`."""
    mean_rank: float
    """Mean share of the posterior that lies below the truth [1]: above 1/2 the posterior is too low."""
    mean_rank_band: tuple[float, float]
    """Range of that mean for uniform ranks, with a probability of `BAND_LEVEL`."""
    error_in_sd: float
    """Median of (posterior mean - truth) / posterior sd [1]; NaN where every sd is 0."""
    error_ratio: float
    """Median size of that over its median for a normal posterior that is right [1]; above 1 errors are larger than the
    sd says. Medians, as an sd of a particle that is nearly surely free is nearly 0."""
    share_of_truth: float
    """Sum of the posterior means over the sum of the truths [1]; NaN where the truths sum to 0."""

    @property
    def uniform(self) -> bool:
        """Return whether the whole distribution function lies within its band."""
        low, high = self.curve_band
        return all(a <= d <= b for a, d, b in zip(low, self.deviation, high, strict=True))


def ranked(truth: float, draws: Float[np.ndarray, " _draws"], rng: np.random.Generator) -> Ranked:
    """Return the rank of a truth among `DRAWS` draws; where draws equal it, any place among them is as likely."""
    if len(draws) != DRAWS:
        raise ValueError(f"ranked takes {DRAWS} draws; got {len(draws)}.")
    below, equal = int(np.sum(draws < truth)), int(np.sum(draws == truth))
    return Ranked(
        rank=below + int(rng.integers(equal + 1)), truth=truth, mean=float(np.mean(draws)), sd=float(np.std(draws))
    )


def ranked_by_probability(truth: float, below: float, at: float, *, mean: float, sd: float, u: float) -> Ranked:
    """Return the rank that corresponds to a distribution function, instead of draws.

    Args:
        truth: the truth.
        below: probability of less than the truth.
        at: probability of the truth itself, where it is a point mass; 0 for a density.
        mean: of the posterior.
        sd: of the posterior.
        u: uniform number in [0, 1), which chooses a place within the point mass.
    """
    place = min(below + u * at, np.nextafter(1, 0))
    return Ranked(rank=int(place * (DRAWS + 1)), truth=truth, mean=mean, sd=sd)


def ranked_by_normal(truth: float, *, mean: float, sd: float) -> Ranked:
    """Return the rank that corresponds to a normal posterior."""
    return ranked_by_probability(truth, float(norm.cdf(truth, mean, sd)), 0.0, mean=mean, sd=sd, u=0.0)


def rank_statistics(found: Sequence[Ranked]) -> RankStatistics:
    """Return the figures of one quantity over truths that were drawn independently.

    Raises:
        ValueError: there are no ranks.
    """
    if not found:
        raise ValueError("rank_statistics takes at least one rank; got none.")
    ranks, n = np.array([each.rank for each in found]), len(found)
    bins = n_bins(n)
    histogram = np.bincount(ranks * bins // (DRAWS + 1), minlength=bins)
    low, high = binom.interval(BAND_LEVEL, n, 1 / bins)
    excess = float(np.sum((histogram - n / bins) ** 2) * bins / n)
    points = np.arange(1, DRAWS + 2) / (DRAWS + 1)
    reached = np.cumsum(np.bincount(ranks, minlength=DRAWS + 1)) / n
    covered = binom.interval(BAND_LEVEL, n, (INTERVAL[1] - INTERVAL[0] + 1) / (DRAWS + 1))
    truth, mean, sd = (np.array([getattr(each, name) for each in found]) for name in ("truth", "mean", "sd"))
    error = (mean - truth)[sd > 0] / sd[sd > 0]
    lean = float(norm.ppf((1 + BAND_LEVEL) / 2) / np.sqrt(12 * n))
    lower, upper = (end / n - points for end in curve_band(n))
    return RankStatistics(
        count=n,
        histogram=tuple(histogram.tolist()),
        band=(int(low), int(high)),
        p_value=float(chi2.sf(excess, bins - 1)) if bins > 1 else 1.0,
        deviation=tuple((reached - points).tolist()),
        curve_band=(tuple(lower.tolist()), tuple(upper.tolist())),
        coverage=float(np.mean((ranks >= INTERVAL[0]) & (ranks <= INTERVAL[1]))),
        coverage_band=(float(covered[0] / n), float(covered[1] / n)),
        mean_rank=float(np.mean(ranks + 0.5)) / (DRAWS + 1),
        mean_rank_band=(0.5 - lean, 0.5 + lean),
        error_in_sd=float(np.median(error)) if len(error) else float("nan"),
        error_ratio=float(np.median(np.abs(error)) / norm.ppf(0.75)) if len(error) else float("nan"),
        share_of_truth=float(mean.sum() / truth.sum()) if truth.sum() else float("nan"),
    )


def n_bins(n: int) -> int:
    """Return the number of bins for n ranks: `BINS`, or fewer that divide the ranks evenly and expect enough each."""
    return next((bins for bins in (BINS, 5, 4, 2) if n / bins >= MIN_EXPECTED), 1)


@cache
def curve_band(n: int) -> tuple[Int[np.ndarray, " _points"], Int[np.ndarray, " _points"]]:
    """Return the lowest and highest number of n uniform ranks up to each of 0..DRAWS, for all together.

    The number up to each rank is binomial. Its interval is at a level gamma that is the same at each point. gamma is
    the level that a share `CURVE_LEVEL` of uniform samples keep at every point, found by simulation (section 2.2 of
    the source).
    """
    points = np.arange(1, DRAWS + 2) / (DRAWS + 1)
    rng = np.random.default_rng(0)
    simulated = np.array([
        np.cumsum(np.bincount(rng.integers(DRAWS + 1, size=n), minlength=DRAWS + 1)) for _ in range(CURVE_SIMULATIONS)
    ])  # fmt: skip
    tails = 2 * np.minimum(binom.cdf(simulated, n, points), binom.sf(simulated - 1, n, points))
    gamma = float(np.quantile(tails.min(axis=1), 1 - CURVE_LEVEL))
    low, high = binom.ppf(gamma / 2, n, points), binom.ppf(1 - gamma / 2, n, points)
    return low.astype(int), high.astype(int)
