"""Whether the belief's stated uncertainty is honest, against the truth carried to the particles.

The Gaussian before the non-negativity constraint is judged, since that is what the filter propagates. Particles whose
true stiffness is no number (a weld, or attached by an unknown amount) are marginalised out, which for a Gaussian means
dropping their rows and columns; so are those whose variance is not stated (NaN: an estimator without uncertainty).

NEES is the normalised estimation error squared of Bar-Shalom, Li & Kirubarajan, "Estimation with Applications to
Tracking and Navigation" (2001); divided by the degrees of freedom it is 1 on average for an honest belief, above 1 for
an over-confident one.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.special import ndtri

from jiggle_mj.estimate import Belief

LEVEL = 0.90
"""Probability that the intervals are meant to hold."""
BINS = 10
"""Equal bins of probability for the expected calibration error."""


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """None where there is nothing to judge by."""

    nees_per_dof: float | None
    nees_attached: float | None
    """The same over the truly attached particles alone: a free one is exactly where a prior may have its peak."""
    coverage_90: float | None
    """Share of particles whose true stiffness lies in the central 90 % interval of its marginal."""
    coverage_attached: float | None
    """The same among the truly attached alone: an interval from 0 holds every free one."""
    ece: float | None
    """Expected calibration error of the probabilities of being attached."""


@dataclass(frozen=True, kw_only=True)
class Bin:
    """Particles of which about the same probability was said."""

    low: float
    high: float
    count: int
    said: float
    """Mean of their probabilities."""
    attached: float
    """Share of them that is attached."""


def nees_per_dof(
    belief: Belief, stiffness: Float[np.ndarray, " n"], *, among: Bool[np.ndarray, " n"] | None = None
) -> float | None:
    """(b_hat - b*)^T Sigma^-1 (b_hat - b*) / n over the particles whose b* and variance are finite, in float64.

    With `among` only over those, the others marginalised out.

    Raises:
        ValueError: the covariance is not positive definite.
    """
    truth = belief.coordinate(stiffness)
    known = np.isfinite(truth) & np.isfinite(np.diagonal(belief.covariance))
    known = known if among is None else known & among
    if not known.any():
        return None
    error = belief.mean[known].astype(np.float64) - truth[known]
    covariance = belief.covariance[np.ix_(known, known)].astype(np.float64)
    try:
        factor = cho_factor(covariance, lower=True)
    except LinAlgError as failure:
        raise ValueError(
            f"Belief.covariance is not positive definite ({failure}); NEES needs one that is "
            "(was it kept in float32, or never symmetrised?)."
        ) from failure
    return float(error @ cho_solve(factor, error) / known.sum())


def coverage(
    belief: Belief,
    stiffness: Float[np.ndarray, " n"],
    level: float = LEVEL,
    *,
    among: Bool[np.ndarray, " n"] | None = None,
) -> float | None:
    """Share of particles of finite b* and variance with |b_hat - b*| <= z sd, z the two-sided normal quantile.

    Of a belief that states intervals of its own, the share with b* inside; with `among` only over those.
    """
    if belief.lower is not None and belief.upper is not None:
        known, held = ~np.isnan(stiffness), (belief.lower <= stiffness) & (stiffness <= belief.upper)
    else:
        variance = np.diagonal(belief.covariance)
        known = np.isfinite(stiffness) & np.isfinite(variance)
        held = np.abs(belief.mean - stiffness) <= ndtri((1 + level) / 2) * np.sqrt(variance)
    known = known if among is None else known & among
    return float(np.mean(held[known])) if known.any() else None


def expected_calibration_error(probability: Float[np.ndarray, " n"], attached: Bool[np.ndarray, " n"]) -> float:
    """Mean over particles of |share attached - mean probability| of the bin that the particle falls into."""
    bins = reliability(probability, attached)
    return sum(one.count * abs(one.attached - one.said) for one in bins) / len(probability)


def reliability(probability: Float[np.ndarray, " n"], attached: Bool[np.ndarray, " n"]) -> list[Bin]:
    """What happened where a probability was said, in bins that hold a particle.

    A reliability diagram [DeGroot & Fienberg 1983, doi:10.2307/2987588] in numbers.
    """
    bin_of = np.minimum((probability * BINS).astype(int), BINS - 1)
    return [
        Bin(
            low=k / BINS,
            high=(k + 1) / BINS,
            count=int(np.sum(bin_of == k)),
            said=float(probability[bin_of == k].mean()),
            attached=float(attached[bin_of == k].mean()),
        )
        for k in np.unique(bin_of)
    ]


def calibration(
    belief: Belief,
    stiffness: Float[np.ndarray, " n"],
    attached: Bool[np.ndarray, " n"],
    *,
    probability: Float[np.ndarray, " n"] | None = None,
) -> Calibration:
    """All figures; `probability` is that of being attached, None for an estimator that states none."""
    return Calibration(
        nees_per_dof=nees_per_dof(belief, stiffness),
        nees_attached=nees_per_dof(belief, stiffness, among=attached),
        coverage_90=coverage(belief, stiffness),
        coverage_attached=coverage(belief, stiffness, among=attached),
        ece=None if probability is None else expected_calibration_error(probability, attached),
    )
