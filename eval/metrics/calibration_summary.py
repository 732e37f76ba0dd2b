"""What simulation-based calibration found: rank statistics of each quantity, and the reliability of P(attached)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from .calibration import N_BINS, Bin, expected_calibration_error, reliability
from .rank_statistics import CURVE_LEVEL, Ranked, RankStatistics, rank_statistics

METHODS = {"draws": "joint draws of the sampler", "belief": "what the belief states"}
"""Posteriors that are ranked, and what they are in words."""
REFERENCES = {
    "assumed": "our own engine with the errors that the filter assumes",
    "exact": "our own engine without errors of forces",
    "mujoco": "the MuJoCo reference",
}
"""References that make the data, in words."""
RESAMPLES = 400
"""Resamples of the draws for the standard deviation of a reliability; its own error is then 4 %."""


@dataclass(frozen=True, kw_only=True)
class CalibrationDraw:
    """The ranks of one truth that was drawn from the prior, and how its estimate scores."""

    draws: Mapping[str, Ranked]
    """Rank of each quantity among joint draws of the posterior."""
    belief: Mapping[str, Ranked]
    """Rank of each quantity by what the belief states."""
    probability: Sequence[float]
    """P(attached) of each particle."""
    attached: Sequence[bool]
    """Which particles are attached."""
    coverage: float | None
    """Share of the particles whose b lies in its published interval."""
    coverage_attached: float | None
    """The same share among the attached; None where there are none."""
    nees_attached: float | None
    """NEES per degree of freedom of the attached; None where there are none."""
    force_sd_ratio: float | None
    """Learned over assumed standard deviation of the force error."""
    converged: bool
    """Whether both halves of the samples agreed."""


@dataclass(frozen=True, kw_only=True)
class ReliabilityBin:
    """A bin of P(attached) over all draws."""

    bin: Bin
    sd: float
    """Standard deviation of share attached less probability, by resampling whole draws: particles of one sheet are
    attached together."""


@dataclass(frozen=True, kw_only=True)
class ReferenceSummary:
    """What the draws by one reference give."""

    name: str
    count: int
    """Number of draws."""
    ranks: Mapping[str, Mapping[str, RankStatistics]]
    """Statistics of each quantity, by method."""
    reliability: tuple[ReliabilityBin, ...]
    ece: float
    """Expected calibration error of P(attached) over the particles of all draws."""
    ece_single: float
    """Mean of the expected calibration errors of single draws."""
    ece_nothing: float | None
    """The same mean where nothing is attached; None where that was never drawn."""
    nothing: int
    """Number of draws without any attachment."""
    coverage: float
    """Mean share of particles whose b lies in its published 90 % interval."""
    coverage_attached: float | None
    """Share of the attached particles of all draws whose b lies in it."""
    nees_attached: float | None
    """Median over the draws of the NEES per degree of freedom of the attached."""
    disagreed: int
    """Number of draws in which both halves of the samples disagreed."""

    def sentences(self) -> list[str]:
        """Return what was found, the sum of b first."""
        where = REFERENCES.get(self.name, self.name)
        found = []
        for method, by_name in self.ranks.items():
            outside = [name for name, stats in by_name.items() if not stats.uniform]
            words = f"By {where}, {METHODS[method]}: {described('the sum of b', by_name['sum of b'])}; "
            words += f"{len(outside)} of {len(by_name)} rank distributions leave their {100 * CURVE_LEVEL:.0f} % band"
            found.append(words + (f": {', '.join(outside)}." if outside else "."))
        words = f"By {where}: P(attached) errs by {self.ece:.3f} (ECE over {self.count} draws)"
        if self.ece_nothing is not None:
            words += f", by {self.ece_nothing:.3f} in the {self.nothing} draws where nothing is attached"
        if self.coverage_attached is not None:
            words += f"; the published 90 % intervals hold {self.coverage_attached:.2f} of the attached"
        return [*found, words + "."]


def described(what: str, stats: RankStatistics) -> str:
    """Return in words how a quantity comes out, and whether its intervals hold."""
    low, high = stats.mean_rank_band
    words = f"{what} comes out neither low nor high"
    if not low <= stats.mean_rank <= high:
        too_low, share = stats.mean_rank > high, stats.share_of_truth
        words = f"{what} comes out {'low' if too_low else 'high'}"
        if np.isfinite(share) and (share < 1) == too_low:
            words += f" by {100 * abs(share - 1):.0f} %"
        words += f" ({100 * stats.mean_rank:.0f} % of its posterior lie below the truth, {stats.error_in_sd:+.1f} sd)"
    low, high = stats.coverage_band
    if low <= stats.coverage <= high:
        return words
    width = "too narrow" if stats.coverage < low else "too wide"
    return f"{words}, and its 90 % interval is {width}: it holds {100 * stats.coverage:.0f} %"


def headline(summaries: Sequence[ReferenceSummary]) -> str:
    """Return the first line: whether the belief is calibrated, and what is farthest from it."""
    every = [
        (stats.p_value, summary, name, stats)
        for summary in summaries
        for by_name in summary.ranks.values()
        for name, stats in by_name.items()
    ]
    if not every:
        return "No truth was drawn."
    outside = sum(not stats.uniform for *_, stats in every)
    expected = (1 - CURVE_LEVEL) * len(every)
    counts = f"{outside} of {len(every)} rank distributions leave their band, where {expected:.0f} would by chance"
    _, summary, name, stats = min(every, key=lambda each: each[0])
    worst = f"by {REFERENCES.get(summary.name, summary.name)}, {described(name, stats)}"
    return f"{'Not calibrated' if outside > 2 * expected + 1 else 'Calibrated'}: {counts}. Farthest off: {worst}."


def summarised(draws: Mapping[str, Sequence[CalibrationDraw]]) -> list[ReferenceSummary]:
    """Return the summary of each reference's draws."""
    return [_summary(name, found) for name, found in draws.items()]


def _summary(name: str, found: Sequence[CalibrationDraw]) -> ReferenceSummary:
    probability, attached = ([np.array(getattr(draw, key)) for draw in found] for key in ("probability", "attached"))
    pooled = np.concatenate(probability), np.concatenate(attached)
    single = [expected_calibration_error(p, a) for p, a in zip(probability, attached, strict=True)]
    empty = [error for error, a in zip(single, attached, strict=True) if not a.any()]
    held = [draw.coverage_attached * a.sum() for draw, a in zip(found, attached, strict=True) if draw.coverage_attached]
    n_attached = sum(int(a.sum()) for a in attached)
    nees = [draw.nees_attached for draw in found if draw.nees_attached is not None]
    return ReferenceSummary(
        name=name,
        count=len(found),
        ranks={
            method: {quantity: rank_statistics([getattr(draw, method)[quantity] for draw in found])
                     for quantity in getattr(found[0], method)}
            for method in METHODS
        },
        reliability=_reliability(probability, attached),
        ece=expected_calibration_error(*pooled),
        ece_single=float(np.mean(single)),
        ece_nothing=float(np.mean(empty)) if empty else None,
        nothing=len(empty),
        coverage=float(np.mean([draw.coverage for draw in found if draw.coverage is not None])),
        coverage_attached=float(sum(held) / n_attached) if n_attached else None,
        nees_attached=float(np.median(nees)) if nees else None,
        disagreed=sum(not draw.converged for draw in found),
    )  # fmt: skip


def _reliability(probability: list[np.ndarray], attached: list[np.ndarray]) -> tuple[ReliabilityBin, ...]:
    """Return the reliability over all draws, with the spread of each bin between draws."""
    excess, count = (np.zeros((len(probability), N_BINS)) for _ in range(2))
    for k, (p, a) in enumerate(zip(probability, attached, strict=True)):
        bin_of = np.minimum((p * N_BINS).astype(int), N_BINS - 1)
        count[k] = np.bincount(bin_of, minlength=N_BINS)
        excess[k] = np.bincount(bin_of, weights=a - p, minlength=N_BINS)
    chosen = np.random.default_rng(0).multinomial(len(count), np.full(len(count), 1 / len(count)), size=RESAMPLES)
    sd = np.std(chosen @ excess / np.maximum(chosen @ count, 1), axis=0)
    bins = reliability(np.concatenate(probability), np.concatenate(attached))
    return tuple(ReliabilityBin(bin=each, sd=float(sd[round(each.low * N_BINS)])) for each in bins)
