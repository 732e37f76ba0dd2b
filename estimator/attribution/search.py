"""Search for the effects to add: one, or two together if none helps alone; then compare the earlier ones again.

If two effects are missing, held-out predictions may be worse with the first of them than with neither, because their
errors partly cancel; and the first is fitted to what the second causes. So if the unexplained residual is large, a
second effect is searched for with a refused one in the model. And each added effect is compared again with its
alternatives once the later effects are in the model.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from .comparison import against, behind, best, indistinguishable, outdone
from .fit import Fitted, fit, moved
from .hypotheses import (
    COMPARED_SHARE,
    MAX_UNEXPLAINED_GAIN,
    MIN_LOG_BAYES_FACTOR,
    FitContext,
    Hypothesis,
    fitted_hypotheses,
    refined,
    refitted,
)
from .problem import Problem
from .scores import bayes_factor

MAX_EFFECTS = 3
"""Largest number of effects that are added."""
Log = Callable[[str], None]
"""Receiver of progress messages."""
Refused = list[tuple[Hypothesis, str]]
"""Hypotheses that were not added, with the reason."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AddedHypothesis:
    """An effect that was added, with its alternatives."""

    hypothesis: Hypothesis
    """The effect."""
    rivals: list[Hypothesis]
    """Alternatives that are indistinguishable from it."""
    others: Refused
    """Alternatives that were refused."""

    @property
    def context(self) -> FitContext:
        """Return the fit with the effect, to which further effects are added."""
        unexplained, folds = self.hypothesis.unexplained, self.hypothesis.folds
        assert unexplained is not None and folds is not None
        return FitContext(fitted=self.hypothesis.fitted, unexplained=unexplained, folds=folds, scores=[])


def following(
    problem: Problem, context: FitContext, added: list[AddedHypothesis], used: set[int], log: Log
) -> tuple[list[AddedHypothesis], Refused]:
    """Return the effects in the model after one more search, and the ones refused alone; unchanged if none helps.

    One effect is added, which holds its refused alternatives itself. Two are added if the unexplained residual is
    large, none helps alone, and another one does together with a refused one, or in the place of the last.
    """
    accepted = [one.hypothesis for one in added]
    passed, refused = tested_hypotheses(problem, context, [(context, 0.0)], accepted, used, log)
    if passed:
        return [*added, _chosen(passed, refused)], []
    if context.unexplained.gain > MAX_UNEXPLAINED_GAIN:
        starts = [(added, [one for one, _ in refused], 0.0)]
        starts += [(added[:-1], _alternatives(added[-1]), -accepted[-1].log_bayes_factor)] if added else []
        for before, firsts, head_start in starts:
            if two := two_effects(problem, context, before, firsts, head_start, used, log):
                return [*before, *two], refused
    return added, refused


def revised(problem: Problem, added: list[AddedHypothesis], used: set[int], log: Log) -> list[AddedHypothesis]:
    """Return the effects with each but the last compared again with its alternatives; dropped if no longer needed."""
    for k in range(len(added) - 1):
        one, rest = added[k], [*added[:k], *added[k + 1 :]]
        names = [other.hypothesis.effect.name for other in rest]
        log(f"comparing {one.hypothesis.effect.name} again, with {' and '.join(names)} in the model")
        others = [hypothesis for hypothesis in _alternatives(one) if hypothesis.effect.name not in names]
        plain, hypotheses = alternatives_beside(problem, added[-1].hypothesis, one.hypothesis, others, used, log)
        needed = [hypothesis for hypothesis in hypotheses if hypothesis.log_bayes_factor > MIN_LOG_BAYES_FACTOR]
        if not needed:
            log(f"{one.hypothesis.effect.name} dropped")
            last = refined(problem, refitted(problem, rest[-1].hypothesis, plain), used, log)
            rest = rest[:k] + [_without(one, other) for other in rest[k:]]
            return [replace(other, hypothesis=as_in_fit(other.hypothesis, last)) for other in rest]
        again = _chosen(needed, [pair for pair in one.others if pair[0] not in others])
        rest = [replace(other, hypothesis=as_in_fit(other.hypothesis, again.hypothesis)) for other in rest]
        added = [*rest[:k], again, *rest[k:]]
    return added


def tested_hypotheses(
    problem: Problem,
    context: FitContext,
    references: list[tuple[FitContext, float]],
    accepted: list[Hypothesis],
    used: set[int],
    log: Log,
) -> tuple[list[Hypothesis], Refused]:
    """Return the effects that improve on all reference fits when added to a fit, and those that do not.

    Until one effect improves, none is added in place of a far likelier one.

    Args:
        problem: what is fitted to.
        context: the fit that effects are added to.
        references: fits to compare with, each with the log Bayes factor of `context` against it [nat].
        accepted: effects in `context`.
        used: parts that are fitted to.
        log: receives progress messages.
    """
    passed: list[Hypothesis] = []
    refused: Refused = []
    for hypothesis in fitted_hypotheses(problem, context, accepted, used, log):
        if passed and hypothesis.log_bayes_factor < COMPARED_SHARE * passed[0].log_bayes_factor:
            break
        tested = refined(problem, hypothesis, used, log)
        reasons = [against(tested, reference, head_start) for reference, head_start in references]
        reasons += [] if passed else [outdone(tested, [other for other, _ in refused])]
        if why := next(filter(None, reasons), None):
            refused.append((tested, why))
            log(f"{hypothesis.effect.name} refused: {why}")
        else:
            passed.append(tested)
    return passed, refused


def two_effects(
    problem: Problem,
    reference: FitContext,
    before: list[AddedHypothesis],
    firsts: list[Hypothesis],
    head_start: float,
    used: set[int],
    log: Log,
) -> list[AddedHypothesis]:
    """Return the likeliest of some effects and a second one, if both improve on a reference and on the first alone."""
    firsts = [one for one in firsts if one.sensible]
    if not firsts or len(before) + 2 > MAX_EFFECTS:
        return []
    first = max(firsts, key=lambda one: one.log_bayes_factor)
    log(f"searching for a second effect with {first.effect.name} in the model")
    one = AddedHypothesis(
        hypothesis=first, rivals=[], others=[(other, behind(other, first)) for other in firsts if other is not first]
    )
    accepted = [*(other.hypothesis for other in before), first]
    references = [(reference, first.log_bayes_factor + head_start), (one.context, 0.0)]
    passed, _ = tested_hypotheses(problem, one.context, references, accepted, used, log)
    return [one, _chosen(passed, [])] if passed else []


def _chosen(passed: list[Hypothesis], refused: Refused) -> AddedHypothesis:
    """Return the best of some hypotheses, with the others as its rivals or refused."""
    chosen = best(passed)
    rivals = [one for one in passed if one is not chosen and indistinguishable(one, chosen)]
    fell_behind = [one for one in passed if one is not chosen and one not in rivals]
    others = refused + [(one, behind(one, chosen)) for one in fell_behind]
    return AddedHypothesis(hypothesis=chosen, rivals=rivals, others=others)


def _alternatives(added: AddedHypothesis) -> list[Hypothesis]:
    """Return the plausible and likely alternatives of an effect."""
    likely = COMPARED_SHARE * added.hypothesis.log_bayes_factor
    hypotheses = [*added.rivals, *(one for one, _ in added.others)]
    return [one for one in hypotheses if one.sensible and one.log_bayes_factor > likely]


def _without(dropped: AddedHypothesis, later: AddedHypothesis) -> AddedHypothesis:
    """Return a later effect with its rivals after an earlier one was dropped.

    The dropped effect becomes a rival if the later one was its rival. A rival of the later effect, found with the
    dropped one in the model, remains only if it was an alternative of the dropped one too.
    """
    alternatives = [hypothesis.effect.name for hypothesis in _alternatives(dropped)]
    rivals = [rival for rival in later.rivals if rival.effect.name in alternatives]
    if later.hypothesis.effect.name in [rival.effect.name for rival in dropped.rivals]:
        rivals.append(dropped.hypothesis)
    return replace(later, rivals=rivals)


def alternatives_beside(
    problem: Problem, last: Hypothesis, one: Hypothesis, others: list[Hypothesis], used: set[int], log: Log
) -> tuple[Fitted, list[Hypothesis]]:
    """Return the last fit without an effect, and the effect and its alternatives in that fit."""
    named = last.fitted.named[~np.isin(last.fitted.named, one.at)]
    plain = fit(problem, named, moved(problem, last.fitted, one.at, np.zeros(len(one.at))), used)
    hypotheses = []
    for hypothesis in [one, *others]:
        if hypothesis is one:
            found = as_in_fit(hypothesis, last)
        else:
            point = moved(problem, plain, hypothesis.at, hypothesis.theta)
            fitted = fit(problem, np.append(named, hypothesis.at), point, used)
            found = refined(problem, refitted(problem, hypothesis, fitted), used, log)
        gain = bayes_factor(problem, found.fitted, plain, hypothesis.effect.sites)[1]
        log(f"{hypothesis.effect.name}: {gain:.1f} nat with the others in the model")
        hypotheses.append(replace(found, log_bayes_factor=gain))
    return plain, hypotheses


def as_in_fit(one: Hypothesis, last: Hypothesis) -> Hypothesis:
    """Return an effect as it is in a later fit."""
    return replace(one, fitted=last.fitted, sds=last.sds, unexplained=last.unexplained, folds=last.folds)
