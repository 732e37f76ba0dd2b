"""Prior of which particles are attached, and how stiffly.

A particle is free or attached (`spike_and_slab`), and the likelier attached the more of its neighbours are: an Ising
prior over the mesh [Besag 1986, doi:10.1111/j.2517-6161.1986.tb01412.x],

    p(attached) ~ exp(h sum_i a_i + J sum_ij a_i a_j)    a_i in {0, 1}, ij the mesh's edges.

One sheet may be held softly here and rigidly there, while neighbours are about as stiff. So the component weights of a
particle are those of its attached neighbours, with those of the whole sheet as a few neighbours more: a Polya urn
[Blackwell & MacQueen 1973, doi:10.1214/aos/1176342372] over each neighbourhood. The shares of the components sum to 1
whatever the neighbours have, so that the odds of being attached do not change.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..physics.mesh import neighbour_table, reverse_places, symmetric
from .spike_and_slab import SpikeAndSlab


class AttachmentPrior(eqx.Module):
    """Prior over free and attached on the mesh, and over the stiffness of what is attached."""

    stiffness: SpikeAndSlab
    """Prior of each particle's s."""
    log_odds: Float[Array, " n"]
    """Log odds h of a particle without attached neighbours; equal for all, except where something was cut or sewn."""
    share: Float[Array, "_components n"]
    """Probability of each component of each particle if it is attached, by those of its neighbours."""
    sheet_strength: Float[Array, ""]
    """Number of attached neighbours that the component weights of the whole sheet are worth."""
    coupling: Float[Array, ""]
    """Coupling J, which each attached neighbour adds to the log odds."""
    neighbours: Int[Array, "n d"]
    """Neighbours of each particle along the mesh's edges, padded with n."""
    back: Int[Array, "n d"]
    """Index of the particle among the neighbours of each of its neighbours."""

    @classmethod
    def build(
        cls,
        n: int,
        edges: Int[np.ndarray, "e 2"],
        *,
        stiffness: SpikeAndSlab,
        probability: float,
        coupling: float,
        sheet_strength: float = np.inf,
    ) -> "AttachmentPrior":
        """Return the prior of a mesh.

        Args:
            n: number of particles.
            edges: of the mesh.
            stiffness: prior of each particle's s.
            probability: P(attached) of a particle without attached neighbours.
            coupling: J.
            sheet_strength: attached neighbours that the component weights of the whole sheet are worth; by default the
                neighbours do not count.
        """
        table = neighbour_table(symmetric(n, edges))
        return cls(
            stiffness=stiffness,
            log_odds=jnp.full(n, np.log(probability) - np.log1p(-probability)),
            share=jnp.repeat(stiffness.share[:, None], n, axis=1),
            sheet_strength=jnp.asarray(sheet_strength, dtype=float),
            coupling=jnp.asarray(coupling, dtype=float),
            neighbours=jnp.asarray(np.where(table < 0, n, table)),
            back=jnp.asarray(reverse_places(table)),
        )

    def share_beside(self, probability: Float[Array, "c n"]) -> Float[Array, "_components n"]:
        """Return the probability of each component of each particle if attached, by those of its neighbours.

        Args:
            probability: of each component of each particle; the first is free.
        """
        whole = jnp.pad(self.stiffness.source @ probability[1:], ((0, 0), (0, 1)))
        return self.share_among(jnp.sum(whole[:, self.neighbours], axis=2))

    def share_among(self, count: Float[Array, "_components m"]) -> Float[Array, "_components m"]:
        """Return the probability of each component beside so many attached neighbours with all of each attachment."""
        weights, total = self.stiffness.weights[:, None], jnp.sum(count, axis=0, keepdims=True)
        return self.stiffness.border_kernel @ (weights + (count - total * weights) / (self.sheet_strength + total))

    def isolated(
        self, region: Bool[Array, " n"], probability: Float[Array, " n"], message: Float[Array, "n d"]
    ) -> tuple["AttachmentPrior", Float[Array, "n d"]]:
        """Return the prior after a cut or suture of a region: with its own odds and no edge to other particles.

        What the region's old state added to the odds of its neighbours stays in their odds.

        Args:
            region: the particles.
            probability: P(attached) of each from now on; used in the region alone.
            message: log odds that each neighbour added so far.

        Returns:
            The prior, and the log odds that each neighbour adds from now on.
        """
        inside = jnp.append(region, False)[self.neighbours]
        across = (inside != region[:, None]) & (self.neighbours < len(region))
        from_inside = jnp.append(jnp.log1p(probability * jnp.expm1(self.coupling)), 0.0)[self.neighbours]
        new_message = jnp.where(across, 0.0, jnp.where(region[:, None], from_inside, message))
        odds = jnp.log(probability) - jnp.log1p(-probability) - jnp.sum(new_message, axis=1)
        kept = self.log_odds + jnp.sum(jnp.where(across, message, 0.0), axis=1)
        changed = eqx.tree_at(
            lambda prior: (prior.log_odds, prior.neighbours),
            self,
            (jnp.where(region, odds, kept), jnp.where(across, len(region), self.neighbours)),
        )
        return changed, new_message
