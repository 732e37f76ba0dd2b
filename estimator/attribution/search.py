"""Which effect is added next: by itself, or where none helps by itself, two together; and whether earlier ones hold.

Where two effects are missing, what the tool says may foretell worse with the first of them than with neither, as their
errors partly cancel; and the first is fitted to what the second does. So where much is left over, a second is looked
for beside one that was turned down; and each that was added is compared again with what else was tried at its turn,
now beside those that came later.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from .comparison import against, behind, best, not_told_from, outdone
from .fit import Fitted, fit, moved
from .problem import Problem
from .scores import bayes_factor
from .trials import COMPARED, ENTER, REMAINDER, Stage, Trial, fitted_trials, judged, refitted

MOST = 3
"""Effects that are added at most."""
Say = Callable[[str], None]
Refused = list[tuple[Trial, str]]
"""Effects, and why not."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Added:
    """An effect, and what else was judged in its place."""

    trial: Trial
    rivals: list[Trial]
    """It could not be told from these."""
    others: Refused
    """And these were refused there."""

    @property
    def stage(self) -> Stage:
        """Where the loop is with it."""
        assert self.trial.left is not None and self.trial.folds is not None
        return Stage(fitted=self.trial.fitted, left=self.trial.left, folds=self.trial.folds, scores=[])


def following(
    problem: Problem, stage: Stage, added: list[Added], used: set[int], say: Say
) -> tuple[list[Added], Refused]:
    """What there is in the model after a stage, and what is refused by itself; nothing new where nothing helps.

    An effect, which knows itself what was refused in its place; or two, where much is left over, none helps by itself,
    and another does beside one that was refused here, or in the place of the last.
    """
    accepted = [one.trial for one in added]
    passed, refused = _tried(problem, stage, [(stage, 0.0)], accepted, used, say)
    if passed:
        return [*added, _chosen(passed, refused)], []
    if stage.left.gain > REMAINDER:
        starts = [(added, [one for one, _ in refused], 0.0)]
        starts += [(added[:-1], _else(added[-1]), -accepted[-1].log_bayes_factor)] if added else []
        for before, firsts, head_start in starts:
            if two := _two(problem, stage, before, firsts, head_start, used, say):
                return [*before, *two], refused
    return added, refused


def revised(problem: Problem, added: list[Added], used: set[int], say: Say) -> list[Added]:
    """Each but the last compared again with what was tried in its place; dropped where it is not needed any more."""
    for k in range(len(added) - 1):
        one, rest = added[k], [*added[:k], *added[k + 1 :]]
        names = [other.trial.effect.name for other in rest]
        say(f"{one.trial.effect.name} again, beside {' and '.join(names)}")
        others = [trial for trial in _else(one) if trial.effect.name not in names]
        plain, trials = _beside(problem, added[-1].trial, one.trial, others, used, say)
        needed = [trial for trial in trials if trial.log_bayes_factor > ENTER]
        if not needed:
            say(f"{one.trial.effect.name} dropped")
            last = judged(problem, refitted(problem, rest[-1].trial, plain), used, say)
            rest = rest[:k] + [_without(one, other) for other in rest[k:]]
            return [replace(other, trial=_with(other.trial, last)) for other in rest]
        again = _chosen(needed, [pair for pair in one.others if pair[0] not in others])
        rest = [replace(other, trial=_with(other.trial, again.trial)) for other in rest]
        added = [*rest[:k], again, *rest[k:]]
    return added


def _tried(
    problem: Problem,
    stage: Stage,
    yardsticks: list[tuple[Stage, float]],
    accepted: list[Trial],
    used: set[int],
    say: Say,
) -> tuple[list[Trial], Refused]:
    """Effects added to a stage that are better than other stages, and those that are not.

    Than each of these the stage is likelier by a head start [nat]. Until one is better, none is added in place of a far
    likelier one.
    """
    passed: list[Trial] = []
    refused: Refused = []
    for trial in fitted_trials(problem, stage, accepted, used, say):
        if passed and trial.log_bayes_factor < COMPARED * passed[0].log_bayes_factor:
            break
        tried = judged(problem, trial, used, say)
        whys = [against(tried, yardstick, head_start) for yardstick, head_start in yardsticks]
        whys += [] if passed else [outdone(tried, [other for other, _ in refused])]
        if why := next(filter(None, whys), None):
            refused.append((tried, why))
            say(f"{trial.effect.name} refused: {why}")
        else:
            passed.append(tried)
    return passed, refused


def _two(
    problem: Problem,
    yardstick: Stage,
    before: list[Added],
    firsts: list[Trial],
    head_start: float,
    used: set[int],
    say: Say,
) -> list[Added]:
    """The likeliest of some effects with another beside it, if both are better than a yardstick and than it alone."""
    firsts = [one for one in firsts if one.sensible]
    if not firsts or len(before) + 2 > MOST:
        return []
    first = max(firsts, key=lambda one: one.log_bayes_factor)
    say(f"looking beside {first.effect.name}")
    one = Added(
        trial=first, rivals=[], others=[(other, behind(other, first)) for other in firsts if other is not first]
    )
    accepted = [*(other.trial for other in before), first]
    yardsticks = [(yardstick, first.log_bayes_factor + head_start), (one.stage, 0.0)]
    passed, _ = _tried(problem, one.stage, yardsticks, accepted, used, say)
    return [one, _chosen(passed, [])] if passed else []


def _chosen(passed: list[Trial], refused: Refused) -> Added:
    chosen = best(passed)
    rivals = [one for one in passed if one is not chosen and not_told_from(one, chosen)]
    fell_behind = [one for one in passed if one is not chosen and one not in rivals]
    others = refused + [(one, behind(one, chosen)) for one in fell_behind]
    return Added(trial=chosen, rivals=rivals, others=others)


def _else(added: Added) -> list[Trial]:
    """What may stand in an effect's place."""
    likely = COMPARED * added.trial.log_bayes_factor
    trials = [*added.rivals, *(one for one, _ in added.others)]
    return [one for one in trials if one.sensible and one.log_bayes_factor > likely]


def _without(dropped: Added, later: Added) -> Added:
    """An effect without one before it that was dropped: from which it was not told, so neither is that from it.

    What it was not told from beside that one stands only if it was in question in that one's place too.
    """
    in_question = [trial.effect.name for trial in _else(dropped)]
    rivals = [rival for rival in later.rivals if rival.effect.name in in_question]
    if later.trial.effect.name in [rival.effect.name for rival in dropped.rivals]:
        rivals.append(dropped.trial)
    return replace(later, rivals=rivals)


def _beside(
    problem: Problem, last: Trial, one: Trial, others: list[Trial], used: set[int], say: Say
) -> tuple[Fitted, list[Trial]]:
    """The last fit without an effect, and with each of those that may stand in its place."""
    named = last.fitted.named[~np.isin(last.fitted.named, one.at)]
    plain = fit(problem, named, moved(problem, last.fitted, one.at, np.zeros(len(one.at))), used)
    trials = []
    for trial in [one, *others]:
        if trial is one:
            found = _with(trial, last)
        else:
            point = moved(problem, plain, trial.at, trial.theta)
            fitted = fit(problem, np.append(named, trial.at), point, used)
            found = judged(problem, refitted(problem, trial, fitted), used, say)
        gain = bayes_factor(problem, found.fitted, plain, trial.effect.sites)[1]
        say(f"{trial.effect.name}: {gain:.1f} nat beside the others")
        trials.append(replace(found, log_bayes_factor=gain))
    return plain, trials


def _with(one: Trial, last: Trial) -> Trial:
    """An effect as a later fit has it."""
    return replace(one, fitted=last.fitted, sds=last.sds, left=last.left, folds=last.folds)
