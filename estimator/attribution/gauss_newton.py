"""Gauss-Newton steps of stiffnesses and of the parameters of some effects to all predicted equilibria of a recording.

The weights are those of the current state [iteratively reweighted: Green 1984, JRSS B 46:149]. A step is taken if it
lowers the cost, twice the negative logarithm of likelihood and prior, with the weights and determinants of where it
leads: so weights that are more tolerant gain nothing. Stiffnesses step to where the belief has them.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ..belief.attachment_belief import AttachmentBelief
from ..belief.gaussian_information import GaussianInformation
from ..filters.implicit import likeliest, quick_summary
from ..filters.posterior_summary import PosteriorSummary
from .every_frame import (
    directions,
    in_common,
    linearised,
    log_determinants,
    misfit_of,
    misfit_under,
    residual,
    weighed,
)
from .frame_likelihood import FrameLikelihood
from .linear import NormalEquations, WeightedResiduals
from .noise_scales import NoiseScales
from .normal_equations import reduced
from .problem import Point, Problem
from .sheet import predict_all

ATTACHMENT_LOG_ODDS = 2.2
"""Prior cost of an attachment: the logarithm of nine to one [nat]."""
MAX_STIFFNESS = 0.98
"""Largest bounded stiffness."""
MAX_GAUSS_NEWTON_STEPS = 10
"""Largest number of Gauss-Newton steps."""
SHORTER_SHARES = (0.3, 0.1)
"""Shares of a step that are tried after the whole one."""
MAX_EFFECT, MAX_NUISANCE = 4.0, 3.0
"""Largest size of a parameter of an effect, and of a nuisance parameter [prior standard deviations]."""
MAX_CHANGE = 1.5
"""Largest change of a parameter in one step [prior standard deviations]."""
MIN_GAIN = 2.0
"""Fall of the cost that is worth a step [nat, doubled]."""
MAX_WHOLE = 2
"""Largest number of whole steps that are tried before shorter ones."""
FACTOR_PRECISION = 1e-2
"""Prior precision of a common factor of all s about 1. It decides where no frame shows an attachment."""
Step = tuple[Float[np.ndarray, " p"], Float[np.ndarray, " n"]]
"""Change of the parameters and of s."""


@dataclass(frozen=True, kw_only=True)
class Weighed:
    """A point with the weights of the residuals there."""

    problem: Problem
    """What is fitted to, with the noise scales of the weights."""
    point: Point
    """Parameters and states."""
    weights: dict[int, FrameLikelihood]
    """Weights of the residuals of each frame."""
    residuals: dict[int, WeightedResiduals]
    """Residuals of each frame."""
    log_likelihood: float
    """Log density of the observations, determinants included [nat], up to a constant of the frames."""


@dataclass(frozen=True, kw_only=True)
class Fitted(Weighed):
    """Result of a fit: its point with the errors' sizes of the fit, and what follows there."""

    named: np.ndarray
    """Parameters of the effects in the model."""
    free: np.ndarray
    """All fitted parameters, nuisance parameters included."""
    square: Float[np.ndarray, "k k"]
    """Normal equations over s, the free parameters and -1."""
    equations: dict[int, NormalEquations]
    """Normal equations of each frame."""
    summary: PosteriorSummary
    """Posterior of the attachments, with the free parameters marginalised."""

    @property
    def cost(self) -> float:
        """Return twice the negative logarithm of likelihood and prior, of the noise scales too [nat]."""
        return cost(self, self.named)

    @property
    def log_posterior(self) -> float:
        """Return the logarithm of likelihood and prior [nat]; -inf where it is no number."""
        return -self.cost / 2 if np.isfinite(self.cost) else -np.inf

    @property
    def belief(self) -> AttachmentBelief:
        """Return the belief about the attachments."""
        assert isinstance(self.summary.belief, AttachmentBelief)
        return self.summary.belief

    @property
    def site_precision(self) -> Float[np.ndarray, " n"]:
        """Return the precision that the belief has of each s in addition to the frames' evidence."""
        return np.asarray(self.belief.site_precision)

    @property
    def probability(self) -> Float[np.ndarray, " n"]:
        """Return P(attached) of each particle; one of the likeliest set need not be likely itself."""
        return np.asarray(self.summary.probability)

    @property
    def attached(self) -> Bool[np.ndarray, " n"]:
        """Return which particles are more likely attached than not."""
        return self.probability > 0.5


def start(problem: Problem, theta: np.ndarray, s: np.ndarray, states: np.ndarray, frames: list[int]) -> Point:
    """Return a point with its predictions of some frames, and of those before them in their grasps."""
    states, seen = predict_all(problem.sheet, theta, s, problem.history, states, only=problem.up_to(frames))
    return Point(theta=theta, s=s, states=states, seen=seen)


def moved(fitted: Fitted, at: np.ndarray, theta: np.ndarray) -> Point:
    """Return a fit's point with other values of some parameters, and its predictions."""
    changed = fitted.point.theta.copy()
    changed[at] = theta
    return start(fitted.problem, changed, fitted.point.s, fitted.point.states, list(fitted.equations))


def gauss_newton(
    begun: Fitted, *, passes: int = MAX_GAUSS_NEWTON_STEPS, log: Callable[[str], None] = lambda _: None
) -> Fitted:
    """Return the fit of parameters and all stiffnesses to the frames of a point, with the noise scales that it has.

    Args:
        begun: the start, linearised.
        passes: largest number of Gauss-Newton steps.
        log: receives progress messages.
    """
    return improved(begun, lambda now: better_point(now, candidate_steps(now)), passes=passes, step="step", log=log)


def improved(
    begun: Fitted,
    better: Callable[[Fitted], Weighed | None],
    *,
    passes: int,
    step: str,
    log: Callable[[str], None],
) -> Fitted:
    """Return the fit after steps to better points, at most `passes`, until there is none; `step` is their name."""
    now = begun
    for count in range(passes):
        if (there := better(now)) is None:
            break
        before, now = now, linearised_fit(there, now.named)
        log(f"{step} {count + 1}: {before.cost / 2:.1f} -> {now.cost / 2:.1f} nat")
    return now


def weigh(problem: Problem, point: Point, frames: list[int]) -> Weighed:
    """Return a point with the weights of some frames there."""
    weights = weighed(problem, point, frames)
    return evaluated(problem, point, weights, residual(problem, weights, point))


def evaluated(
    problem: Problem, point: Point, weights: dict[int, FrameLikelihood], residuals: dict[int, WeightedResiduals]
) -> Weighed:
    """Return a weighed point with its likelihood under a problem's scales of the fields and of the tool."""
    grasps = in_common(problem, weights, residuals)
    doubled = misfit_of(problem, residuals, grasps) + log_determinants(problem, weights, grasps)
    return Weighed(problem=problem, point=point, weights=weights, residuals=residuals, log_likelihood=-0.5 * doubled)


def linearise_at(problem: Problem, named: np.ndarray, point: Point, frames: list[int]) -> Fitted:
    """Return a point as a fit, with weights, normal equations and posterior there."""
    return linearised_fit(weigh(problem, point, frames), named)


def linearised_fit(at: Weighed, named: np.ndarray) -> Fitted:
    """Return a weighed point as a fit, with normal equations and posterior there."""
    along = directions(at.problem, at.problem.free(named))
    equations = linearised(at.problem, at.point, at.weights, at.residuals, along)
    return fit_at(at, named, equations)


def fit_at(at: Weighed, named: np.ndarray, equations: dict[int, NormalEquations]) -> Fitted:
    """Return a weighed point as a fit, from the normal equations of its frames."""
    problem, point = at.problem, at.point
    free, sd = problem.free(named), problem.sd(named)
    square = reduced(problem, equations, len(free))
    return Fitted(
        problem=problem,
        point=point,
        named=named,
        free=free,
        square=square,
        equations=equations,
        weights=at.weights,
        residuals=at.residuals,
        summary=posterior(problem, square, point, free, sd),
        log_likelihood=at.log_likelihood,
    )


def better_point(now: Fitted, steps: list[Step]) -> Weighed | None:
    """Return a point of lower cost; None if none is found.

    Whole steps are tried first, those of the largest predicted gain, then shorter ones along the first of them. The
    posterior may have stiffnesses that fit worse; a step of the parameters alone then has the larger gain. Where the
    prediction does not even fit better under the weights that the step was found with, it is not weighed anew.
    """
    gains = _whole_gains(now, steps)
    whole = [steps[k] for k in np.argsort(-np.array(gains), kind="stable") if gains[k] > MIN_GAIN]
    tries = [(step, 1.0) for step in whole[:MAX_WHOLE]]
    tries += [(step, share) for step in whole[:1] for share in SHORTER_SHARES]
    for step, share in tries:
        point = predicted_after(now, step, share)
        if _gain_under_weights(now, point) > MIN_GAIN:
            there = weigh(now.problem, point, list(now.equations))
            if cost(there, now.named) < now.cost - MIN_GAIN:
                return there
    return None


def after_step(now: Fitted, step: Step, share: float, scales: NoiseScales | None = None) -> Weighed:
    """Return the point after a share of a step, with other noise scales if any are given."""
    problem = now.problem if scales is None else now.problem.with_scales(scales)
    return weigh(problem, predicted_after(now, step, share), list(now.equations))


def predicted_after(now: Fitted, step: Step, share: float) -> Point:
    """Return the parameters and s after a share of a step, with their predictions."""
    theta, s = applied(now, step, share)
    return start(now.problem, theta, s, now.point.states, list(now.equations))


def promised_log_posterior(now: Fitted) -> float:
    """Return the log posterior that the best whole step, or none, leads to by the normal equations [nat]."""
    return now.log_posterior + max(0.0, *_whole_gains(now, candidate_steps(now))) / 2


def _whole_gains(now: Fitted, steps: list[Step]) -> list[float]:
    """Return by how much the cost falls in each whole step, by the normal equations [nat, doubled]."""
    return [_predicted_gain(now, *applied(now, step, 1.0)) for step in steps]


def applied(now: Fitted, step: Step, share: float) -> Step:
    """Return the parameters and s after a share of a step, within their bounds."""
    free, sd = now.free, now.problem.sd(now.named)
    largest = np.where(np.arange(len(free)) < len(now.named), MAX_EFFECT, MAX_NUISANCE) * sd
    theta = now.point.theta + share * step[0]
    theta[free] = now.problem.bounded(free, theta[free], largest)
    return theta, np.clip(now.point.s + share * step[1], 0, MAX_STIFFNESS)


def _gain_under_weights(now: Fitted, point: Point) -> float:
    """Return by how much the cost falls to the predictions of a point, under the weights that there are [nat, doubled].

    It is no number where a frame is not predicted.
    """
    return _gain(now, point.theta, point.s, misfit_under(now.problem, now.weights, point))


def _predicted_gain(now: Fitted, theta: Float[np.ndarray, " p"], s: Float[np.ndarray, " n"]) -> float:
    """Return by how much the normal equations predict that the misfit is lower there [nat, doubled]."""
    displacement = np.concatenate([s - now.point.s, (theta - now.point.theta)[now.free], [1.0]])
    return _gain(now, theta, s, float(displacement @ now.square @ displacement))


def _gain(now: Fitted, theta: Float[np.ndarray, " p"], s: Float[np.ndarray, " n"], misfit: float) -> float:
    """Return by how much the cost falls to a misfit elsewhere, with the determinants that there are [nat, doubled]."""
    free, sd = now.free, now.problem.sd(now.named)
    fall = float(now.square[-1, -1]) - misfit
    return fall + _prior(now.point.theta, now.point.s, free, sd) - _prior(theta, s, free, sd)


def candidate_steps(now: Fitted, *, likeliest_set: bool = True) -> list[Step]:
    """Return the candidate steps, each with the parameters that fit its s best.

    They are: to the particles that are more likely attached than not; with the current s; and to the likeliest set of
    attachments. If any of many particles may hold a load, none of them is more likely attached than not, and yet one
    must be. The same holds if a load is smaller than assumed, because all that hold it are softer, but none of them
    alone. Only then all s may change by one factor; elsewhere the best factor would follow the noise.
    """
    steps = [_towards(now, detected(now.problem, now.summary)), parameter_step(now)]
    if not now.attached.any():
        steps.append(common_factor_step(now))
    return [*steps, _towards(now, likeliest_together(now.summary))] if likeliest_set else steps


def parameter_step(now: Fitted) -> Step:
    """Return the step of the parameters alone."""
    return _towards(now, now.point.s)


def common_factor_step(now: Fitted) -> Step:
    """Return the step of all s by the common factor that fits best, with the parameters marginalised."""
    s, belief = now.point.s, now.belief
    factor = (s @ np.asarray(belief.shift) + FACTOR_PRECISION) / (
        s @ np.asarray(belief.precision) @ s + FACTOR_PRECISION
    )
    return _towards(now, factor * s)


def _towards(now: Fitted, to: Float[np.ndarray, " n"]) -> Step:
    """Return the step to a given s, with the parameters that fit it best."""
    point, free, sd = now.point, now.free, now.problem.sd(now.named)
    best = joint_information(now.square, point, free, sd).condition(s=to - point.s).mean()
    theta = np.zeros(len(point.theta))
    theta[free] = np.clip(best, -MAX_CHANGE * sd, MAX_CHANGE * sd)
    return theta, to - point.s


def detected(problem: Problem, summary: PosteriorSummary) -> Float[np.ndarray, " n"]:
    """Return the bounded stiffnesses of the particles that are likelier attached than not, and 0 of the others."""
    return np.asarray(problem.prior.bounded(jnp.where(summary.probability > 0.5, summary.b, 0.0)))


def likeliest_together(summary: PosteriorSummary) -> Float[np.ndarray, " n"]:
    """Return the bounded stiffnesses of the attachments that are likeliest together."""
    assert isinstance(summary.belief, AttachmentBelief)
    return np.asarray(likeliest(summary.belief))


def posterior(problem: Problem, square: np.ndarray, point: Point, free: np.ndarray, sd: np.ndarray) -> PosteriorSummary:
    """Return the posterior of the attachments at a point, with the parameters marginalised."""
    step = joint_information(square, point, free, sd).marginal("s")
    shift = step.precision @ point.s + step.shift
    return quick_summary(problem.prior.add(jnp.asarray(step.precision), jnp.asarray(shift)))


def joint_information(square: np.ndarray, point: Point, free: np.ndarray, sd: np.ndarray) -> GaussianInformation:
    """Return the information about steps of s and of the free parameters, with the prior of the parameters."""
    joint = GaussianInformation.from_normal_equations(square, s=len(point.s), theta=len(free))
    return joint.with_independent("theta", sd**-2, -point.theta[free] / sd**2)


def cost(at: Weighed, named: np.ndarray) -> float:
    """Return twice the negative logarithm of likelihood and prior, of the noise scales too [nat]."""
    problem, point = at.problem, at.point
    prior = _prior(point.theta, point.s, problem.free(named), problem.sd(named)) - 2 * problem.scales.log_prior()
    return prior - 2 * at.log_likelihood


def _prior(theta: Float[np.ndarray, " p"], s: Float[np.ndarray, " n"], free: np.ndarray, sd: np.ndarray) -> float:
    """Return twice the negative logarithm of the prior, without constants."""
    return 2 * ATTACHMENT_LOG_ODDS * float(np.sum(s > 0)) + float(np.sum((theta[free] / sd) ** 2))
