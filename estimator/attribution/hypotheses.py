"""Effects fitted to what is left: which are tried, from where, and how well each foretells what it never saw."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from ..effects import Effect
from ..parallel_map import parallel_map
from .every_frame import cost_under
from .fit import Fitted, fit, moved, without
from .held_out import HeldOut, held_out
from .problem import Point, Problem
from .scores import Score, bayes_factor, occam, scores
from .unexplained_residual import UnexplainedResidual, unexplained_residual

LOOKED_AT = 3
"""Effects that are fitted, the likeliest by their scores."""
ENTER = 10.0
"""Log Bayes factor from which an effect is looked at, and with which it must lead what has no name [nat]."""
REMAINDER = 60.0
"""What larger errors without a cause may gain before something is said to be left over [nat]."""
COMPARED = 0.5
"""Share of the best log Bayes factor from which effects are compared by what they foretell; and fitted, if often
confused with the best."""
ABSURD = 3.5
"""Prior standard deviations beyond which a parameter makes no sense."""
START = 2.0
"""Prior standard deviations within which a fit begins."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Hypothesis:
    """An effect, fitted."""

    score: Score
    effect: Effect
    fitted: Fitted
    log_bayes_factor: float
    """Against the fit without it, the lesser under either's weights."""
    at: np.ndarray
    """Which parameters are its own."""
    sds: np.ndarray
    """Of all that are named in the fit: by its own errors, or by how far parts left out change them, whichever is
    more."""
    left: UnexplainedResidual | None = None
    folds: list[HeldOut] | None = None

    @property
    def theta(self) -> np.ndarray:
        """Its size."""
        return self.fitted.point.theta[self.at]

    @property
    def sd(self) -> np.ndarray:
        """Of its size."""
        return self.sds[np.isin(self.fitted.named, self.at)]

    @property
    def residual(self) -> float:
        """Root mean square error over all parts left out [m]; without any, the less the likelier."""
        return HeldOut.together(self.folds).rms if self.folds else -self.log_bayes_factor

    @property
    def sensible(self) -> bool:
        """Whether its size is."""
        return bool(np.all(np.abs(self.theta) <= ABSURD * np.asarray(self.effect.prior_sd)))


@dataclass(frozen=True, kw_only=True)
class FitContext:
    """The loop before or after an effect was added."""

    fitted: Fitted
    left: UnexplainedResidual
    folds: list[HeldOut]
    """Each part that was fitted to, foretold by a fit without it; none if there are fewer than two."""
    scores: list[Score]


def fitted_hypotheses(
    problem: Problem, context: FitContext, accepted: list[Hypothesis], used: set[int], log: Callable[[str], None]
) -> list[Hypothesis]:
    """The likeliest effects, fitted, the best first, as far as they are worth a look."""
    found = scores(problem, context.fitted)
    context.scores.extend(found)
    log("scores: " + ", ".join(f"{one.name} {one.log_bayes_factor:.1f}" for one in found[:6]))
    hypotheses = [_fitted(problem, context, one, accepted, used) for one in _likely(problem, found)]
    for one in hypotheses:
        log(f"{one.effect.name}: {one.log_bayes_factor:.1f} nat, theta {np.array2string(one.theta, precision=4)}")
    hypotheses = [one for one in hypotheses if one.log_bayes_factor > ENTER and np.any(one.theta != 0)]
    return sorted(hypotheses, key=lambda one: (not one.sensible, -one.log_bayes_factor))


def _likely(problem: Problem, found: list[Score]) -> list[Score]:
    """Those worth a fit: the likeliest, and what the first of them is often confused with, if it is not far behind."""
    entering = [one for one in found if one.log_bayes_factor > ENTER]
    if not entering:
        return []
    first = entering[0]
    confused = problem.sheet.effect(first.name).confounded_with
    near = [one for one in entering[LOOKED_AT:] if one.log_bayes_factor > COMPARED * first.log_bayes_factor]
    return entering[:LOOKED_AT] + [one for one in near if one.name in confused]


def refined(problem: Problem, hypothesis: Hypothesis, used: set[int], log: Callable[[str], None]) -> Hypothesis:
    """With what it leaves over and how it foretells."""
    left = unexplained_residual(problem, hypothesis.fitted)
    fits = left_out(problem, hypothesis.fitted, used)
    folds = held_out(problem, fits)
    thetas = [one.point.theta[hypothesis.fitted.named] for one in fits.values()]
    found = replace(
        hypothesis, left=left, folds=folds, sds=np.maximum(hypothesis.sds, jackknife_sd(thetas, len(hypothesis.sds)))
    )
    how_well = f", foretells to {1e3 * found.residual:.2f} mm" if found.folds else ""
    log(f"{hypothesis.effect.name} leaves {left.gain:.1f} nat to larger errors{how_well}")
    return found


def reported_sd(problem: Problem, hypothesis: Hypothesis) -> np.ndarray:
    """What is said of how well an effect's size is known, by its standard deviation.

    The model errs in part alike in all grasps, which no number of them averages away: as one of them would tell it. And
    what any sheet has of it by itself may be of either sign.
    """
    own = dict(zip(problem.own.tolist(), problem.own_sd.tolist(), strict=True))
    alone = np.sqrt(max(len(hypothesis.folds or []), 1)) * hypothesis.sd
    return np.hypot(alone, [own.get(k, 0.0) for k in hypothesis.at.tolist()])


def refitted(problem: Problem, hypothesis: Hypothesis, fitted: Fitted) -> Hypothesis:
    """The same effect by another fit; what that leaves and foretells is not known yet."""
    return replace(hypothesis, fitted=fitted, sds=occam(problem, fitted)[1], left=None, folds=None)


def _fitted(
    problem: Problem, context: FitContext, score: Score, accepted: list[Hypothesis], used: set[int]
) -> Hypothesis:
    effect = problem.sheet.effect(score.name)
    at = problem.sheet.place(effect.name, score.site)
    named = np.concatenate([*(one.at for one in accepted), at])
    before = context.fitted
    point = _stepped(problem, before, effect, at, score) if score.began is None else score.began
    fitted = fit(problem, named.astype(int), point, used)
    return Hypothesis(
        score=score,
        effect=effect,
        fitted=fitted,
        log_bayes_factor=bayes_factor(problem, fitted, before, effect.sites)[1],
        at=at,
        sds=occam(problem, fitted)[1],
    )


def _stepped(problem: Problem, before: Fitted, effect: Effect, at: np.ndarray, score: Score) -> Point:
    """From where there is no such effect by a linear step, unless that leads astray."""
    limit = START * problem.prior_sd[at]
    step = np.clip(before.point.theta[at] + score.theta, 0.0 if effect.non_negative else -limit, limit)
    point = moved(problem, before, at, step)
    return before.point if cost_under(problem, before.weights, point) > before.cost else point


def left_out(problem: Problem, fitted: Fitted, used: set[int]) -> dict[int, Fitted]:
    """A fit without each part; none if there are fewer than two."""
    return parallel_map(lambda part: without(problem, fitted, part), sorted(used) if len(used) > 1 else [])


def jackknife_sd(thetas: list[np.ndarray], size: int) -> np.ndarray:
    """The jackknife's standard error of parameters, of fits without one part each; zero if there is none.

    Grasps disagree by more than their noise where the model is wrong in other ways too [Miller 1974,
    doi:10.1093/biomet/61.1.1]. Such a fit is one step from the whole one, so that this is the least.
    """
    if not thetas:
        return np.zeros(size)
    off = np.array(thetas) - np.mean(thetas, axis=0)
    return np.sqrt((len(thetas) - 1) / len(thetas) * np.sum(off**2, axis=0))
