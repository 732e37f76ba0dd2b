"""What is believed of a sheet's attachments before anything is seen.

A particle is free or attached (`spike_and_slab`), the likelier attached the more of its neighbours are: an Ising prior
over the mesh [Besag 1986, doi:10.1111/j.2517-6161.1986.tb01412.x],

    p(attached) ~ exp(h sum_i a_i + J sum_ij a_i a_j)    a_i in {0, 1}, ij the mesh's edges.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from jiggle_mj.estimator.mesh import neighbour_table, symmetric
from jiggle_mj.estimator.spike_and_slab import SpikeAndSlab


class AttachmentPrior(eqx.Module):
    """Free or attached, and how stiffly."""

    stiffness: SpikeAndSlab
    log_odds: Float[Array, ""]
    """h: of a particle without attached neighbours."""
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
        back = np.argmax(table[table] == np.arange(n)[:, None, None], axis=2)
        return cls(
            stiffness=stiffness,
            log_odds=jnp.asarray(np.log(probability) - np.log1p(-probability)),
            coupling=jnp.asarray(coupling, dtype=float),
            neighbours=jnp.asarray(np.where(table < 0, n, table)),
            back=jnp.asarray(back),
        )
