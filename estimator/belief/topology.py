"""Cuts and sutures as the belief takes them: what was meant is known, whether it worked is to be seen.

The paper adds delta_b to the mean and W to the covariance. Here a particle of the region is free or attached with the
odds that the act fails or holds, and what was seen of it before says nothing any more. Whether the act worked is asked
of the region as a whole: the frames since then are likelier under one of two beliefs, that in which nothing has changed
and that in which all of the region has become what was meant.
"""

from dataclasses import dataclass, field

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jiggle_mj.actions import Cut, Suture
from jiggle_mj.regions import distance_to_path

from .attachment_belief import AttachmentBelief
from .prior import PriorConfig

FAILS = 0.1
"""Chance that a cut or suture has not worked, before anything is seen of it."""


@dataclass(kw_only=True)
class Change:
    """One cut or suture, and what was believed before it."""

    event: Cut | Suture
    index: int
    """Of the first observation after it."""
    region: Bool[np.ndarray, " n"]
    before: AttachmentBelief = field(repr=False)
    evidence: tuple[Float[Array, "n n"], Float[Array, " n"]] | None = field(default=None, repr=False)
    """What the frames until the next change said of s, in information form; None where there were none, or are yet."""

    def log_bayes_factor(self, precision: Float[Array, "n n"], shift: Float[Array, " n"]) -> float:
        """Ln p(evidence | it worked) / p(evidence | nothing changed), for evidence since then in information form.

        Of a cut, worked means that all of the region is free; of a suture, that all of it holds as was meant.
        """
        meant = jnp.asarray(meant_by(self.event))
        return float(_log_bayes_factor(self.before, jnp.asarray(self.region), meant, precision, shift))


def meant_by(event: Cut | Suture) -> float:
    """Stiffness that each particle of the region is to have [N/m]."""
    return event.stiffness if isinstance(event, Suture) else 0.0


def region_of(event: Cut | Suture, rest: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Particles that a cut or suture is meant for; all False where it misses the sheet."""
    return distance_to_path(rest[:, :2], np.asarray(event.path, dtype=float)) <= event.width / 2


def after(belief: AttachmentBelief, event: Cut | Suture, region: Bool[np.ndarray, " n"]) -> AttachmentBelief:
    """The belief right after a cut or suture; sweep it before asking.

    What was sewn is about as stiff as was meant if it holds. That is said as one measurement of s, so wide that free is
    not ruled out by it; what it says of free against attached is taken back from the odds.
    """
    where = jnp.asarray(region)
    return _cut(belief, where) if isinstance(event, Cut) else _sewn(belief, where, jnp.asarray(event.stiffness))


@eqx.filter_jit
def _cut(belief: AttachmentBelief, where: Bool[Array, " n"]) -> AttachmentBelief:
    return belief.changed(where, jnp.clip(FAILS * belief.mixture().attached, LEAST, 1 - LEAST))


@eqx.filter_jit
def _sewn(belief: AttachmentBelief, where: Bool[Array, " n"], stiffness: Float[Array, ""]) -> AttachmentBelief:
    attached = belief.mixture().attached
    changed = belief.changed(where, jnp.clip(1 - FAILS * (1 - attached), LEAST, 1 - LEAST))
    meant = belief.bounded(jnp.full(len(where), stiffness))
    odds = changed.prior.log_odds
    _, factor = changed.prior.stiffness.posterior(meant, meant**2, odds)
    changed = eqx.tree_at(lambda one: one.prior.log_odds, changed, jnp.where(where, odds - factor, odds))
    return changed.add(jnp.diag(jnp.where(where, meant**-2, 0.0)), jnp.where(where, 1 / meant, 0.0))


@eqx.filter_jit
def _log_bayes_factor(
    before: AttachmentBelief,
    region: Bool[Array, " n"],
    stiffness: Float[Array, ""],
    precision: Float[Array, "n n"],
    shift: Float[Array, " n"],
) -> Float[Array, ""]:
    meant = before.bounded(jnp.full(len(region), stiffness))
    prior = PriorConfig()
    worked = before.fixed(region, meant, jnp.maximum(prior.spread * meant, prior.spike))
    return worked.evidence_for(precision, shift) - before.evidence_for(precision, shift)


LEAST = 1e-6
"""No particle is surer to be free or attached after a cut or suture."""
