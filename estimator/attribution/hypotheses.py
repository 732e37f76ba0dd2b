"""Fit effects to the residual: which are fitted, from which start, and how well each predicts held-out parts."""

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

N_FITTED = 3
"""Number of effects that are fitted, the likeliest by their scores."""
MIN_LOG_BAYES_FACTOR = 10.0
"""Log Bayes factor from which an effect is fitted, and by which it must lead larger unexplained errors [nat]."""
MAX_UNEXPLAINED_GAIN = 60.0
"""Largest gain of larger unexplained errors with which the residual still counts as explained [nat]."""
COMPARED_SHARE = 0.5
"""Share of the best log Bayes factor from which effects are compared by held-out predictions; and fitted, if they are
often confused with the best."""
MAX_PRIOR_SDS = 3.5
"""Largest plausible size of a parameter [prior standard deviations]."""
MAX_START_SDS = 2.0
"""Largest size of a parameter at the start of a fit [prior standard deviations]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Hypothesis:
    """A fitted effect."""

    score: Score
    """Score of the effect in the fit without it."""
    effect: Effect
    """The effect."""
    fitted: Fitted
    """Fit with the effect in the model."""
    log_bayes_factor: float
    """Log Bayes factor against the fit without it, the smaller one under either's weights [nat]."""
    at: np.ndarray
    """Indices of its parameters."""
    sds: np.ndarray
    """Standard deviation of all effects' parameters in the fit: by its covariance, or by how much they change without
    one part, whichever is larger."""
    unexplained: UnexplainedResidual | None = None
    """Unexplained residual of the fit; None before `refined`."""
    folds: list[HeldOut] | None = None
    """Prediction of each part by the fit without it; None before `refined`."""

    @property
    def theta(self) -> np.ndarray:
        """Return the effect's parameters."""
        return self.fitted.point.theta[self.at]

    @property
    def sd(self) -> np.ndarray:
        """Return the standard deviations of the effect's parameters."""
        return self.sds[np.isin(self.fitted.named, self.at)]

    @property
    def held_out_rms(self) -> float:
        """Return the root mean square error of all held-out parts [m]; without any, minus the log Bayes factor."""
        return HeldOut.together(self.folds).rms if self.folds else -self.log_bayes_factor

    @property
    def sensible(self) -> bool:
        """Return whether the size of all parameters is plausible under the prior."""
        return bool(np.all(np.abs(self.theta) <= MAX_PRIOR_SDS * np.asarray(self.effect.prior_sds[self.score.site])))


@dataclass(frozen=True, kw_only=True)
class FitContext:
    """A fit before or after an effect is added, with what further effects are compared to."""

    fitted: Fitted
    """The fit."""
    unexplained: UnexplainedResidual
    """Unexplained residual of the fit."""
    folds: list[HeldOut]
    """Prediction of each part by the fit without it; empty if there are fewer than two."""
    scores: list[Score]
    """Scores of all other effects, filled in when they are computed."""


def fitted_hypotheses(
    problem: Problem, context: FitContext, accepted: list[Hypothesis], used: set[int], log: Callable[[str], None]
) -> list[Hypothesis]:
    """Return the likeliest effects, fitted, the best first; only those above `MIN_LOG_BAYES_FACTOR`."""
    found = scores(problem, context.fitted)
    context.scores.extend(found)
    log("scores: " + ", ".join(f"{one.name} {one.log_bayes_factor:.1f}" for one in found[:6]))
    hypotheses = [_fitted(problem, context, one, accepted, used) for one in _likely(problem, found)]
    for one in hypotheses:
        log(f"{one.effect.name}: {one.log_bayes_factor:.1f} nat, theta {np.array2string(one.theta, precision=4)}")
    hypotheses = [one for one in hypotheses if one.log_bayes_factor > MIN_LOG_BAYES_FACTOR and np.any(one.theta != 0)]
    return sorted(hypotheses, key=lambda one: (not one.sensible, -one.log_bayes_factor))


def _likely(problem: Problem, found: list[Score]) -> list[Score]:
    """Return the scores of effects to fit: the likeliest, and close ones that the first is often confused with."""
    entering = [one for one in found if one.log_bayes_factor > MIN_LOG_BAYES_FACTOR]
    if not entering:
        return []
    first = entering[0]
    confused = problem.sheet.effect(first.name).confounded_with
    near = [one for one in entering[N_FITTED:] if one.log_bayes_factor > COMPARED_SHARE * first.log_bayes_factor]
    return entering[:N_FITTED] + [one for one in near if one.name in confused]


def refined(problem: Problem, hypothesis: Hypothesis, used: set[int], log: Callable[[str], None]) -> Hypothesis:
    """Return a hypothesis with its unexplained residual, held-out predictions and jackknife errors."""
    unexplained = unexplained_residual(problem, hypothesis.fitted)
    fits = leave_one_out(problem, hypothesis.fitted, used)
    folds = held_out(problem, fits)
    thetas = [one.point.theta[hypothesis.fitted.named] for one in fits.values()]
    sds = np.maximum(hypothesis.sds, jackknife_sd(thetas, len(hypothesis.sds)))
    result = replace(hypothesis, unexplained=unexplained, folds=folds, sds=sds)
    predicts = f", predicts held-out parts to {1e3 * result.held_out_rms:.2f} mm" if result.folds else ""
    log(f"{hypothesis.effect.name}: unexplained residual {unexplained.gain:.1f} nat{predicts}")
    return result


def reported_sd(problem: Problem, hypothesis: Hypothesis) -> np.ndarray:
    """Return the standard deviation that is reported for an effect's parameters.

    The model's errors are partly the same in all grasps, and do not average out over them: so it is that of one part
    alone. The prior of the nuisance parameter of the same name is added, which may have either sign.
    """
    own = dict(zip(problem.own.tolist(), problem.own_sd.tolist(), strict=True))
    alone = np.sqrt(max(len(hypothesis.folds or []), 1)) * hypothesis.sd
    return np.hypot(alone, [own.get(k, 0.0) for k in hypothesis.at.tolist()])


def refitted(problem: Problem, hypothesis: Hypothesis, fitted: Fitted) -> Hypothesis:
    """Return the same effect in another fit, without unexplained residual and held-out predictions yet."""
    return replace(hypothesis, fitted=fitted, sds=occam(problem, fitted)[1], unexplained=None, folds=None)


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
    """Return the point after a linear step of an effect from a fit without it; that fit's if the step costs more."""
    limit = MAX_START_SDS * problem.prior_sd[at]
    step = np.clip(before.point.theta[at] + score.theta, np.maximum(problem.lower_bounds(at), -limit), limit)
    point = moved(problem, before, at, step)
    return before.point if cost_under(problem, before.weights, point) > before.cost else point


def leave_one_out(problem: Problem, fitted: Fitted, used: set[int]) -> dict[int, Fitted]:
    """Return a fit without each part; empty if there are fewer than two."""
    return parallel_map(lambda part: without(problem, fitted, part), sorted(used) if len(used) > 1 else [])


def jackknife_sd(thetas: list[np.ndarray], size: int) -> np.ndarray:
    """Return the jackknife standard error of parameters from fits without one part each; zero if there is none.

    Grasps disagree by more than their noise where the model is wrong in other ways too [Miller 1974,
    doi:10.1093/biomet/61.1.1]. Each fit is one step from that to all parts, so that this is a lower bound.
    """
    if not thetas:
        return np.zeros(size)
    deviation = np.array(thetas) - np.mean(thetas, axis=0)
    return np.sqrt((len(thetas) - 1) / len(thetas) * np.sum(deviation**2, axis=0))
