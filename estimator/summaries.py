"""A filter's posterior as the estimator publishes it: the belief in N/m, and which particles are called attached."""

from statistics import NormalDist

import numpy as np
from jaxtyping import Bool, Float

from jiggle_mj.errors import PerceptionError
from jiggle_mj.estimate import Belief, Detection, Estimate, ForceCheck
from jiggle_mj.observation import Declaration, Observation

from .belief.gaussian_belief import GaussianBelief
from .config import EstimatorConfig
from .filters.force_fit import ForceFit, StiffnessScale
from .filters.noise import Noise
from .filters.posterior_summary import Convergence, PosteriorSummary, Update

RULE = "P(attached) > 0.5"
"""Rule of detection for filters that give a probability."""
MAX_S = 0.999
"""Largest finite end of an interval of s [1]."""


def belief(summary: PosteriorSummary, scale: StiffnessScale | None) -> Belief:
    """Return mean and covariance, and the 90 % intervals of a belief over bounded stiffnesses.

    Args:
        summary: the posterior.
        scale: factor on all stiffnesses; None for 1.
    """
    mean, covariance = (np.asarray(part) for part in summary.belief.moments())
    if isinstance(summary.belief, GaussianBelief):
        return Belief(mean=mean, covariance=covariance)
    reference = float(summary.belief.reference)
    lower, upper = (np.asarray(end) for end in summary.belief.interval())
    if scale is not None:
        s = np.clip(mean, 0, 1)
        added, sds = scale.added_covariance(s), NormalDist().inv_cdf(1 - summary.belief.config.tail)
        ends = [_end(end, s, sds**2 * np.diagonal(added), reference) for end in (lower, upper)]
        covariance, reference = covariance + added, scale.factor * reference
        lower, upper = (scale.factor * end for end in ends)
    return Belief(mean=mean, covariance=covariance, reference=reference, lower=lower, upper=upper)


def stiffness(
    summary: PosteriorSummary, scale: StiffnessScale | None
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return mean and standard deviation of each b [N/m], multiplied by the factor on all stiffnesses, if any."""
    b, sd = np.asarray(summary.b), np.asarray(summary.sd)
    if scale is None or isinstance(summary.belief, GaussianBelief):
        return b, sd
    reference = float(summary.belief.reference)
    s = b / (b + reference)
    added = np.diagonal(scale.added_covariance(s)) * (reference / (1 - s) ** 2) ** 2
    return scale.factor * b, scale.factor * np.sqrt(np.maximum(sd**2 + added, 0.0))


def estimate(
    observation: Observation,
    summary: PosteriorSummary,
    update: Update,
    *,
    scale: StiffnessScale | None,
    rest: Float[np.ndarray, "n 3"],
    observed: Float[np.ndarray, "n 3"],
    held: Bool[np.ndarray, " n"],
    seconds: tuple[float, float],
) -> Estimate:
    """Return the belief after an observation.

    Args:
        observation: the observation.
        summary: the posterior.
        update: what the filter made of the frame.
        scale: factor on all stiffnesses; None for 1.
        rest: positions of the particles at rest [m].
        observed: as perception measured them, NaN where they are not seen [m].
        held: which particles the jaws hold.
        seconds: wall times of the filter and of perception [s].
    """
    (b, sd), x = stiffness(summary, scale), np.asarray(update.x)
    return Estimate(
        index=observation.index,
        time=observation.time,
        positions=x,
        observed=observed,
        mean=b,
        sd=sd,
        probability=np.asarray(summary.probability),
        held=held,
        entropy=float(summary.entropy),
        nis=float(update.nis),
        boundary_energy=0.5 * float(np.mean(b * np.sum((x - rest) ** 2, axis=1))),
        update_s=seconds[0],
        perception_s=seconds[1],
        converged=update.reason is not Convergence.SEARCH_CUT_OFF,
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


def force_check(fit: ForceFit | None, scale: StiffnessScale | None) -> ForceCheck | None:
    """Return measured and predicted forces as the estimator publishes them."""
    if fit is None:
        return None
    return ForceCheck(
        index=fit.index,
        measured=fit.measured,
        predicted=fit.predicted,
        sd=np.sqrt(np.diagonal(fit.predicted_covariance, axis1=1, axis2=2)),
        nis=fit.nis,
        scaled_nis=fit.scaled_nis,
        used=fit.evidence is not None,
        why_not=fit.doubt,
        stiffness_factor=None if scale is None else scale.factor,
        stiffness_factor_log_sd=None if scale is None else scale.log_sd,
    )


def _end(
    end: Float[np.ndarray, " n"], s: Float[np.ndarray, " n"], added: Float[np.ndarray, " n"], reference: float
) -> Float[np.ndarray, " n"]:
    """Return one end of the intervals of b, its squared distance in s grown by `added`; 0 and infinity stay [N/m]."""
    inside = (end > 0) & np.isfinite(end)
    at = np.where(inside, end / (np.where(inside, end, 0.0) + reference), s)
    half = np.sqrt(np.maximum((at - s) ** 2 + added, 0.0))
    at = np.clip(s + np.copysign(half, at - s), 0.0, MAX_S)
    return np.where(inside, reference * at / (1 - at), end)


def detection(
    summary: PosteriorSummary,
    declaration: Declaration,
    config: EstimatorConfig,
    *,
    scale: StiffnessScale | None,
    noise: Noise | None,
    refined: Convergence,
) -> Detection:
    """Return which particles are called attached: by P(attached) where the filter gives it, else by the mean of b.

    Args:
        summary: the posterior.
        declaration: its membrane stiffness k is the unit of `EstimatorConfig.detect_above`.
        config: the settings.
        scale: factor on all stiffnesses; None for 1.
        noise: factors on the assumed variances; None where they are not learned.
        refined: how the last refinement at a release ended.
    """
    (b, sd), probability = stiffness(summary, scale), np.asarray(summary.probability)
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
