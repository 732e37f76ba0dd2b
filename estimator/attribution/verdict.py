"""What the evidences of some hypotheses say: their posterior probabilities, and a verdict. Pure functions of numbers.

Nothing is missing with probability 1/2, and one, two or three effects with half of that each time, shared evenly among
all sets of that size and all sites of each effect. The evidence enters with a power below 1, because every hypothesis
is wrong in other ways too: another mesh, another material law [Gruenwald & van Ommen 2017, doi:10.1214/17-BA1085].
"""

from dataclasses import dataclass
from math import comb

import numpy as np
from jaxtyping import Float
from scipy.special import logsumexp

POWER = 0.2
"""Power of the evidence. Of 0.1 to 1 it has the least expected calibration error on 32 recordings of two layouts; see
docs/STUDIES.md for that on three others."""
MAX_EFFECTS = 3
"""Largest number of effects of a hypothesis."""
REACH = 3.0
"""Difference of log posterior from the best up to which hypotheses are fitted and searched on from [nat]: a twentieth
of its probability, less than what the credible set leaves out."""
CREDIBLE = 0.95
"""Probability from which effects are certain, and that rivals have together with the best."""


@dataclass(frozen=True, kw_only=True)
class HypothesisEvidence:
    """Evidence of one hypothesis."""

    effects: tuple[str, ...]
    """Names of its effects."""
    log_evidence: float
    """ln Z [nat], up to a constant that all hypotheses share."""
    sites: int
    """Number of combinations of sites that its effects could be at."""
    larger_errors: float
    """Probability that its errors are larger than usual."""
    log_prior_beside: float = 0.0
    """Log prior probability of what it has beside these effects, against having nothing beside them [nat]."""


@dataclass(frozen=True, kw_only=True)
class EvidenceVerdict:
    """What some evidences say."""

    kind: str
    """no-effect, effect, ambiguous, effect-with-remainder or unexplained."""
    probabilities: Float[np.ndarray, " hypotheses"]
    """Posterior probability of each hypothesis."""
    best: int
    """The likeliest hypothesis."""
    rivals: tuple[int, ...]
    """Hypotheses without some effect of the best one that have 0.95 together with those that have all of its effects;
    the likeliest first."""


def log_prior(effects: int, sites: int, library: int) -> float:
    """Return the log prior probability of one hypothesis of a number of effects of a library [nat], not normalised."""
    return -(1 + effects) * float(np.log(2)) - float(np.log(comb(library, effects))) - float(np.log(sites))


def log_posterior(one: HypothesisEvidence, library: int) -> float:
    """Return the log posterior probability of a hypothesis [nat], not normalised."""
    return log_prior(len(one.effects), one.sites, library) + one.log_prior_beside + POWER * one.log_evidence


def decide(evidences: list[HypothesisEvidence], library: int) -> EvidenceVerdict:
    """Return the posterior of hypotheses and the verdict; `library` is the number of effects that were tested.

    Raises:
        ValueError: no hypothesis has finite evidence.
    """
    logs = np.array([log_posterior(one, library) for one in evidences])
    logs = np.where(np.isfinite(logs), logs, -np.inf)
    if not np.isfinite(logs).any():
        raise ValueError("a verdict needs a hypothesis with finite evidence.")
    probabilities = np.exp(logs - logsumexp(logs))
    order = np.argsort(-probabilities, kind="stable")
    best = evidences[order[0]]
    others = [int(k) for k in order if not set(best.effects) <= set(evidences[k].effects)]
    certain = 1 - np.sum(probabilities[others])
    before = certain + np.cumsum(np.append(0.0, probabilities[others]))
    rivals = tuple(k for k, reached in zip(others, before[:-1], strict=True) if reached < CREDIBLE)
    if best.larger_errors > 0.5:
        kind = "effect-with-remainder" if best.effects else "unexplained"
    elif not best.effects:
        kind = "no-effect"
    else:
        kind = "ambiguous" if rivals else "effect"
    return EvidenceVerdict(kind=kind, probabilities=probabilities, best=int(order[0]), rivals=rivals)
