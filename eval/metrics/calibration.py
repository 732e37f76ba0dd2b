"""Calibration of the belief's uncertainty, against the truth transferred to the particles.

The figures are of the Gaussian before the non-negativity constraint, which the filter propagates. Particles whose true
stiffness is no number (a weld, or attached by an unknown amount) are marginalised out, which for a Gaussian means
dropping their rows and columns. So are those whose variance is unknown (NaN: an estimator without uncertainty).

NEES is the normalised estimation error squared of Bar-Shalom, Li & Kirubarajan, "Estimation with Applications to
Tracking and Navigation" (2001). Divided by the degrees of freedom it is 1 on average for a calibrated belief, and above
1 for an over-confident one.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.special import ndtri

from jiggle_mj.estimate import Belief

INTERVAL_LEVEL = 0.90
"""Probability of the credible intervals."""
N_BINS = 10
"""Equal bins of probability for the expected calibration error."""


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Calibration figures of one belief; None where nothing defines them."""

    nees_per_dof: float | None
    """NEES per degree of freedom over the particles with a known truth and variance."""
    nees_attached: float | None
    """NEES per degree of freedom over the truly attached particles alone: a free one is where a prior has its peak."""
    coverage_90: float | None
    """Share of particles whose true stiffness lies in the central 90 % credible interval of its marginal."""
    coverage_attached: float | None
    """The same share among the truly attached alone: an interval from 0 holds every free one."""
    nees_observable: float | None
    """NEES per degree of freedom over the attached that bore an observable load. One that never moved is where the
    prior puts it, and the few that are attached lie far out in a prior that calls most of them free."""
    coverage_observable: float | None
    """The same share among these."""
    ece: float | None
    """Expected calibration error of the probabilities of being attached."""


@dataclass(frozen=True, kw_only=True)
class Bin:
    """Particles with about the same predicted probability."""

    low: float
    high: float
    count: int
    predicted: float
    """Mean of the predicted probabilities."""
    attached: float
    """Share of the particles that is attached."""


def nees_per_dof(
    belief: Belief, stiffness: Float[np.ndarray, " n"], *, among: Bool[np.ndarray, " n"] | None = None
) -> float | None:
    """Return (b_hat - b*)^T Sigma^-1 (b_hat - b*) / n over the particles whose b* and variance are finite, in float64.

    With `among` only those count, and the others are marginalised out. None where no particle counts.

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
    level: float = INTERVAL_LEVEL,
    *,
    among: Bool[np.ndarray, " n"] | None = None,
) -> float | None:
    """Return the share of particles of finite b* and variance with |b_hat - b*| <= z sd.

    z is the two-sided normal quantile of `level`. A belief with intervals of its own is counted by these. With `among`
    only those particles count.
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
    """Return the mean over particles of |share attached - mean probability| of the bin that the particle falls into."""
    bins = reliability(probability, attached)
    return sum(each.count * abs(each.attached - each.predicted) for each in bins) / len(probability)


def reliability(probability: Float[np.ndarray, " n"], attached: Bool[np.ndarray, " n"]) -> list[Bin]:
    """Return the share attached by predicted probability, in bins that hold a particle.

    A reliability diagram [DeGroot & Fienberg 1983, doi:10.2307/2987588] in numbers.
    """
    bin_of = np.minimum((probability * N_BINS).astype(int), N_BINS - 1)
    return [
        Bin(
            low=k / N_BINS,
            high=(k + 1) / N_BINS,
            count=int(np.sum(bin_of == k)),
            predicted=float(probability[bin_of == k].mean()),
            attached=float(attached[bin_of == k].mean()),
        )
        for k in np.unique(bin_of)
    ]


def calibration(
    belief: Belief,
    stiffness: Float[np.ndarray, " n"],
    attached: Bool[np.ndarray, " n"],
    *,
    observable: Bool[np.ndarray, " n"] | None = None,
    probability: Float[np.ndarray, " n"] | None = None,
) -> Calibration:
    """Return all figures.

    Args:
        belief: what is calibrated.
        stiffness: b* [N/m].
        attached: the truly attached particles.
        observable: those of them that bore an observable load; None where loads are not known.
        probability: that of being attached; None for an estimator without one.
    """
    return Calibration(
        nees_per_dof=nees_per_dof(belief, stiffness),
        nees_attached=nees_per_dof(belief, stiffness, among=attached),
        coverage_90=coverage(belief, stiffness),
        coverage_attached=coverage(belief, stiffness, among=attached),
        nees_observable=None if observable is None else nees_per_dof(belief, stiffness, among=observable),
        coverage_observable=None if observable is None else coverage(belief, stiffness, among=observable),
        ece=None if probability is None else expected_calibration_error(probability, attached),
    )
