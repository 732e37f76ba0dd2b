"""What a fit of one recording says of the parameters that it shares with others, with all else integrated out."""

import numpy as np
from jaxtyping import Float, Int

from .gauss_newton import Fitted
from .joint_evidence import OwnInformation, SharedPrior
from .normal_equations import without_stiffnesses
from .problem import Problem


def own_information(fitted: Fitted, shared: Int[np.ndarray, " d"], log_evidence: float) -> OwnInformation:
    """Return the information of a fit about some parameters; attachments and other parameters are marginalised.

    Args:
        fitted: the fit.
        shared: indices of the parameters, all of them of effects in the fit.
        log_evidence: of the fit [nat].
    """
    problem, free = fitted.problem, fitted.free
    of_shared = np.array([np.flatnonzero(free == k)[0] for k in shared], dtype=int)
    of_others = np.flatnonzero(~np.isin(free, shared))
    sd, theta = problem.sd(fitted.named)[of_others], fitted.point.theta
    joint = without_stiffnesses(fitted.square, fitted.site_precision).restricted(shared=of_shared, others=of_others)
    found = joint.with_independent("others", sd**-2, -theta[free[of_others]] / sd**2).marginal("shared")
    return OwnInformation(
        log_evidence=log_evidence,
        theta=theta[shared],
        precision=_not_negative(np.asarray(found.precision), problem.prior_sd[shared]),
        slope=np.asarray(found.shift),
    )


def shared_prior(problem: Problem, shared: Int[np.ndarray, " d"]) -> SharedPrior:
    """Return the prior of some parameters of effects."""
    return SharedPrior(sd=problem.prior_sd[shared], lower=problem.lower_bounds(shared))


def _not_negative(precision: Float[np.ndarray, "d d"], sd: Float[np.ndarray, " d"]) -> Float[np.ndarray, "d d"]:
    """Return a symmetric matrix without the negative eigenvalues that rounding may leave, in units of sd."""
    unit = np.outer(sd, sd)
    values, vectors = np.linalg.eigh(0.5 * (precision + precision.T) * unit)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T / unit
