"""A filter's posterior as the estimator publishes it: the belief in N/m, and which particles are called attached."""

import numpy as np

from jiggle_mj.errors import PerceptionError
from jiggle_mj.estimate import Belief, Detection
from jiggle_mj.observation import Declaration

from .belief.gaussian_belief import GaussianBelief
from .config import EstimatorConfig
from .filters.noise import Noise
from .filters.posterior_summary import Convergence, PosteriorSummary

RULE = "P(attached) > 0.5"
"""Rule of detection for filters that give a probability."""


def belief(summary: PosteriorSummary) -> Belief:
    """Return mean and covariance, and the 90 % intervals of a belief over bounded stiffnesses."""
    mean, covariance = summary.belief.moments()
    if isinstance(summary.belief, GaussianBelief):
        return Belief(mean=np.asarray(mean), covariance=np.asarray(covariance))
    lower, upper = summary.belief.interval()
    return Belief(
        mean=np.asarray(mean),
        covariance=np.asarray(covariance),
        reference=float(summary.belief.reference),
        lower=np.asarray(lower),
        upper=np.asarray(upper),
    )


def refuse_not_finite(summary: PosteriorSummary | None) -> None:
    """Refuse the posterior of a refinement that is not finite; None stands for none.

    Raises:
        PerceptionError: it is not.
    """
    if summary is not None and not summary.is_finite:
        raise PerceptionError(
            "refined together, the frames of all grasps leave no finite belief: no attachments explain them "
            "together. The belief stays as it was; leave out grasps to find the one that does not fit."
        )


def detection(
    summary: PosteriorSummary,
    declaration: Declaration,
    config: EstimatorConfig,
    *,
    noise: Noise | None,
    refined: Convergence,
) -> Detection:
    """Return which particles are called attached: by P(attached) where the filter gives it, else by the mean of b.

    Args:
        summary: the posterior.
        declaration: its membrane stiffness k is the unit of `EstimatorConfig.detect_above`.
        config: the settings.
        noise: factors on the assumed variances; None where they are not learned.
        refined: how the last refinement at a release ended.
    """
    b, sd, probability = (np.asarray(part) for part in (summary.b, summary.sd, summary.probability))
    if np.isfinite(probability).all():
        return Detection(
            attached=probability > 0.5,
            score=probability,
            stiffness=b,
            stiffness_sd=sd,
            probabilistic=True,
            rule=RULE,
            converged=refined is not Convergence.SAMPLES_DISAGREE,
            force_sd_ratio=None if noise is None else noise.force**0.5,
            position_sd_ratio=None if noise is None else noise.position**0.5,
        )
    limit = config.detect_above * declaration.membrane_stiffness
    return Detection(
        attached=b > limit,
        score=b,
        stiffness=b,
        stiffness_sd=sd,
        rule=f"non-negative mean of b > {config.detect_above:g} k = {limit:.3g} N/m",
    )
