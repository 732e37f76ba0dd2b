"""Closing the loop: which effect the model lacks, added if frames that it never saw are foretold better with it.

Fit with what is declared, score every effect at what is left, fit again with each of the likeliest; of those that beat
larger errors without a cause, make sense by their size and foretell what is left out of the fit better, keep the one
that foretells it best, or the likeliest of those that do it about as well. Again for a second and a third.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jiggle_mj.estimator.attribution.fit import STIFFEST, Fitted, fit, start
from jiggle_mj.estimator.attribution.gather import Gathered
from jiggle_mj.estimator.attribution.held_out import Foretold, foretell
from jiggle_mj.estimator.attribution.leftover import leftover
from jiggle_mj.estimator.attribution.problem import Problem
from jiggle_mj.estimator.attribution.trials import (
    ABSURD,
    COMPARED,
    ENTER,
    Stage,
    Trial,
    fitted_trials,
    judged,
    left_out,
)
from jiggle_mj.estimator.attribution.users_effects import check_effects
from jiggle_mj.estimator.effects import LIBRARY, Effect

LEAD = 3.0
"""By how much an effect must lead the next to be named alone, whatever the shares [nat]."""
AS_GOOD, CONFUSED = 0.9, 0.6
"""Shares of its error from which an effect counts as no worse than the best, and one that is often confused with it."""
EXPLAINED = 0.85
"""Share of the best log Bayes factor from which an effect counts as explaining as much."""
MOST = 3
"""Effects that are added at most."""
BETTER, DECISIVE = 0.97, 0.8
"""Shares of the error over all parts left out that an effect must bring it to, and from which on it need not beat
larger errors without a cause."""
REMAINDER = 60.0
"""What larger errors without a cause may gain before something is said to be left over [nat]."""
EXCESS = 5.0
"""The same, by how many times the stated variance parts left out may be missed."""
LEFT_OVER = ("unexplained", "effect-with-remainder")
"""Verdicts that say so."""


@dataclass(frozen=True, kw_only=True)
class Closed:
    """What came of it."""

    verdict: str
    """no-effect, effect, ambiguous, effect-with-remainder or unexplained."""
    accepted: list[Trial]
    rivals: list[list[Trial]]
    """Of each of those accepted: effects that it could not be told from."""
    refused: list[tuple[Trial, str]]
    stages: list[Stage]
    """The first with what is declared alone."""
    final: Fitted
    """The last stage's fit; where something is left over, again with force errors and fields as large as that takes, so
    that less is called attached for a cause that has no name."""
    reported: tuple[Foretold, Foretold] | None
    """A part that chose no effect, foretold before and after; None if there was none to spare."""
    problem: Problem


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
        trials = fitted_trials(problem, stages[-1], accepted, used, say)
        passed: list[Trial] = []
        for trial in trials:
            if passed and trial.log_bayes_factor < COMPARED * passed[0].log_bayes_factor:
                break
            tried = judged(problem, trial, used, say)
            why = _against(tried, stages[-1])
            if why is None:
                passed.append(tried)
            else:
                refused.append((tried, why))
                say(f"{trial.effect.name} refused: {why}")
        if not passed:
            break
        best = _best(passed)
        close = [one for one in passed if one is not best and _not_told_from(one, best)]
        refused += [(one, _behind(one, best)) for one in passed if one is not best and one not in close]
        accepted = [replace(one, fitted=best.fitted, sds=best.sds) for one in accepted] + [best]
        rivals.append(close)
        assert best.left is not None and best.folds is not None
        stages.append(Stage(fitted=best.fitted, left=best.left, folds=best.folds, scores=[]))
        say(f"{best.effect.name} added")
    added = {one.effect.name for one in accepted}
    rivals = [[one for one in group if one.effect.name not in added] for group in rivals]
    reported = None
    if spare is not None:
        before = foretell(problem, stages[0].fitted, spare)
        reported = before, foretell(problem, stages[-1].fitted, spare) if accepted else before
    verdict, last = _verdict(accepted, rivals, stages[-1], reported), stages[-1]
    final = last.fitted
    if verdict in LEFT_OVER:
        say("fitting again with larger errors, for what is left over")
        wider = problem.widened(last.left.variance, last.left.amplitude * problem.amplitude)
        final = fit(wider, final.named, final.point, used)
    return Closed(
        verdict=verdict,
        accepted=accepted,
        rivals=rivals,
        refused=refused,
        stages=stages,
        final=final,
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
    folds = [foretell(problem, one, part) for part, one in left_out(problem, fitted, used).items()]
    return Stage(fitted=fitted, left=leftover(problem, fitted), folds=folds, scores=[])


def _best(passed: list[Trial]) -> Trial:
    """The likeliest of those that foretell about as well as the one that does it best."""
    if not passed[0].folds:
        return max(passed, key=lambda one: one.log_bayes_factor)
    least = min(one.missed for one in passed)
    return max((one for one in passed if one.missed * AS_GOOD <= least), key=lambda one: one.log_bayes_factor)


def _behind(one: Trial, best: Trial) -> str:
    """Why an effect is neither added nor named beside the best."""
    if best.folds and best.missed < one.missed * AS_GOOD:
        return f"{best.effect.name} foretells better, to {1e3 * best.missed:.2f} mm against {1e3 * one.missed:.2f}"
    return f"{best.effect.name} is likelier by {best.log_bayes_factor - one.log_bayes_factor:.0f} nat"


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
    accepted: list[Trial], rivals: list[list[Trial]], last: Stage, reported: tuple[Foretold, Foretold] | None
) -> str:
    missed = [Foretold.together(last.folds)] if last.folds else []
    missed += [] if reported is None else [reported[1]]
    left_over = last.left.gain > REMAINDER or any(one.excess > EXCESS for one in missed)
    if not accepted:
        return "unexplained" if left_over else "no-effect"
    if left_over:
        return "effect-with-remainder"
    return "ambiguous" if any(rivals) else "effect"
