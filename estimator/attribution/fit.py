"""Stiffnesses and the parameters of some effects, fitted to a recording's predicted equilibria together.

Gauss-Newton with the weights of the state at hand [iteratively reweighted: Green 1984, JRSS B 46:149]: a step is taken
if it lessens the misfit under the weights that it was reckoned with, so that nothing is won by weights that forgive
more. Stiffnesses go where the belief says.
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
from .linear import Metric, NormalEquations
from .normal_equations import reduced
from .problem import Point, Problem
from .sheet import predict_all

ODDS = 2.2
"""What an attachment costs: the logarithm of nine to one [nat]."""
STIFFEST = 0.98
"""Largest bounded stiffness."""
PASSES, PATIENCE = 10, 2
"""Most Gauss-Newton steps, and most in turn after which the cost under its own weights is no less than it was before: a
fit that leads to where weights forgive more, and back, is taken where it cost least."""
SHORTER = (1.0, 0.4, 0.15, 0.05)
"""Shares of a step that are tried."""
FARTHEST, OWN_FARTHEST, FAR = 4.0, 3.0, 1.5
"""Most that an effect's parameter and one of the sheet's own may be from 0, and that one may change in a step, in prior
standard deviations."""
GAIN = 2.5e-4
"""Share of its cost by which normal equations must promise that a step lessens it; below, the fit has come to its end.
What they promise is kept to within a third near there, and to weigh all frames anew costs ten times a prediction."""
LEAST = 1e-2
"""Precision with which a factor of all s is 1, as nothing tells it where none is attached."""
Step = tuple[Float[np.ndarray, " p"], Float[np.ndarray, " n"]]
"""Of the parameters and of s."""


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """The end of a fit."""

    point: Point
    around: Point
    """Where weights were reckoned and frames linearised: `point`, or a step before it."""
    named: np.ndarray
    """Parameters of the effects that are taken to be there."""
    free: np.ndarray
    """All that were fitted, the sheet's own among them."""
    square: Float[np.ndarray, "k k"]
    """Normal equations, over s, the free parameters and -1."""
    equations: dict[int, NormalEquations]
    weights: dict[int, Metric]
    """By frame."""
    summary: PosteriorSummary
    """What is believed of the attachments, whatever the free parameters are."""
    cost: float
    """Twice the negative logarithm of likelihood and prior under its own weights [nat]."""

    @property
    def belief(self) -> AttachmentBelief:
        """Of the attachments."""
        assert isinstance(self.summary.belief, AttachmentBelief)
        return self.summary.belief

    @property
    def site_precision(self) -> Float[np.ndarray, " n"]:
        """How sure the belief is of each s besides what frames say."""
        return np.asarray(self.belief.site_precision)

    @property
    def probability(self) -> Float[np.ndarray, " n"]:
        """P(attached) of each. Of attachments that are likeliest together none need be likely by itself."""
        return np.asarray(self.summary.probability)

    @property
    def attached(self) -> Bool[np.ndarray, " n"]:
        """What is likelier attached than not."""
        return self.probability > 0.5


def start(problem: Problem, theta: np.ndarray, s: np.ndarray, states: np.ndarray, frames: list[int]) -> Point:
    """A point and what it predicts."""
    states, seen = predict_all(problem.sheet, theta, s, problem.history, states, only=frames)
    return Point(theta=theta, s=s, states=states, seen=seen)


def moved(problem: Problem, fitted: Fitted, at: np.ndarray, theta: np.ndarray) -> Point:
    """A fit's point with other values of some parameters, and what it predicts then."""
    changed = fitted.point.theta.copy()
    changed[at] = theta
    return start(problem, changed, fitted.point.s, fitted.point.states, list(fitted.equations))


def fit(
    problem: Problem,
    named: np.ndarray,
    point: Point,
    parts: set[int],
    *,
    passes: int = PASSES,
    log: Callable[[str], None] = lambda _: None,
) -> Fitted:
    """From a point, over the named parameters, the sheet's own and all stiffnesses, to frames of some parts."""
    now = best = _linearise_at(problem, named, point, problem.frames(parts))
    waited = 0
    for count in range(passes):
        if (better := _better(problem, now, _steps(problem, now))) is None:
            break
        hypothesis, cost = better
        log(f"pass {count + 1}: {now.cost / 2:.1f} -> {cost / 2:.1f} nat")
        there = _linearise_at(problem, named, hypothesis, problem.frames(parts))
        if not np.isfinite(there.cost):
            break
        now = there
        best, waited = (now, 0) if now.cost < best.cost else (best, waited + 1)
        if waited == PATIENCE:
            return _to_its_end(problem, best)
    return _to_its_end(problem, now)


def without(problem: Problem, fitted: Fitted, part: int) -> Fitted:
    """One more step from the end of a fit, with the frames of one part left out, by what is known there already.

    Not to the attachments likeliest together: of many that are as likely, they are some, and fewer frames would take
    others at random.
    """
    left = [k for k in fitted.equations if problem.history.frames[k].part != part]
    equations, weights = {k: fitted.equations[k] for k in left}, {k: fitted.weights[k] for k in left}
    now = replace(_found(problem, fitted.named, fitted.point, equations, weights), around=fitted.around)
    better = _better(problem, now, _steps(problem, now, together=False), least=0.0)
    return now if better is None else replace(now, point=better[0], cost=better[1])


def doubted(problem: Problem, fitted: Fitted, excess: float) -> Fitted:
    """A fit as it is believed where what it never saw is missed by `excess` times the stated variance.

    All that its frames say counts by as much less: quasi-likelihood [Wedderburn 1974, doi:10.1093/biomet/61.3.439].
    """
    sd = problem.sd(fitted.named)
    return replace(fitted, summary=_summary(problem, fitted.square / excess, fitted.point, fitted.free, sd))


def gains_over(problem: Problem, better: Fitted, plain: Fitted) -> tuple[float, float]:
    """By how much one fit explains the frames better than another, under its own weights and under the other's [nat].

    Weights of different fits forgive different things, so that gains under one fit's alone do not compare.
    """
    plain_there = _cost(problem, better.weights, plain.point, plain.named)
    better_there = _cost(problem, plain.weights, better.point, better.named)
    return (plain_there - better.cost) / 2, (plain.cost - better_there) / 2


def _linearise_at(problem: Problem, named: np.ndarray, point: Point, frames: list[int]) -> Fitted:
    """A point with what is known there."""
    along = directions(problem, problem.free(named))
    weights = weighed(problem, point, frames)
    return _found(problem, named, point, linearised(problem, point, weights, along), weights)


def _found(
    problem: Problem, named: np.ndarray, point: Point, equations: dict[int, NormalEquations], weights: dict[int, Metric]
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


def _to_its_end(problem: Problem, now: Fitted) -> Fitted:
    """One more step of the parameters alone, by what is known there already, however little it promises.

    Other attachments that fit about as well may lie far off, where the weights do not hold. What is believed of them is
    so whatever the parameters are.
    """
    theta, s = _after(problem, now, _at_hand(problem, now), 1.0)
    point = start(problem, theta, s, now.point.states, list(now.equations))
    cost = _cost(problem, now.weights, point, now.named)
    if not cost < now.cost:
        return now
    n = len(s)
    gone = np.zeros(len(now.equations[min(now.equations)].square))
    gone[n : n + len(now.free)], gone[-1] = (theta - now.point.theta)[now.free], 1.0
    equations = {k: _transferred(one, gone) for k, one in now.equations.items()}
    square = reduced(problem, equations, len(now.free))
    return replace(now, point=point, equations=equations, square=square, cost=cost)


def _transferred(normal_equations: NormalEquations, gone: Float[np.ndarray, " k"]) -> NormalEquations:
    """A frame's normal equations about a point that is so far off, 1 at the end, as linear as they are."""
    square, tool = np.array(normal_equations.square), np.array(normal_equations.tool)
    square[:, -1] = square @ gone
    square[-1] = gone @ square
    tool[:, -1] = tool @ gone[-tool.shape[1] :]
    return NormalEquations(square=jnp.asarray(square), tool=jnp.asarray(tool))


def _better(problem: Problem, now: Fitted, steps: list[Step], *, least: float = GAIN) -> tuple[Point, float] | None:
    """A point where the cost is less, and that; None if normal equations promise no more than `least` of it.

    Of shares of steps the one that promises most is tried first. Samples may ask for stiffnesses that fit worse, where
    a step of the parameters alone promises more.
    """
    there = [_after(problem, now, step, share) for step in steps for share in SHORTER]
    promised = np.array([_promised(problem, now, theta, s) for theta, s in there])
    for k in np.argsort(-promised, kind="stable"):
        if promised[k] <= least * now.cost:
            return None
        theta, s = there[k]
        hypothesis = start(problem, theta, s, now.point.states, list(now.equations))
        cost = _cost(problem, now.weights, hypothesis, now.named)
        if cost < now.cost:
            return hypothesis, cost
    return None


def _after(problem: Problem, now: Fitted, step: Step, share: float) -> Step:
    """The parameters and s after a share of a step, as far as they may go."""
    free, sd = now.free, problem.sd(now.named)
    most = np.where(np.arange(len(free)) < len(now.named), FARTHEST, OWN_FARTHEST) * sd
    theta = now.point.theta + share * step[0]
    theta[free] = np.clip(theta[free], np.maximum(problem.least(free), -most), most)
    return theta, np.clip(now.point.s + share * step[1], 0, STIFFEST)


def _promised(problem: Problem, now: Fitted, theta: Float[np.ndarray, " p"], s: Float[np.ndarray, " n"]) -> float:
    """By how much the cost would be less there, by the normal equations."""
    free, sd, point = now.free, problem.sd(now.named), now.point
    gone = np.concatenate([s - point.s, (theta - point.theta)[free], [1.0]])
    less = float(now.square[-1, -1] - gone @ now.square @ gone)
    return less + _prior(point.theta, point.s, free, sd) - _prior(theta, s, free, sd)


def _steps(problem: Problem, now: Fitted, *, together: bool = True) -> list[Step]:
    """To the s that samples find attached one by one, at the s at hand, and to those likeliest together.

    Each with the parameters that fit it best. Where any of many may carry a load, none of them is likelier attached
    than not, and yet one must be. Nor is any where a load is lighter than was thought, as all that carry it are softer
    but none of them by itself: there all s may go by one factor. Elsewhere what fits best so would follow the noise.
    """
    found = problem.prior.bounded(jnp.where(now.summary.probability > 0.5, now.summary.b, 0.0))
    steps = [_towards(problem, now, np.asarray(found)), _at_hand(problem, now)]
    if not now.attached.any():
        steps.append(_by_one_factor(problem, now))
    return [*steps, _towards(problem, now, np.asarray(likeliest(now.belief)))] if together else steps


def _at_hand(problem: Problem, now: Fitted) -> Step:
    """Of the parameters alone."""
    return _towards(problem, now, now.point.s)


def _by_one_factor(problem: Problem, now: Fitted) -> Step:
    """To all s at hand times what fits best, whatever the parameters are."""
    s, told = now.point.s, now.belief
    factor = (s @ np.asarray(told.shift) + LEAST) / (s @ np.asarray(told.precision) @ s + LEAST)
    return _towards(problem, now, factor * s)


def _towards(problem: Problem, now: Fitted, to: Float[np.ndarray, " n"]) -> Step:
    """To some s, with the parameters that fit it best."""
    point, free, sd = now.point, now.free, problem.sd(now.named)
    best = _joint(now.square, point, free, sd).condition(s=to - point.s).mean()
    theta = np.zeros(len(point.theta))
    theta[free] = np.clip(best, -FAR * sd, FAR * sd)
    return theta, to - point.s


def _summary(problem: Problem, square: np.ndarray, point: Point, free: np.ndarray, sd: np.ndarray) -> PosteriorSummary:
    """What is believed of the attachments there, the parameters marginalised."""
    step = _joint(square, point, free, sd).marginal("s")
    shift = step.precision @ point.s + step.shift
    return quick_summary(problem.prior.add(jnp.asarray(step.precision), jnp.asarray(shift)))


def _joint(square: np.ndarray, point: Point, free: np.ndarray, sd: np.ndarray) -> GaussianInformation:
    """Return the information about steps of s and of the free parameters, with the prior of the parameters."""
    joint = GaussianInformation.from_normal_equations(square, s=len(point.s), theta=len(free))
    return joint.with_independent("theta", sd**-2, -point.theta[free] / sd**2)


def _cost(problem: Problem, weights: dict[int, Metric], point: Point, named: np.ndarray) -> float:
    """Of a point with those parameters free, under weights that may have been reckoned elsewhere; see `Fitted.cost`."""
    prior = _prior(point.theta, point.s, problem.free(named), problem.sd(named))
    return cost_under(problem, weights, point) + prior


def _prior(theta: Float[np.ndarray, " p"], s: Float[np.ndarray, " n"], free: np.ndarray, sd: np.ndarray) -> float:
    """Twice the logarithm of the prior, its constants left out."""
    return 2 * ODDS * float(np.sum(s > 0)) + float(np.sum((theta[free] / sd) ** 2))
