"""Search for the hypotheses with the most evidence: sets of effects, by a beam.

The effects that a fit lacks most, by their scores, are added to it one by one and fitted. The likeliest few of the new
hypotheses are searched on from, until none is likelier than the best before. At last each effect of the best is left
out. All this with a few frames of each part; what is then within reach of the likeliest is fitted to all of them.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from ..effects import Effect
from ..parallel_map import parallel_map
from .evidence import NEAR_BOUND, log_model_evidence
from .fit import Fits, fit, fit_to_more, without
from .gauss_newton import MAX_EFFECT, Fitted, linearise_at, moved
from .problem import Problem
from .scores import MIN_SCORE, Score, scores
from .starts import ObservedStates, stepped
from .verdict import MAX_EFFECTS, REACH, HypothesisEvidence, log_posterior

BEAM = 3
"""Hypotheses of each size that are searched on from."""
HOPELESS = 60.0
"""Difference of the log posterior of fits from which one is not fitted to its end [nat]: its share is too small. Of 21
fits, none ended more than 15 nat above what its normal equations had promised before its refining steps."""
N_FITTED = 4
"""Number of effects that are fitted in addition to a hypothesis, the likeliest by their scores."""
N_SEARCHED = 12
"""Number of frames that the search is over, where there are more: the frames of a pull tell much the same."""
MAX_SEARCHED = 16
"""Number of frames up to which it is over all of them, as fits to a few more afterwards would cost more."""
Log = Callable[[str], None]
"""Receiver of progress messages."""


@dataclass(frozen=True, kw_only=True, eq=False)
class AddedEffect:
    """An effect in a hypothesis."""

    effect: Effect
    """The effect."""
    score: Score
    """Its score in the fit without it."""
    at: np.ndarray
    """Indices of its parameters."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Hypothesis:
    """A set of effects, fitted together."""

    added: tuple[AddedEffect, ...]
    """The effects, in the order in which they were added."""
    fits: Fits
    """Fits with them in the model."""
    log_evidence: float
    """Evidence [nat], up to a constant."""
    before: "Hypothesis | None" = None
    """Hypothesis with all but the last effect; None without effects."""
    scores: list[Score] = field(default_factory=list)
    """Scores of all other effects, filled in when they are computed."""

    @property
    def fitted(self) -> Fitted:
        """Return the fit with errors of the likeliest size."""
        return self.fits.likeliest

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the effects."""
        return tuple(one.effect.name for one in self.added)

    @property
    def title(self) -> str:
        """Return the names as text."""
        return " and ".join(self.names) or "nothing"

    @property
    def evidence(self) -> HypothesisEvidence:
        """Return the evidence for a verdict."""
        sites = int(np.prod([one.effect.sites for one in self.added]))
        larger = self.fitted.problem.scales.larger
        return HypothesisEvidence(effects=self.names, log_evidence=self.log_evidence, sites=sites, larger_errors=larger)

    def theta(self, one: AddedEffect) -> np.ndarray:
        """Return the parameters of one of its effects."""
        return self.fitted.point.theta[one.at]

    @property
    def at_bound(self) -> tuple[str, ...]:
        """Return the names of the effects that have a parameter of the largest size that it may have."""
        largest = (MAX_EFFECT - NEAR_BOUND) * self.fitted.problem.prior_sd
        return tuple(one.effect.name for one in self.added if (np.abs(self.theta(one)) >= largest[one.at]).any())

    @property
    def path(self) -> "list[Hypothesis]":
        """Return the hypotheses that it was reached through, the one without effects first."""
        return [*([] if self.before is None else self.before.path), self]


def hypothesis_of(fits: Fits, added: tuple[AddedEffect, ...] = (), before: Hypothesis | None = None) -> Hypothesis:
    """Return fits as a hypothesis."""
    return Hypothesis(added=added, fits=fits, log_evidence=log_model_evidence(fits.likeliest), before=before)


def searched_frames(problem: Problem, frames: list[int]) -> list[int]:
    """Return the frames that a search is over: spread over each part of them, with the last one of each."""
    if len(frames) <= MAX_SEARCHED:
        return frames
    found = list[int]()
    for those in problem.by_part(frames).values():
        count = min(len(those), -(-N_SEARCHED * len(those) // len(frames)))
        found += [those[(k + 1) * len(those) // count - 1] for k in range(count)]
    return found


def search(declared: Hypothesis, observed: ObservedStates, log: Log) -> list[Hypothesis]:
    """Return all hypotheses that were fitted to the frames of the declared model's fit, that model first.

    Args:
        declared: the fit without effects.
        observed: gives starts of fits.
        log: receives progress messages.
    """
    library = len(declared.fitted.problem.sheet.library)
    found = {frozenset[str](): declared}

    def posterior(one: Hypothesis) -> float:
        return log_posterior(one.evidence, library)

    def fitted(one: Hypothesis, score: Score) -> list[Hypothesis]:
        key = frozenset((*one.names, score.name))
        if key in found:
            return []
        worth = max(other.fitted.log_posterior for other in found.values()) - HOPELESS
        found[key] = added_to(one, score, observed, worth, log)
        return [found[key]]

    beam = [declared]
    for _ in range(MAX_EFFECTS):
        best = max(map(posterior, found.values()))
        new = list[Hypothesis]()
        for one in (one for one in beam if posterior(one) > best - REACH):
            for score in likely(one, log):
                new += fitted(one, score)
        if new and posterior(first := max(new, key=posterior)) > best:
            for score in confused(first):
                new += fitted(first.path[-2], score)
        beam = sorted(new, key=posterior, reverse=True)[:BEAM]
        if not beam or posterior(beam[0]) < best:
            break
        if len(beam[0].added) == 1:
            again = left_out(beam[0], beam[0].added[0], log)
            if posterior(again) > posterior(beam[0]):
                log("the declared model fits better from there: the search begins anew")
                return search(again, observed, log)
            if again.log_evidence > declared.log_evidence:
                found = {frozenset(one.names): one for one in with_declared(list(found.values()), again)}
                beam = [found[frozenset(one.names)] for one in beam]
    while len((last := max(found.values(), key=posterior)).added) > 1:
        for one in last.added:
            key = frozenset(last.names) - {one.effect.name}
            if key not in found:
                found[key] = left_out(last, one, log)
        if max(found.values(), key=posterior) is last:
            break
    return list(found.values())


def confused(one: Hypothesis) -> list[Score]:
    """Return the positive scores of the effects that the last one of a hypothesis is often confused with."""
    names = one.added[-1].effect.confounded_with
    return [score for score in one.path[-2].scores if score.name in names and score.log_bayes_factor > 0]


def with_declared(found: list[Hypothesis], again: Hypothesis) -> list[Hypothesis]:
    """Return hypotheses, the first of which is another fit of the declared model, with the scores of the one before."""
    now: dict[Hypothesis | None, Hypothesis | None] = {None: None, found[0]: replace(again, scores=found[0].scores)}
    result = list[Hypothesis]()
    for one in sorted(found, key=lambda one: len(one.added)):
        changed = now.get(one) or replace(one, before=now[one.before])
        now[one] = changed
        result.append(changed)
    return result


def of_all_frames(found: list[Hypothesis], frames: list[int], log: Log) -> list[Hypothesis]:
    """Return hypotheses, the declared model and those within reach of the likeliest fitted to all frames.

    The evidence of the others is extrapolated: their lead over one that was fitted to all grows with the number of
    frames. Of all such extrapolations the largest counts.

    Args:
        found: hypotheses that were searched for, the declared model first.
        frames: all frames to fit to.
        log: receives progress messages.
    """
    declared = found[0]
    library, more = len(declared.fitted.problem.sheet.library), len(frames) / len(declared.fitted.equations)
    if more == 1:
        return found
    fitted: dict[Hypothesis, Hypothesis] = {}

    def of_all(one: Hypothesis) -> Hypothesis:
        if one not in fitted:
            before = None if one.before is None else of_all(one.before)
            fits = fit_to_more(one.fits, frames, None if before is None else before.fits)
            result = hypothesis_of(fits, one.added, before)
            fitted[one] = replace(result, scores=one.scores)
            _report(fitted[one], log)
        return fitted[one]

    def estimated(one: Hypothesis) -> Hypothesis:
        beyond = [whole.log_evidence + more * (one.log_evidence - few.log_evidence) for few, whole in fitted.items()]
        return fitted.get(one) or replace(one, log_evidence=max(beyond))

    of_all(declared)
    while True:
        now = {one: estimated(one) for one in found}
        logs = {one: log_posterior(changed.evidence, library) for one, changed in now.items()}
        near = [one for one in found if logs[one] > max(logs.values()) - REACH and one not in fitted]
        if not near:
            return list(now.values())
        of_all(max(near, key=lambda one: logs[one]))


def likely(one: Hypothesis, log: Log) -> list[Score]:
    """Return the scores of the effects to add to a hypothesis, the likeliest first."""
    found = scores(one.fitted)
    one.scores.extend(found)
    log(f"scores beside {one.title}: " + ", ".join(f"{s.name} {s.log_bayes_factor:.1f}" for s in found[:6]))
    return [score for score in found if score.log_bayes_factor > MIN_SCORE][:N_FITTED]


def added_to(before: Hypothesis, score: Score, observed: ObservedStates, worth: float, log: Log) -> Hypothesis:
    """Return a hypothesis with one more effect, fitted; to its end only if it may reach a log posterior [nat]."""
    last = before.fitted
    problem = last.problem
    effect = problem.sheet.effect(score.name)
    one = AddedEffect(effect=effect, score=score, at=problem.sheet.place(effect.name, score.site))
    named = np.append(last.named, one.at).astype(int)
    begun = stepped(last, one.at, score) if score.began is None else score.began
    fits = fit(problem, named, [begun, *observed.starts(named)], list(last.equations), before=before.fits, worth=worth)
    result = hypothesis_of(fits, (*before.added, one), before)
    _report(result, log)
    return result


def left_out(last: Hypothesis, one: AddedEffect, log: Log) -> Hypothesis:
    """Return a hypothesis without one of its effects, fitted again; to its end only if not hopeless."""
    begun, nothing, none = last.fits, np.zeros(len(one.at)), last.path[0]
    problem, frames = begun.assumed.problem, list(begun.assumed.equations)
    named = begun.assumed.named[~np.isin(begun.assumed.named, one.at)]
    there = linearise_at(last.fitted.problem, named, moved(last.fitted, one.at, nothing), frames)
    fits = fit(
        problem,
        named,
        [moved(begun.assumed, one.at, nothing)],
        frames,
        before=Fits(assumed=none.fits.assumed, likeliest=there),
        worth=last.fitted.log_posterior - HOPELESS,
    )
    rest = tuple(other for other in last.added if other is not one)
    result = hypothesis_of(fits, rest, none if rest else None)
    _report(result, log)
    return result


def _report(one: Hypothesis, log: Log) -> None:
    sizes = "; ".join(np.array2string(one.theta(added), precision=4) for added in one.added)
    log(f"{one.title}: ln Z {one.log_evidence:.1f}, theta {sizes}, errors {one.fitted.problem.scales}")


def leave_one_out(fitted: Fitted, used: set[int]) -> dict[int, Fitted]:
    """Return a fit without each part; empty if there are fewer than two."""
    return parallel_map(lambda part: without(fitted, part), sorted(used) if len(used) > 1 else [])
