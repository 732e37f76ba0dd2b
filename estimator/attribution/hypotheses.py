"""Search for the hypotheses with the most evidence: sets of effects, by a beam.

The effects that a fit lacks most, by their scores, are added to it one by one and fitted. The likeliest few of the new
hypotheses are searched on from, until none is likelier than the best before. At last each effect of the best is left
out.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ..effects import Effect
from ..parallel_map import parallel_map
from .evidence import log_model_evidence
from .fit import Fits, fit, without
from .gauss_newton import Fitted, moved
from .scores import MIN_SCORE, Score, scores
from .starts import ObservedStates, stepped
from .verdict import HypothesisEvidence, log_posterior

MAX_EFFECTS = 3
"""Largest number of effects of a hypothesis."""
BEAM = 3
"""Hypotheses of each size that are searched on from."""
REACH = 3.0
"""Difference of log posterior from the best up to which hypotheses are searched on from [nat]: a twentieth of its
probability, less than what the credible set leaves out."""
HOPELESS = 200.0
"""Difference of the log posterior of fits from which one is not fitted to its end [nat]: its share is too small."""
N_FITTED = 4
"""Number of effects that are fitted in addition to a hypothesis, the likeliest by their scores."""
COMPARED_SHARE = 0.5
"""Share of the best score from which effects are fitted too that are often confused with the best."""
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
    def path(self) -> "list[Hypothesis]":
        """Return the hypotheses that it was reached through, the one without effects first."""
        return [*([] if self.before is None else self.before.path), self]


def hypothesis_of(fits: Fits, added: tuple[AddedEffect, ...] = (), before: Hypothesis | None = None) -> Hypothesis:
    """Return fits as a hypothesis."""
    return Hypothesis(added=added, fits=fits, log_evidence=log_model_evidence(fits.likeliest), before=before)


def search(declared: Hypothesis, observed: ObservedStates, used: set[int], log: Log) -> list[Hypothesis]:
    """Return all hypotheses that were fitted, the declared model first.

    Args:
        declared: the fit without effects.
        observed: gives starts of fits.
        used: parts that are fitted to.
        log: receives progress messages.
    """
    library = len(declared.fitted.problem.sheet.library)
    found = {frozenset[str](): declared}

    def posterior(one: Hypothesis) -> float:
        return log_posterior(one.evidence, library)

    beam = [declared]
    for _ in range(MAX_EFFECTS):
        best = max(map(posterior, found.values()))
        new = list[Hypothesis]()
        for one in (one for one in beam if posterior(one) > best - REACH):
            for score in likely(one, log):
                key = frozenset((*one.names, score.name))
                if key not in found:
                    worth = max(other.fitted.log_posterior for other in found.values()) - HOPELESS
                    found[key] = added_to(one, score, observed, used, worth, log)
                    new.append(found[key])
        beam = sorted(new, key=posterior, reverse=True)[:BEAM]
        if not beam or posterior(beam[0]) < best:
            break
    while len((last := max(found.values(), key=posterior)).added) > 1:
        for one in last.added:
            key = frozenset(last.names) - {one.effect.name}
            if key not in found:
                found[key] = left_out(last, one, used, log)
        if max(found.values(), key=posterior) is last:
            break
    return list(found.values())


def likely(one: Hypothesis, log: Log) -> list[Score]:
    """Return the scores of the effects to add to a hypothesis: the likeliest, and close ones often confused with it."""
    found = scores(one.fits.assumed)
    one.scores.extend(found)
    log(f"scores beside {one.title}: " + ", ".join(f"{s.name} {s.log_bayes_factor:.1f}" for s in found[:6]))
    entering = [score for score in found if score.log_bayes_factor > MIN_SCORE]
    if not entering:
        return []
    confused = one.fitted.problem.sheet.effect(entering[0].name).confounded_with
    limit = COMPARED_SHARE * entering[0].log_bayes_factor
    near = [score for score in entering[N_FITTED:] if score.log_bayes_factor > limit]
    return entering[:N_FITTED] + [score for score in near if score.name in confused]


def added_to(
    before: Hypothesis, score: Score, observed: ObservedStates, used: set[int], worth: float, log: Log
) -> Hypothesis:
    """Return a hypothesis with one more effect, fitted; to its end only if it may reach a log posterior [nat]."""
    last = before.fits.assumed
    problem = last.problem
    effect = problem.sheet.effect(score.name)
    one = AddedEffect(effect=effect, score=score, at=problem.sheet.place(effect.name, score.site))
    named = np.append(last.named, one.at).astype(int)
    begun = stepped(last, one.at, score) if score.began is None else score.began
    fits = fit(problem, named, [begun, *observed.starts(named)], used, before=before.fits, worth=worth)
    result = hypothesis_of(fits, (*before.added, one), before)
    _report(result, log)
    return result


def left_out(last: Hypothesis, one: AddedEffect, used: set[int], log: Log) -> Hypothesis:
    """Return a hypothesis without one of its effects, fitted again; to its end only if not hopeless."""
    begun = last.fits.assumed
    named = begun.named[~np.isin(begun.named, one.at)]
    worth = last.fitted.log_posterior - HOPELESS
    fits = fit(
        begun.problem, named, [moved(begun, one.at, np.zeros(len(one.at)))], used, before=last.path[0].fits, worth=worth
    )
    result = hypothesis_of(fits, tuple(other for other in last.added if other is not one), last.path[0])
    _report(result, log)
    return result


def _report(one: Hypothesis, log: Log) -> None:
    scales = ", ".join(f"{value:.2g}" for value in one.fitted.problem.scales.values)
    sizes = "; ".join(np.array2string(one.theta(added), precision=4) for added in one.added)
    log(f"{one.title}: ln Z {one.log_evidence:.1f}, theta {sizes}, variances {scales}")


def leave_one_out(fitted: Fitted, used: set[int]) -> dict[int, Fitted]:
    """Return a fit without each part; empty if there are fewer than two."""
    return parallel_map(lambda part: without(fitted, part), sorted(used) if len(used) > 1 else [])
