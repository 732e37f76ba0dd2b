"""What is believed of a sheet's attachments before anything is seen.

A particle is free or attached (`spike_and_slab`), the likelier attached the more of its neighbours are: an Ising prior
over the mesh [Besag 1986, doi:10.1111/j.2517-6161.1986.tb01412.x],

    p(attached) ~ exp(h sum_i a_i + J sum_ij a_i a_j)    a_i in {0, 1}, ij the mesh's edges.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..physics.mesh import neighbour_table, places_back, symmetric
from .spike_and_slab import SpikeAndSlab


class AttachmentPrior(eqx.Module):
    """Free or attached, and how stiffly."""

    stiffness: SpikeAndSlab
    log_odds: Float[Array, " n"]
    """h: of each particle without attached neighbours; the same for all, but where something was cut or sewn."""
    coupling: Float[Array, ""]
    """J: what each attached neighbour adds to the log odds."""
    neighbours: Int[Array, "n d"]
    """Of each particle along the mesh's edges, padded with n."""
    back: Int[Array, "n d"]
    """Which place the particle has among the neighbours of each of its neighbours."""

    @classmethod
    def build(
        cls,
        n: int,
        edges: Int[np.ndarray, "e 2"],
        *,
        stiffness: SpikeAndSlab,
        probability: float,
        coupling: float,
    ) -> "AttachmentPrior":
        """For n particles; `probability` is that of one none of whose neighbours is attached."""
        table = neighbour_table(symmetric(n, edges))
        return cls(
            stiffness=stiffness,
            log_odds=jnp.full(n, np.log(probability) - np.log1p(-probability)),
            coupling=jnp.asarray(coupling, dtype=float),
            neighbours=jnp.asarray(np.where(table < 0, n, table)),
            back=jnp.asarray(places_back(table)),
        )

    def parted(
        self, region: Bool[Array, " n"], probability: Float[Array, " n"], message: Float[Array, "n d"]
    ) -> tuple["AttachmentPrior", Float[Array, "n d"]]:
        """After something was done to a region: it has odds of its own, and its edge to the others is no edge now.

        What the region told the others of what was before stays with them.

        Args:
            region: the particles.
            probability: P(attached) of each from now on; used in the region alone.
            message: log odds that each neighbour told.

        Returns:
            The prior, and what neighbours tell from now on.
        """
        inside = jnp.append(region, False)[self.neighbours]
        across = (inside != region[:, None]) & (self.neighbours < len(region))
        tells = jnp.append(jnp.log1p(probability * jnp.expm1(self.coupling)), 0.0)[self.neighbours]
        told = jnp.where(across, 0.0, jnp.where(region[:, None], tells, message))
        odds = jnp.log(probability) - jnp.log1p(-probability) - jnp.sum(told, axis=1)
        kept = self.log_odds + jnp.sum(jnp.where(across, message, 0.0), axis=1)
        changed = eqx.tree_at(
            lambda prior: (prior.log_odds, prior.neighbours),
            self,
            (jnp.where(region, odds, kept), jnp.where(across, len(region), self.neighbours)),
        )
        return changed, told
