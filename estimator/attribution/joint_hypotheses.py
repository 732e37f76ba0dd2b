"""Hypotheses about several recordings of one sheet: sets of effects of the tissue, which all of them share.

What the tool, the camera and the tracker do is each recording's own: beside the shared effects each has the likeliest
of its own that were fitted with them. Attachments, nuisance parameters and the sizes of the errors are its own, too.
Pure functions of numbers.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from .joint_evidence import OwnInformation, SharedPosterior, SharedPrior, joint_evidence
from .verdict import MAX_EFFECTS, POWER, REACH, EvidenceVerdict, HypothesisEvidence, decide, log_posterior, log_prior

Sited = tuple[str, int]
"""An effect's name, and its site."""
Effects = tuple[Sited, ...]
"""Effects of a hypothesis, sorted."""


@dataclass(frozen=True, kw_only=True)
class EffectsPrior:
    """Prior of the effects that were looked for."""

    sites: Mapping[str, int]
    """Number of sites of each effect, by its name."""
    of_tissue: Mapping[Sited, SharedPrior]
    """Prior of the parameters of each effect of the tissue, at each of its sites."""

    def together(self, shared: Effects) -> SharedPrior:
        """Return the prior of the parameters of some effects of the tissue, one effect after the other."""
        each, nothing = [self.of_tissue[one] for one in shared], np.zeros(0)
        return SharedPrior(
            sd=np.concatenate([nothing, *(one.sd for one in each)]),
            lower=np.concatenate([nothing, *(one.lower for one in each)]),
        )

    def combinations(self, effects: Iterable[Sited]) -> int:
        """Return the number of combinations of sites that some effects could be at."""
        return int(np.prod([self.sites[name] for name, _ in effects], dtype=int))

    def log_prior(self, effects: Effects) -> float:
        """Return the log prior probability of a set of effects [nat], not normalised."""
        return log_prior(len(effects), self.combinations(effects), len(self.sites))


@dataclass(frozen=True, kw_only=True)
class RecordedFit:
    """One hypothesis as fitted to one recording."""

    shared: Effects
    """Its effects of the tissue."""
    own: Effects
    """Its effects of the tool, the camera and the tracker."""
    larger_errors: float
    """Probability that its errors are larger than usual."""
    information: OwnInformation
    """What it says of the parameters of the effects of the tissue, one effect after the other."""

    def log_posterior(self, prior: EffectsPrior) -> float:
        """Return the log posterior probability that its recording alone gives it [nat], not normalised."""
        return prior.log_prior((*self.shared, *self.own)) + POWER * self.information.log_evidence

    def log_prior_beside(self, prior: EffectsPrior) -> float:
        """Return the log prior probability of its own effects beside the shared ones [nat], not normalised."""
        return prior.log_prior((*self.shared, *self.own)) - prior.log_prior(self.shared)


Recordings = Mapping[str, Sequence[RecordedFit]]
"""The hypotheses that were fitted to each recording, by its name."""


@dataclass(frozen=True, kw_only=True)
class JointHypothesis:
    """A set of shared effects, with the likeliest fit of each recording that has them."""

    shared: Effects
    """The effects."""
    fits: Mapping[str, RecordedFit]
    """The fit of each recording, by its name."""
    posterior: SharedPosterior
    """Parameters of the effects, and the evidence."""

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the effects."""
        return tuple(name for name, _ in self.shared)

    def evidence(self, prior: EffectsPrior) -> HypothesisEvidence:
        """Return the evidence for a verdict; larger errors in one recording are those of all."""
        return HypothesisEvidence(
            effects=self.names,
            log_evidence=self.posterior.log_evidence,
            sites=prior.combinations(self.shared),
            larger_errors=max(one.larger_errors for one in self.fits.values()),
            log_prior_beside=sum(one.log_prior_beside(prior) for one in self.fits.values()),
        )

    def log_posterior(self, prior: EffectsPrior) -> float:
        """Return the log posterior probability [nat], not normalised."""
        return log_posterior(self.evidence(prior), len(prior.sites))


def joint_hypotheses(recordings: Recordings, prior: EffectsPrior) -> list[JointHypothesis]:
    """Return the sets of shared effects that every recording was fitted with, the likeliest first."""
    found = [
        _together(shared, fits, prior)
        for shared in _sets(recordings)
        if len(fits := _fitted(recordings, shared, prior)) == len(recordings)
    ]
    return sorted(found, key=lambda one: -one.log_posterior(prior))


def decide_jointly(found: Sequence[JointHypothesis], prior: EffectsPrior) -> EvidenceVerdict:
    """Return the posterior of the sets of shared effects, and the verdict.

    Raises:
        ValueError: none has finite evidence.
    """
    return decide([one.evidence(prior) for one in found], len(prior.sites))


def within_reach(
    recordings: Recordings, scores: Mapping[str, Mapping[Sited, float]], prior: EffectsPrior
) -> list[Effects]:
    """Return the sets that some recording lacks and that may be likely for all, the smallest first.

    In a recording that lacks a set, the missing effects count as if they changed nothing; or one alone, beside nothing,
    as much as its score says.

    Args:
        recordings: their fits, the one without any effect among those of each.
        scores: of each recording, log Bayes factors of one step with an effect of the tissue where nothing is added.
        prior: of the effects.
    """
    best = joint_hypotheses(recordings, prior)[0].log_posterior(prior)
    wanted = list[Effects]()
    for shared in _sets(recordings) | {(one,) for each in scores.values() for one in each}:
        fitted = _fitted(recordings, shared, prior)
        if len(shared) > MAX_EFFECTS or len(fitted) == len(recordings):
            continue
        total = _together(shared, fitted, prior).posterior.log_evidence if fitted else 0.0
        for name in recordings.keys() - fitted.keys():
            inside = (one for one in recordings[name] if set(one.shared) <= set(shared))
            fitted[name] = max(inside, key=lambda one: one.log_posterior(prior))
            log_evidence = fitted[name].information.log_evidence
            if len(shared) == 1 and shared[0] in scores[name]:
                nothing = next(one for one in recordings[name] if not (one.shared or one.own))
                log_evidence = max(log_evidence, nothing.information.log_evidence + scores[name][shared[0]])
            total += log_evidence
        beside = sum(one.log_prior_beside(prior) for one in fitted.values())
        if prior.log_prior(shared) + beside + POWER * total > best - REACH:
            wanted.append(shared)
    return sorted(wanted, key=lambda shared: (len(shared), shared))


def without_each(one: JointHypothesis, prior: EffectsPrior) -> dict[str, SharedPosterior]:
    """Return the posterior of the shared parameters without each recording; empty for fewer than two."""
    if len(one.fits) < 2:
        return {}
    return {
        name: _together(one.shared, {k: fit for k, fit in one.fits.items() if k != name}, prior).posterior
        for name in one.fits
    }


def _sets(recordings: Recordings) -> set[Effects]:
    return {one.shared for each in recordings.values() for one in each}


def _fitted(recordings: Recordings, shared: Effects, prior: EffectsPrior) -> dict[str, RecordedFit]:
    """Return the likeliest fit of each recording that was fitted with some shared effects and no others."""
    having = {name: [one for one in each if one.shared == shared] for name, each in recordings.items()}
    return {name: max(each, key=lambda one: one.log_posterior(prior)) for name, each in having.items() if each}


def _together(shared: Effects, fits: Mapping[str, RecordedFit], prior: EffectsPrior) -> JointHypothesis:
    posterior = joint_evidence([one.information for one in fits.values()], prior.together(shared))
    return JointHypothesis(shared=shared, fits=fits, posterior=posterior)
