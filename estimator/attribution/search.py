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
from .hypotheses import COMPARED, ENTER, REMAINDER, FitContext, Hypothesis, fitted_hypotheses, refined, refitted
from .problem import Problem
from .scores import bayes_factor

MOST = 3
"""Effects that are added at most."""
Log = Callable[[str], None]
Refused = list[tuple[Hypothesis, str]]
"""Effects, and why not."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AddedHypothesis:
    """An effect, and what else was judged in its place."""

    hypothesis: Hypothesis
    rivals: list[Hypothesis]
    """It could not be told from these."""
    others: Refused
    """And these were refused there."""

    @property
    def context(self) -> FitContext:
        """Where the loop is with it."""
        assert self.hypothesis.left is not None and self.hypothesis.folds is not None
        return FitContext(
            fitted=self.hypothesis.fitted, left=self.hypothesis.left, folds=self.hypothesis.folds, scores=[]
        )


def following(
    problem: Problem, context: FitContext, added: list[AddedHypothesis], used: set[int], log: Log
) -> tuple[list[AddedHypothesis], Refused]:
    """What there is in the model after a stage, and what is refused by itself; nothing new where nothing helps.

    An effect, which knows itself what was refused in its place; or two, where much is left over, none helps by itself,
    and another does beside one that was refused here, or in the place of the last.
    """
    accepted = [one.hypothesis for one in added]
    passed, refused = _tried(problem, context, [(context, 0.0)], accepted, used, log)
    if passed:
        return [*added, _chosen(passed, refused)], []
    if context.left.gain > REMAINDER:
        starts = [(added, [one for one, _ in refused], 0.0)]
        starts += [(added[:-1], _else(added[-1]), -accepted[-1].log_bayes_factor)] if added else []
        for before, firsts, head_start in starts:
            if two := _two(problem, context, before, firsts, head_start, used, log):
                return [*before, *two], refused
    return added, refused


def revised(problem: Problem, added: list[AddedHypothesis], used: set[int], log: Log) -> list[AddedHypothesis]:
    """Each but the last compared again with what was tried in its place; dropped where it is not needed any more."""
    for k in range(len(added) - 1):
        one, rest = added[k], [*added[:k], *added[k + 1 :]]
        names = [other.hypothesis.effect.name for other in rest]
        log(f"{one.hypothesis.effect.name} again, beside {' and '.join(names)}")
        others = [hypothesis for hypothesis in _else(one) if hypothesis.effect.name not in names]
        plain, hypotheses = _beside(problem, added[-1].hypothesis, one.hypothesis, others, used, log)
        needed = [hypothesis for hypothesis in hypotheses if hypothesis.log_bayes_factor > ENTER]
        if not needed:
            log(f"{one.hypothesis.effect.name} dropped")
            last = refined(problem, refitted(problem, rest[-1].hypothesis, plain), used, log)
            rest = rest[:k] + [_without(one, other) for other in rest[k:]]
            return [replace(other, hypothesis=_with(other.hypothesis, last)) for other in rest]
        again = _chosen(needed, [pair for pair in one.others if pair[0] not in others])
        rest = [replace(other, hypothesis=_with(other.hypothesis, again.hypothesis)) for other in rest]
        added = [*rest[:k], again, *rest[k:]]
    return added


def _tried(
    problem: Problem,
    context: FitContext,
    yardsticks: list[tuple[FitContext, float]],
    accepted: list[Hypothesis],
    used: set[int],
    log: Log,
) -> tuple[list[Hypothesis], Refused]:
    """Effects added to a stage that are better than other stages, and those that are not.

    Than each of these the stage is likelier by a head start [nat]. Until one is better, none is added in place of a far
    likelier one.
    """
    passed: list[Hypothesis] = []
    refused: Refused = []
    for hypothesis in fitted_hypotheses(problem, context, accepted, used, log):
        if passed and hypothesis.log_bayes_factor < COMPARED * passed[0].log_bayes_factor:
            break
        tried = refined(problem, hypothesis, used, log)
        whys = [against(tried, yardstick, head_start) for yardstick, head_start in yardsticks]
        whys += [] if passed else [outdone(tried, [other for other, _ in refused])]
        if why := next(filter(None, whys), None):
            refused.append((tried, why))
            log(f"{hypothesis.effect.name} refused: {why}")
        else:
            passed.append(tried)
    return passed, refused


def _two(
    problem: Problem,
    yardstick: FitContext,
    before: list[AddedHypothesis],
    firsts: list[Hypothesis],
    head_start: float,
    used: set[int],
    log: Log,
) -> list[AddedHypothesis]:
    """The likeliest of some effects with another beside it, if both are better than a yardstick and than it alone."""
    firsts = [one for one in firsts if one.sensible]
    if not firsts or len(before) + 2 > MOST:
        return []
    first = max(firsts, key=lambda one: one.log_bayes_factor)
    log(f"looking beside {first.effect.name}")
    one = AddedHypothesis(
        hypothesis=first, rivals=[], others=[(other, behind(other, first)) for other in firsts if other is not first]
    )
    accepted = [*(other.hypothesis for other in before), first]
    yardsticks = [(yardstick, first.log_bayes_factor + head_start), (one.context, 0.0)]
    passed, _ = _tried(problem, one.context, yardsticks, accepted, used, log)
    return [one, _chosen(passed, [])] if passed else []


def _chosen(passed: list[Hypothesis], refused: Refused) -> AddedHypothesis:
    chosen = best(passed)
    rivals = [one for one in passed if one is not chosen and not_told_from(one, chosen)]
    fell_behind = [one for one in passed if one is not chosen and one not in rivals]
    others = refused + [(one, behind(one, chosen)) for one in fell_behind]
    return AddedHypothesis(hypothesis=chosen, rivals=rivals, others=others)


def _else(added: AddedHypothesis) -> list[Hypothesis]:
    """What may stand in an effect's place."""
    likely = COMPARED * added.hypothesis.log_bayes_factor
    hypotheses = [*added.rivals, *(one for one, _ in added.others)]
    return [one for one in hypotheses if one.sensible and one.log_bayes_factor > likely]


def _without(dropped: AddedHypothesis, later: AddedHypothesis) -> AddedHypothesis:
    """An effect without one before it that was dropped: from which it was not told, so neither is that from it.

    What it was not told from beside that one stands only if it was in question in that one's place too.
    """
    in_question = [hypothesis.effect.name for hypothesis in _else(dropped)]
    rivals = [rival for rival in later.rivals if rival.effect.name in in_question]
    if later.hypothesis.effect.name in [rival.effect.name for rival in dropped.rivals]:
        rivals.append(dropped.hypothesis)
    return replace(later, rivals=rivals)


def _beside(
    problem: Problem, last: Hypothesis, one: Hypothesis, others: list[Hypothesis], used: set[int], log: Log
) -> tuple[Fitted, list[Hypothesis]]:
    """The last fit without an effect, and with each of those that may stand in its place."""
    named = last.fitted.named[~np.isin(last.fitted.named, one.at)]
    plain = fit(problem, named, moved(problem, last.fitted, one.at, np.zeros(len(one.at))), used)
    hypotheses = []
    for hypothesis in [one, *others]:
        if hypothesis is one:
            found = _with(hypothesis, last)
        else:
            point = moved(problem, plain, hypothesis.at, hypothesis.theta)
            fitted = fit(problem, np.append(named, hypothesis.at), point, used)
            found = refined(problem, refitted(problem, hypothesis, fitted), used, log)
        gain = bayes_factor(problem, found.fitted, plain, hypothesis.effect.sites)[1]
        log(f"{hypothesis.effect.name}: {gain:.1f} nat beside the others")
        hypotheses.append(replace(found, log_bayes_factor=gain))
    return plain, hypotheses


def _with(one: Hypothesis, last: Hypothesis) -> Hypothesis:
    """An effect as a later fit has it."""
    return replace(one, fitted=last.fitted, sds=last.sds, left=last.left, folds=last.folds)
