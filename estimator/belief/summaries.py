"""What a filter states, as the estimator says it: the belief in N/m, and which particles are called attached."""

import numpy as np

from jiggle_mj.estimate import Belief, Detection
from jiggle_mj.observation import Declaration

from ..config import EstimatorConfig
from ..filters.evidence import Filter, PosteriorSummary
from .boundary_belief import BoundaryBelief

RULE = "P(attached) > 0.5"
"""Of filters that state a probability."""


def belief(summary: PosteriorSummary) -> Belief:
    """Mean, covariance and, of beliefs in a bounded stiffness, intervals."""
    mean, covariance = summary.belief.moments()
    if isinstance(summary.belief, BoundaryBelief):
        return Belief(mean=np.asarray(mean), covariance=np.asarray(covariance))
    lower, upper = summary.belief.interval()
    return Belief(
        mean=np.asarray(mean),
        covariance=np.asarray(covariance),
        reference=float(summary.belief.reference),
        lower=np.asarray(lower),
        upper=np.asarray(upper),
    )


def detection(
    summary: PosteriorSummary, filter: Filter, declaration: Declaration, config: EstimatorConfig, *, converged: bool
) -> Detection:
    """By P(attached) where it is stated, else by the mean; `converged`: whether samples, at the end, agreed."""
    b, sd, probability = (np.asarray(one) for one in (summary.b, summary.sd, summary.probability))
    if np.isfinite(probability).all():
        noise = filter.noise
        return Detection(
            attached=probability > 0.5,
            score=probability,
            stiffness=b,
            stiffness_sd=sd,
            probabilistic=True,
            rule=RULE,
            converged=converged,
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
