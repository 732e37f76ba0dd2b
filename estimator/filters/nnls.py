"""Non-negative least squares on the springs, the interior-point line of work [Xu et al. 2022, the paper's reference].

At an observed state x the balance of forces is linear in b, so that over all frames

    min over b >= 0 of   sum_t sum_i tau^-2 |grad_i U(x_t) + b_i (x_t,i - a_i)|^2  +  |b - mean_0|^2 / sd_0^2,

particles that the grip may load left out. No noise of the positions enters: x_t is the equilibrium of the sheet on
springs to what was observed, since the raw positions' own noise would drown the forces. The last term only decides for
particles that never moved; it is the prior that all filters share. The uncertainty is that of the least squares, for
forces that are wrong by tau independently.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..belief.boundary_belief import BoundaryBelief, entropy, standard_deviations
from ..physics.energy import SheetEnergy
from .evidence import Evidence, Filter, Update, unavailable
from .tethered import Tethered


class NonNegativeLeastSquares(eqx.Module, Filter):
    """The regression for one sheet; the frames so far are in the belief."""

    energy: SheetEnergy
    tethered: Tethered
    force_sd: Float[Array, ""]
    """tau [N]."""

    @classmethod
    def build(cls, energy: SheetEnergy, *, force_sd: float) -> "NonNegativeLeastSquares":
        """For a sheet's energy without attachments; force_sd [N]."""
        return cls(energy=energy, tethered=Tethered.build(energy), force_sd=jnp.asarray(force_sd, dtype=float))

    @eqx.filter_jit
    def update(
        self, belief: BoundaryBelief, b: Float[Array, " n"], evidence: Evidence, start: Float[Array, "n 3"]
    ) -> Update:
        """See `Filter.update`; the search for the smooth state begins at `start`, with springs b."""
        sd = self.force_sd
        smooth = self.tethered.settle(b, evidence, start, force_sd=sd, force_tolerance=sd / 4)
        x = smooth.x
        weight = jnp.where(evidence.force_unknown, 0.0, sd**-2)
        d, force = x - self.energy.rest, self.energy.gradient(x, jnp.zeros_like(b))
        gained, pulled = weight * jnp.sum(d**2, axis=1), -weight * jnp.sum(d * force, axis=1)
        mean = belief.mean()
        innovation = weight * jnp.sum((force + mean[:, None] * d) ** 2, axis=1)
        after = belief.add(jnp.diag(gained), pulled)
        factor = jnp.linalg.cholesky(after.precision)
        step = pulled - gained * mean
        explained = jnp.sum(step**2 / jnp.diagonal(after.precision))
        degrees = 3 * jnp.maximum(jnp.sum(weight > 0), 1).astype(b.dtype)
        return Update(
            belief=after,
            x=x,
            b=after.non_negative_mean(b > 0),
            sd=standard_deviations(factor),
            probability=unavailable(b),
            entropy=entropy(factor),
            nis=(jnp.sum(innovation) - explained) / degrees,
            converged=smooth.converged,
        )
