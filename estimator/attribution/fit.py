"""Fit stiffnesses and the parameters of some effects to all predicted equilibria of a recording.

Gauss-Newton with the weights of the current state [iteratively reweighted: Green 1984, JRSS B 46:149]. A step is
accepted if it lowers the cost under the weights that it was computed with, so that weights which are more tolerant gain
nothing. Stiffnesses step to where the belief has them.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ..belief.attachment_belief import AttachmentBelief
from ..belief.gaussian_information import GaussianInformation
from ..filters.implicit import likeliest, quick_summary
from ..filters.posterior_summary import PosteriorSummary
from .every_frame import cost_under, directions, linearised, weighed
from .frame_likelihood import FrameLikelihood
from .linear import NormalEquations
from .normal_equations import reduced
from .problem import Point, Problem
from .sheet import predict_all

ATTACHMENT_LOG_ODDS = 2.2
"""Prior cost of an attachment: the logarithm of nine to one [nat]."""
MAX_STIFFNESS = 0.98
"""Largest bounded stiffness."""
MAX_GAUSS_NEWTON_STEPS = 10
"""Largest number of Gauss-Newton steps."""
PATIENCE = 2
"""Steps in a row without a lower cost under the own weights, after which the fit ends. A fit that leads to more
tolerant weights and back ends where it cost least."""
STEP_SHARES = (1.0, 0.4, 0.15, 0.05)
"""Shares of a step that are tried."""
MAX_EFFECT, MAX_NUISANCE = 4.0, 3.0
"""Largest size of a parameter of an effect, and of a nuisance parameter [prior standard deviations]."""
MAX_CHANGE = 1.5
"""Largest change of a parameter in one step [prior standard deviations]."""
MIN_RELATIVE_GAIN = 2.5e-4
"""Share of the cost by which the normal equations must predict that a step lowers it; otherwise the fit has converged.
Near there the predicted gain is right to within a third, and new weights for all frames cost ten predictions."""
FACTOR_PRECISION = 1e-2
"""Prior precision of a common factor of all s about 1. It decides where no frame shows an attachment."""
Step = tuple[Float[np.ndarray, " p"], Float[np.ndarray, " n"]]
"""Change of the parameters and of s."""


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """Result of a fit."""

    point: Point
    """Fitted parameters and states."""
    around: Point
    """Point where weights were computed and frames linearised: `point`, or one step before it."""
    named: np.ndarray
    """Parameters of the effects in the model."""
    free: np.ndarray
    """All fitted parameters, nuisance parameters included."""
    square: Float[np.ndarray, "k k"]
    """Normal equations over s, the free parameters and -1."""
    equations: dict[int, NormalEquations]
    """Normal equations of each frame."""
    weights: dict[int, FrameLikelihood]
    """Weights of the residuals of each frame."""
    summary: PosteriorSummary
    """Posterior of the attachments, with the free parameters marginalised."""
    cost: float
    """Twice the negative logarithm of likelihood and prior under its own weights [nat]."""

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
    """Return a point with its predictions."""
    states, seen = predict_all(problem.sheet, theta, s, problem.history, states, only=frames)
    return Point(theta=theta, s=s, states=states, seen=seen)


def moved(problem: Problem, fitted: Fitted, at: np.ndarray, theta: np.ndarray) -> Point:
    """Return a fit's point with other values of some parameters, and its predictions."""
    changed = fitted.point.theta.copy()
    changed[at] = theta
    return start(problem, changed, fitted.point.s, fitted.point.states, list(fitted.equations))


def fit(
    problem: Problem,
    named: np.ndarray,
    point: Point,
    parts: set[int],
    *,
    passes: int = MAX_GAUSS_NEWTON_STEPS,
    log: Callable[[str], None] = lambda _: None,
) -> Fitted:
    """Return the fit of named parameters, nuisance parameters and all stiffnesses to frames of some parts.

    Args:
        problem: what is fitted to.
        named: parameters of the effects in the model.
        point: start of the fit.
        parts: parts whose frames are fitted to.
        passes: largest number of Gauss-Newton steps.
        log: receives progress messages.
    """
    now = best = linearise_at(problem, named, point, problem.frames(parts))
    waited = 0
    for count in range(passes):
        if (better := better_point(problem, now, candidate_steps(problem, now))) is None:
            break
        next_point, cost = better
        log(f"step {count + 1}: {now.cost / 2:.1f} -> {cost / 2:.1f} nat")
        there = linearise_at(problem, named, next_point, problem.frames(parts))
        if not np.isfinite(there.cost):
            break
        now = there
        best, waited = (now, 0) if now.cost < best.cost else (best, waited + 1)
        if waited == PATIENCE:
            return final_step(problem, best)
    return final_step(problem, now)


def without(problem: Problem, fitted: Fitted, part: int) -> Fitted:
    """Return one more step from a fit without the frames of one part, from the normal equations that it has.

    The likeliest set of attachments is no candidate: of many equally likely sets, fewer frames would take another one
    at random.
    """
    kept = [k for k in fitted.equations if problem.history.frames[k].part != part]
    equations, weights = {k: fitted.equations[k] for k in kept}, {k: fitted.weights[k] for k in kept}
    now = replace(_fit_at(problem, fitted.named, fitted.point, equations, weights), around=fitted.around)
    better = better_point(problem, now, candidate_steps(problem, now, likeliest_set=False), min_gain=0.0)
    return now if better is None else replace(now, point=better[0], cost=better[1])


def discounted(problem: Problem, fitted: Fitted, excess: float) -> Fitted:
    """Return a fit whose information is divided by the mean squared standardised residual of held-out parts.

    This is quasi-likelihood [Wedderburn 1974, doi:10.1093/biomet/61.3.439].
    """
    sd = problem.sd(fitted.named)
    return replace(fitted, summary=_summary(problem, fitted.square / excess, fitted.point, fitted.free, sd))


def gains_over(problem: Problem, better: Fitted, plain: Fitted) -> tuple[float, float]:
    """Return the log likelihood ratio of one fit to another, under its own weights and under the other's [nat].

    The weights of different fits tolerate different residuals, so that ratios under one fit's alone do not compare.
    """
    plain_there = _cost(problem, better.weights, plain.point, plain.named)
    better_there = _cost(problem, plain.weights, better.point, better.named)
    return (plain_there - better.cost) / 2, (plain.cost - better_there) / 2


def linearise_at(problem: Problem, named: np.ndarray, point: Point, frames: list[int]) -> Fitted:
    """Return a point as a fit, with weights, normal equations and posterior there."""
    along = directions(problem, problem.free(named))
    weights = weighed(problem, point, frames)
    return _fit_at(problem, named, point, linearised(problem, point, weights, along), weights)


def _fit_at(
    problem: Problem,
    named: np.ndarray,
    point: Point,
    equations: dict[int, NormalEquations],
    weights: dict[int, FrameLikelihood],
) -> Fitted:
    free, sd = problem.free(named), problem.sd(named)
    square = reduced(problem, equations, len(free))
    return Fitted(
        point=point,
        around=point,
        named=named,
        free=free,
        square=square,
        equations=equations,
        weights=weights,
        summary=_summary(problem, square, point, free, sd),
        cost=_cost(problem, weights, point, named),
    )


def final_step(problem: Problem, now: Fitted) -> Fitted:
    """Return a fit after one more step of the parameters alone, from its normal equations, however small the gain.

    Other attachments that fit about as well may be far away, where the weights do not hold. The posterior of the
    attachments stays, because the parameters are marginalised in it.
    """
    theta, s = _apply(problem, now, parameter_step(problem, now), 1.0)
    point = start(problem, theta, s, now.point.states, list(now.equations))
    cost = _cost(problem, now.weights, point, now.named)
    if not cost < now.cost:
        return now
    n = len(s)
    displacement = np.zeros(len(now.equations[min(now.equations)].square))
    displacement[n : n + len(now.free)], displacement[-1] = (theta - now.point.theta)[now.free], 1.0
    equations = {k: recentred(one, displacement) for k, one in now.equations.items()}
    square = reduced(problem, equations, len(now.free))
    return replace(now, point=point, equations=equations, square=square, cost=cost)


def recentred(normal_equations: NormalEquations, displacement: Float[np.ndarray, " k"]) -> NormalEquations:
    """Return a frame's normal equations about a point at a displacement, which ends with 1, by linearity."""
    square, tool = np.array(normal_equations.square), np.array(normal_equations.tool)
    square[:, -1] = square @ displacement
    square[-1] = displacement @ square
    tool[:, -1] = tool @ displacement[-tool.shape[1] :]
    return NormalEquations(square=jnp.asarray(square), tool=jnp.asarray(tool))


def better_point(
    problem: Problem, now: Fitted, steps: list[Step], *, min_gain: float = MIN_RELATIVE_GAIN
) -> tuple[Point, float] | None:
    """Return a point with a lower cost, and that cost; None if the predicted gain is at most `min_gain` of the cost.

    The share of a step with the largest predicted gain is tried first. The posterior may have stiffnesses that fit
    worse; a step of the parameters alone then has the larger gain.
    """
    candidates = [_apply(problem, now, step, share) for step in steps for share in STEP_SHARES]
    gains = np.array([_predicted_gain(problem, now, theta, s) for theta, s in candidates])
    for k in np.argsort(-gains, kind="stable"):
        if gains[k] <= min_gain * now.cost:
            return None
        theta, s = candidates[k]
        point = start(problem, theta, s, now.point.states, list(now.equations))
        cost = _cost(problem, now.weights, point, now.named)
        if cost < now.cost:
            return point, cost
    return None


def _apply(problem: Problem, now: Fitted, step: Step, share: float) -> Step:
    """Return the parameters and s after a share of a step, within their bounds."""
    free, sd = now.free, problem.sd(now.named)
    largest = np.where(np.arange(len(free)) < len(now.named), MAX_EFFECT, MAX_NUISANCE) * sd
    theta = now.point.theta + share * step[0]
    theta[free] = np.clip(theta[free], np.maximum(problem.lower_bounds(free), -largest), largest)
    return theta, np.clip(now.point.s + share * step[1], 0, MAX_STIFFNESS)


def _predicted_gain(problem: Problem, now: Fitted, theta: Float[np.ndarray, " p"], s: Float[np.ndarray, " n"]) -> float:
    """Return by how much the normal equations predict that the cost is lower there [nat, doubled like the cost]."""
    free, sd, point = now.free, problem.sd(now.named), now.point
    displacement = np.concatenate([s - point.s, (theta - point.theta)[free], [1.0]])
    gain = float(now.square[-1, -1] - displacement @ now.square @ displacement)
    return gain + _prior(point.theta, point.s, free, sd) - _prior(theta, s, free, sd)


def candidate_steps(problem: Problem, now: Fitted, *, likeliest_set: bool = True) -> list[Step]:
    """Return the candidate steps, each with the parameters that fit its s best.

    They are: to the particles that are more likely attached than not; with the current s; and to the likeliest set of
    attachments. If any of many particles may hold a load, none of them is more likely attached than not, and yet one
    must be. The same holds if a load is smaller than assumed, because all that hold it are softer, but none of them
    alone. Only then all s may change by one factor; elsewhere the best factor would follow the noise.
    """
    detected = problem.prior.bounded(jnp.where(now.summary.probability > 0.5, now.summary.b, 0.0))
    steps = [_towards(problem, now, np.asarray(detected)), parameter_step(problem, now)]
    if not now.attached.any():
        steps.append(common_factor_step(problem, now))
    return [*steps, _towards(problem, now, np.asarray(likeliest(now.belief)))] if likeliest_set else steps


def parameter_step(problem: Problem, now: Fitted) -> Step:
    """Return the step of the parameters alone."""
    return _towards(problem, now, now.point.s)


def common_factor_step(problem: Problem, now: Fitted) -> Step:
    """Return the step of all s by the common factor that fits best, with the parameters marginalised."""
    s, belief = now.point.s, now.belief
    factor = (s @ np.asarray(belief.shift) + FACTOR_PRECISION) / (
        s @ np.asarray(belief.precision) @ s + FACTOR_PRECISION
    )
    return _towards(problem, now, factor * s)


def _towards(problem: Problem, now: Fitted, to: Float[np.ndarray, " n"]) -> Step:
    """Return the step to a given s, with the parameters that fit it best."""
    point, free, sd = now.point, now.free, problem.sd(now.named)
    best = _joint(now.square, point, free, sd).condition(s=to - point.s).mean()
    theta = np.zeros(len(point.theta))
    theta[free] = np.clip(best, -MAX_CHANGE * sd, MAX_CHANGE * sd)
    return theta, to - point.s


def _summary(problem: Problem, square: np.ndarray, point: Point, free: np.ndarray, sd: np.ndarray) -> PosteriorSummary:
    """Return the posterior of the attachments at a point, with the parameters marginalised."""
    step = _joint(square, point, free, sd).marginal("s")
    shift = step.precision @ point.s + step.shift
    return quick_summary(problem.prior.add(jnp.asarray(step.precision), jnp.asarray(shift)))


def _joint(square: np.ndarray, point: Point, free: np.ndarray, sd: np.ndarray) -> GaussianInformation:
    """Return the information about steps of s and of the free parameters, with the prior of the parameters."""
    joint = GaussianInformation.from_normal_equations(square, s=len(point.s), theta=len(free))
    return joint.with_independent("theta", sd**-2, -point.theta[free] / sd**2)


def _cost(problem: Problem, weights: dict[int, FrameLikelihood], point: Point, named: np.ndarray) -> float:
    """Return the cost of a point under weights that may be of another point; see `Fitted.cost`."""
    prior = _prior(point.theta, point.s, problem.free(named), problem.sd(named))
    return cost_under(problem, weights, point) + prior


def _prior(theta: Float[np.ndarray, " p"], s: Float[np.ndarray, " n"], free: np.ndarray, sd: np.ndarray) -> float:
    """Return twice the negative logarithm of the prior, without constants."""
    return 2 * ATTACHMENT_LOG_ODDS * float(np.sum(s > 0)) + float(np.sum((theta[free] / sd) ** 2))
