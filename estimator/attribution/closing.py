"""Closing the loop: which effect the model lacks, added if frames that it never saw are foretold better with it.

Fit with what is declared, score every effect at what is left, fit again with each of the likeliest; of those that beat
larger errors without a cause, make sense by their size and foretell what is left out of the fit better, keep the one
that foretells it best, or the likeliest of those that do it about as well. Again for a second and a third.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jiggle_mj.estimator.attribution.fit import STIFFEST, Fitted, cost_under, fit, gains_over, moved, start, without
from jiggle_mj.estimator.attribution.gather import Gathered
from jiggle_mj.estimator.attribution.held_out import Foretold, foretell
from jiggle_mj.estimator.attribution.leftover import Leftover, leftover
from jiggle_mj.estimator.attribution.problem import Point, Problem
from jiggle_mj.estimator.attribution.scores import Score, occam, scores
from jiggle_mj.estimator.attribution.users_effects import check_effects
from jiggle_mj.estimator.effects import LIBRARY, Effect

LOOKED_AT = 3
"""Effects that are fitted, the likeliest by their scores."""
ENTER = 10.0
"""Log Bayes factor from which an effect is looked at, and with which it must lead what has no name [nat]."""
LEAD = 3.0
"""By how much it must lead the next to be named alone, whatever the shares [nat]."""
AS_GOOD, CONFUSED = 0.9, 0.6
"""Shares of its error from which an effect counts as no worse than the best, and one that is often confused with it."""
COMPARED, EXPLAINED = 0.5, 0.85
"""Shares of the best log Bayes factor from which effects are compared by what they foretell (and fitted, if often
confused with the best), and from which they count as explaining as much."""
MOST = 3
"""Effects that are added at most."""
ABSURD = 3.5
"""Prior standard deviations beyond which a parameter makes no sense."""
BETTER, DECISIVE = 0.97, 0.8
"""Shares of the error over all parts left out that an effect must bring it to, and from which on it need not beat
larger errors without a cause."""
START = 2.0
"""Prior standard deviations within which a fit begins."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """An effect, fitted."""

    score: Score
    effect: Effect
    fitted: Fitted
    log_bayes_factor: float
    """Against the fit without it, the lesser under either's weights."""
    at: np.ndarray
    """Which parameters are its own."""
    theta: np.ndarray
    sd: np.ndarray
    """By the fit's own errors, or by how far parts left out change them, whichever is more."""
    left: Leftover | None = None
    folds: list[Foretold] | None = None

    @property
    def missed(self) -> float:
        """Root mean square error over all parts left out [m]; without any, the less the likelier."""
        return Foretold.together(self.folds).rms if self.folds else -self.log_bayes_factor

    @property
    def sensible(self) -> bool:
        """Whether its size is."""
        return bool(np.all(np.abs(self.theta) <= ABSURD * np.asarray(self.effect.prior_sd)))


@dataclass(frozen=True, kw_only=True)
class Stage:
    """The loop before or after an effect was added."""

    fitted: Fitted
    left: Leftover
    folds: list[Foretold]
    """Each part that was fitted to, foretold by a fit without it; none if there are fewer than two."""
    scores: list[Score]


@dataclass(frozen=True, kw_only=True)
class Closed:
    """What came of it."""

    verdict: str
    """no-effect, effect, ambiguous, effect-with-remainder or unexplained."""
    accepted: list[Trial]
    rivals: list[Trial]
    """Effects that one of those accepted could not be told from."""
    refused: list[tuple[Trial, str]]
    stages: list[Stage]
    """The first with what is declared alone."""
    reported: tuple[Foretold, Foretold] | None
    """A part that chose no effect, foretold before and after; None if there was none to spare."""
    problem: Problem


REMAINDER = 60.0
"""What larger errors without a cause may gain before something is said to be left over [nat]."""
EXCESS = 5.0
"""The same, by how many times the stated variance parts left out may be missed."""


def close_the_loop(
    gathered: Gathered, *, library: tuple[Effect, ...] = LIBRARY, say: Callable[[str], None] = lambda _: None
) -> Closed:
    """Over a recording that was followed.

    Args:
        gathered: what was seen.
        library: effects that the model may lack.
        say: told what is being done.

    Raises:
        ValueError: an effect that is not of the library cannot be used; see `check_effects`.
    """
    problem = Problem.build(gathered, library)
    check_effects(problem)
    parts = list(dict.fromkeys(one.part for one in gathered.frames))
    spare = parts[-1] if len(parts) > 1 else None
    used = set(parts) - {spare}
    say(f"fitting {len(problem.frames(used))} frames in {len(used)} parts with what is declared")
    stages, accepted, refused, rivals = [_declared(problem, gathered, used, say)], [], [], []
    while len(accepted) < MOST:
        trials = _trials(problem, stages[-1], accepted, used, say)
        passed: list[Trial] = []
        for trial in trials:
            if passed and trial.log_bayes_factor < COMPARED * passed[0].log_bayes_factor:
                break
            judged = _judged(problem, trial, used, say)
            why = _against(judged, stages[-1])
            if why is None:
                passed.append(judged)
            else:
                refused.append((judged, why))
                say(f"{trial.effect.name} refused: {why}")
        if not passed:
            break
        best = _best(passed)
        close = [one for one in passed if one is not best and _not_told_from(one, best)]
        refused += [
            (one, f"{best.effect.name} foretells better, to {1e3 * best.missed:.2f} mm against {1e3 * one.missed:.2f}")
            for one in passed
            if one is not best and one not in close
        ]
        accepted.append(best)
        rivals += close
        assert best.left is not None and best.folds is not None
        stages.append(Stage(fitted=best.fitted, left=best.left, folds=best.folds, scores=[]))
        say(f"{best.effect.name} added")
    reported = None
    if spare is not None:
        before = foretell(problem, stages[0].fitted, spare)
        reported = before, foretell(problem, stages[-1].fitted, spare) if accepted else before
    return Closed(
        verdict=_verdict(accepted, rivals, stages[-1], reported),
        accepted=accepted,
        rivals=rivals,
        refused=refused,
        stages=stages,
        reported=reported,
        problem=problem,
    )


def _declared(problem: Problem, gathered: Gathered, used: set[int], say: Callable[[str], None]) -> Stage:
    """The fit with no effect, from what the filter says."""
    found = gathered.detection
    b = jnp.asarray(np.where(found.attached, found.stiffness, 0.0))
    s = np.minimum(np.asarray(problem.prior.bounded(b)), STIFFEST)
    states = np.array([one.state for one in gathered.frames])
    point = start(problem, np.zeros(problem.sheet.size), s, states, problem.frames(used))
    fitted = fit(problem, np.zeros(0, dtype=int), point, used, say=say)
    folds = [foretell(problem, one, part) for part, one in _left_out(problem, fitted, used).items()]
    return Stage(fitted=fitted, left=leftover(problem, fitted), folds=folds, scores=[])


def _left_out(problem: Problem, fitted: Fitted, used: set[int]) -> dict[int, Fitted]:
    """A fit without each part; none if there are fewer than two."""
    return {part: without(problem, fitted, part) for part in sorted(used)} if len(used) > 1 else {}


def _scatter(thetas: list[np.ndarray], size: int) -> np.ndarray:
    """The jackknife's standard error of parameters [Miller 1974, doi:10.1093/biomet/61.1.1].

    Grasps disagree by more than their noise where the model is wrong in other ways too.
    """
    if not thetas:
        return np.zeros(size)
    off = np.array(thetas) - np.mean(thetas, axis=0)
    return np.sqrt((len(thetas) - 1) / len(thetas) * np.sum(off**2, axis=0))


def _trials(
    problem: Problem, stage: Stage, accepted: list[Trial], used: set[int], say: Callable[[str], None]
) -> list[Trial]:
    """The likeliest effects, fitted, the best first, as far as they are worth a look."""
    found = scores(problem, stage.fitted)
    stage.scores.extend(found)
    say("scores: " + ", ".join(f"{one.name} {one.log_bayes_factor:.1f}" for one in found[:6]))
    trials = [_fitted(problem, stage, one, accepted, used) for one in _likely(problem, found)]
    for one in trials:
        say(f"{one.effect.name}: {one.log_bayes_factor:.1f} nat, theta {np.array2string(one.theta, precision=4)}")
    trials = [one for one in trials if one.log_bayes_factor > ENTER]
    return sorted(trials, key=lambda one: (not one.sensible, -one.log_bayes_factor))


def _likely(problem: Problem, found: list[Score]) -> list[Score]:
    """Those worth a fit: the likeliest, and what the first of them is often confused with, if it is not far behind."""
    entering = [one for one in found if one.log_bayes_factor > ENTER]
    if not entering:
        return []
    first = entering[0]
    confused = problem.sheet.effect(first.name).confounded_with
    near = [one for one in entering[LOOKED_AT:] if one.log_bayes_factor > COMPARED * first.log_bayes_factor]
    return entering[:LOOKED_AT] + [one for one in near if one.name in confused]


def _best(passed: list[Trial]) -> Trial:
    """The likeliest of those that foretell about as well as the one that does it best."""
    if not passed[0].folds:
        return max(passed, key=lambda one: one.log_bayes_factor)
    least = min(one.missed for one in passed)
    return max((one for one in passed if one.missed * AS_GOOD <= least), key=lambda one: one.log_bayes_factor)


def _not_told_from(one: Trial, best: Trial) -> bool:
    """Whether an effect explains as much as the best, and foretells what was left out about as well.

    For two that are often confused with each other it takes less.
    """
    likelier = best.log_bayes_factor - one.log_bayes_factor
    if not best.folds:
        return likelier < LEAD
    if one.effect.name in best.effect.confounded_with and best.effect.name in one.effect.confounded_with:
        return one.missed * CONFUSED <= best.missed
    as_likely = likelier < max(LEAD, (1 - EXPLAINED) * best.log_bayes_factor)
    return as_likely and one.missed * AS_GOOD <= best.missed


def _judged(problem: Problem, trial: Trial, used: set[int], say: Callable[[str], None]) -> Trial:
    """With what it leaves over and how it foretells."""
    left = leftover(problem, trial.fitted)
    fits = _left_out(problem, trial.fitted, used)
    folds = [foretell(problem, one, part) for part, one in fits.items()]
    thetas = [one.point.theta[trial.at] for one in fits.values()]
    judged = replace(trial, left=left, folds=folds, sd=np.maximum(trial.sd, _scatter(thetas, len(trial.at))))
    foretold = f", foretells to {1e3 * judged.missed:.2f} mm" if judged.folds else ""
    say(f"{trial.effect.name} leaves {left.gain:.1f} nat to larger errors{foretold}")
    return judged


def _fitted(problem: Problem, stage: Stage, score: Score, accepted: list[Trial], used: set[int]) -> Trial:
    effect = problem.sheet.effect(score.name)
    at = problem.sheet.place(effect.name, score.site)
    named = np.concatenate([*(problem.sheet.place(one.effect.name, one.score.site) for one in accepted), at])
    before = stage.fitted
    point = _stepped(problem, before, effect, at, score) if score.began is None else score.began
    fitted = fit(problem, named.astype(int), point, used)
    volume, sd = occam(problem, fitted)
    gain = min(gains_over(problem, fitted, before)) - (volume - occam(problem, before)[0]) - np.log(effect.sites)
    return Trial(
        score=score,
        effect=effect,
        fitted=fitted,
        log_bayes_factor=float(gain),
        at=at,
        theta=fitted.point.theta[at],
        sd=sd[-len(at) :],
    )


def _stepped(problem: Problem, before: Fitted, effect: Effect, at: np.ndarray, score: Score) -> Point:
    """From where there is no such effect by a linear step, unless that leads astray."""
    limit = START * problem.prior_sd[at]
    step = np.clip(before.point.theta[at] + score.theta, 0.0 if effect.non_negative else -limit, limit)
    point = moved(problem, before, at, step)
    return before.point if cost_under(problem, before.weights, point) > before.cost else point


def _against(best: Trial, stage: Stage) -> str | None:
    """Why an effect is not added; None if it is."""
    assert best.left is not None and best.folds is not None
    if not best.sensible:
        return f"its size is beyond {ABSURD:g} prior standard deviations"
    before, after = (Foretold.together(parts).rms if parts else 1.0 for parts in (stage.folds, best.folds))
    if after > DECISIVE * before and best.log_bayes_factor + best.left.gain < stage.left.gain + ENTER:
        return "larger errors without a cause explain the frames as well"
    better = sum(b.rms < a.rms for a, b in zip(stage.folds, best.folds, strict=True))
    if stage.folds and (after > BETTER * before or 2 * better <= len(stage.folds)):
        return (
            f"parts left out are foretold to {1e3 * after:.2f} mm with it and {1e3 * before:.2f} mm without, "
            f"better in {better} of {len(stage.folds)}"
        )
    return None


def _verdict(
    accepted: list[Trial], rivals: list[Trial], last: Stage, reported: tuple[Foretold, Foretold] | None
) -> str:
    missed = [Foretold.together(last.folds)] if last.folds else []
    missed += [] if reported is None else [reported[1]]
    left_over = last.left.gain > REMAINDER or any(one.excess > EXCESS for one in missed)
    if not accepted:
        return "unexplained" if left_over else "no-effect"
    if left_over:
        return "effect-with-remainder"
    return "ambiguous" if rivals else "effect"
