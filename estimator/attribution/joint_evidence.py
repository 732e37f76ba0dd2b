"""Evidence of several recordings together, whose parameters of some effects are the same. Pure functions of numbers.

Everything else is each recording's own and integrated in its evidence. About the fit of recording r, of evidence Z_r
with the prior N(0, Theta), the log likelihood of the shared parameters is

    l_r(theta) = l_r + g_r^T (theta - theta_r) - 1/2 (theta - theta_r)^T V_r (theta - theta_r),
    l_r = ln Z_r + 1/2 theta_r^T Theta^-1 theta_r + 1/2 ln |I + Theta V_r|,

and with the best theta of all recordings

    ln Z = sum_r l_r(theta) - 1/2 theta^T Theta^-1 theta - 1/2 ln |I + Theta sum_r V_r|.

This is exact where the likelihood is normal, and Laplace's method elsewhere, as in `evidence`. A parameter at its bound
is not integrated there, and not here; the fit of a recording may be at the bound where that of all is not.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import lsq_linear

from .evidence import NEAR_BOUND


@dataclass(frozen=True, kw_only=True)
class SharedPrior:
    """Prior of the parameters that the recordings share."""

    sd: Float[np.ndarray, " d"]
    """Standard deviations about 0."""
    lower: Float[np.ndarray, " d"]
    """Lower bounds."""

    def inside(self, theta: Float[np.ndarray, " d"]) -> Bool[np.ndarray, " d"]:
        """Return which parameters are not at their lower bound."""
        return theta > self.lower + NEAR_BOUND * self.sd


@dataclass(frozen=True, kw_only=True)
class OwnInformation:
    """What one recording says of the shared parameters, with everything else integrated out."""

    log_evidence: float
    """ln Z of the recording alone [nat]."""
    theta: Float[np.ndarray, " d"]
    """Parameters of its fit."""
    precision: Float[np.ndarray, "d d"]
    """Negative second derivative V of its log likelihood."""
    slope: Float[np.ndarray, " d"]
    """Derivative of its log likelihood at theta. Only at a bound does it count: elsewhere a fit ends where its prior
    makes up for it."""


@dataclass(frozen=True, kw_only=True)
class SharedPosterior:
    """Posterior of the shared parameters under all recordings."""

    log_evidence: float
    """ln Z of all recordings [nat]."""
    theta: Float[np.ndarray, " d"]
    """Likeliest parameters."""
    sd: Float[np.ndarray, " d"]
    """Standard deviations; 0 at a bound."""


def joint_evidence(recordings: Sequence[OwnInformation], prior: SharedPrior) -> SharedPosterior:
    """Return the evidence of all recordings with the same parameters, and the posterior of these."""
    sd, shift, precision, total = prior.sd, np.zeros(len(prior.sd)), np.diag(prior.sd**-2.0), 0.0
    slopes = [_slope(one, prior) for one in recordings]
    for one, slope in zip(recordings, slopes, strict=True):
        precision = precision + one.precision
        shift = shift + one.precision @ one.theta + slope
    theta = _likeliest(precision, shift, prior)
    for one, slope in zip(recordings, slopes, strict=True):
        step = theta - one.theta
        of_prior = 0.5 * np.sum((one.theta / sd) ** 2)
        of_prior += 0.5 * _log_determinant(one.precision + np.diag(sd**-2.0), prior, one.theta)
        total += one.log_evidence + of_prior + slope @ step - 0.5 * step @ one.precision @ step
    total -= 0.5 * np.sum((theta / sd) ** 2) + 0.5 * _log_determinant(precision, prior, theta)
    free, variances = prior.inside(theta), np.zeros(len(sd))
    variances[free] = np.diag(np.linalg.inv(precision[np.ix_(free, free)]))
    found = float(total) if np.isfinite(total) else -np.inf
    return SharedPosterior(log_evidence=found, theta=theta, sd=np.sqrt(variances))


def _slope(one: OwnInformation, prior: SharedPrior) -> Float[np.ndarray, " d"]:
    """Return the slope of a recording's log likelihood at its fit; at a bound it points outwards."""
    against = one.theta / prior.sd**2
    return np.where(prior.inside(one.theta), against, np.minimum(one.slope, against))


def _likeliest(
    precision: Float[np.ndarray, "d d"], shift: Float[np.ndarray, " d"], prior: SharedPrior
) -> Float[np.ndarray, " d"]:
    """Return the parameters within the bounds at which a quadratic log density is largest."""
    if not len(shift):
        return shift
    factor = np.linalg.cholesky(precision * np.outer(prior.sd, prior.sd))
    towards = np.linalg.solve(factor, shift * prior.sd)
    return prior.sd * lsq_linear(factor.T, towards, bounds=(prior.lower / prior.sd, np.inf), method="bvls").x


def _log_determinant(precision: Float[np.ndarray, "d d"], prior: SharedPrior, theta: Float[np.ndarray, " d"]) -> float:
    """Return ln |Theta precision| over the parameters that are not at their bound."""
    free = prior.inside(theta)
    return float(np.linalg.slogdet((precision * np.outer(prior.sd, prior.sd))[np.ix_(free, free)])[1])
