"""Cuts and sutures in the belief: the intended result is known, its success is inferred.

The paper adds delta_b to the mean and W to the covariance. Here each particle of the region is free or attached with
the odds that a cut or suture fails or succeeds, and evidence about its old attachment no longer counts. Whether the act
succeeded is asked of the region as a whole, by the evidence of the frames since then: under the belief in which nothing
has changed, and under that in which all of the region has become as intended.
"""

from dataclasses import dataclass, field

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jiggle_mj.actions import Cut, Suture
from jiggle_mj.regions import distance_to_path

from .attachment_belief import AttachmentBelief

FAILURE_PROBABILITY = 0.1
"""Probability that a cut or suture had no effect, before any frame shows it."""
MIN_PROBABILITY = 1e-6
"""Smallest distance of P(attached) from 0 and 1 after a cut or suture, so that later evidence can still change it."""


@dataclass(kw_only=True)
class Change:
    """One cut or suture, and the belief before it."""

    event: Cut | Suture
    index: int
    """Index of the first observation after it."""
    region: Bool[np.ndarray, " n"]
    before: AttachmentBelief = field(repr=False)
    evidence: tuple[Float[Array, "n n"], Float[Array, " n"]] | None = field(default=None, repr=False)
    """Evidence about s of the frames until the next change, in information form; None where there is none so far."""

    def log_bayes_factor(self, precision: Float[Array, "n n"], shift: Float[Array, " n"]) -> float:
        """Return ln p(evidence | success) / p(evidence | nothing changed) of evidence since then, in information form.

        After a successful cut all of the region is free; after a successful suture it has the intended stiffness.
        """
        intended = jnp.asarray(meant_by(self.event))
        return float(_log_bayes_factor(self.before, jnp.asarray(self.region), intended, precision, shift))


def meant_by(event: Cut | Suture) -> float:
    """Return the stiffness that each particle of the region is intended to have [N/m]."""
    return event.stiffness if isinstance(event, Suture) else 0.0


def region_of(event: Cut | Suture, rest: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Return the particles that a cut or suture acts on; all False where it misses the sheet."""
    return distance_to_path(rest[:, :2], np.asarray(event.path, dtype=float)) <= event.width / 2


def after(belief: AttachmentBelief, event: Cut | Suture, region: Bool[np.ndarray, " n"]) -> AttachmentBelief:
    """Return the belief right after a cut or suture; sweep it before reading it.

    A suture that succeeds has about the intended stiffness. That enters as one measurement of s whose standard
    deviation is s itself, so that free is not excluded. Its Bayes factor for attached is subtracted from the odds.
    """
    where = jnp.asarray(region)
    return _cut(belief, where) if isinstance(event, Cut) else _sewn(belief, where, jnp.asarray(event.stiffness))


@eqx.filter_jit
def _cut(belief: AttachmentBelief, where: Bool[Array, " n"]) -> AttachmentBelief:
    return belief.changed(where, _clipped(FAILURE_PROBABILITY * belief.mixture().attached))


@eqx.filter_jit
def _sewn(belief: AttachmentBelief, where: Bool[Array, " n"], stiffness: Float[Array, ""]) -> AttachmentBelief:
    attached = belief.mixture().attached
    changed = belief.changed(where, _clipped(1 - FAILURE_PROBABILITY * (1 - attached)))
    intended = belief.bounded(jnp.full(len(where), stiffness))
    odds = changed.prior.log_odds
    _, log_bayes_factor = changed.prior.stiffness.posterior(intended, intended**2, odds, changed.prior.share)
    changed = eqx.tree_at(
        lambda belief: belief.prior.log_odds, changed, jnp.where(where, odds - log_bayes_factor, odds)
    )
    return changed.add(jnp.diag(jnp.where(where, intended**-2, 0.0)), jnp.where(where, 1 / intended, 0.0))


def _clipped(probability: Float[Array, " n"]) -> Float[Array, " n"]:
    return jnp.clip(probability, MIN_PROBABILITY, 1 - MIN_PROBABILITY)


@eqx.filter_jit
def _log_bayes_factor(
    before: AttachmentBelief,
    region: Bool[Array, " n"],
    stiffness: Float[Array, ""],
    precision: Float[Array, "n n"],
    shift: Float[Array, " n"],
) -> Float[Array, ""]:
    intended = before.bounded(jnp.full(len(region), stiffness))
    prior = before.prior.stiffness
    success = before.fixed(region, intended, jnp.maximum(prior.spread * intended, prior.spike))
    return success.evidence_for(precision, shift) - before.evidence_for(precision, shift)
