"""The sheet on springs to what was observed: a state that nearly balances forces and nearly fits.

The raw positions are crumpled by their noise, far outside the range in which forces are linear.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..physics.energy import SheetEnergy
from ..physics.environment import Tether
from ..physics.equilibrium import Equilibrium, equilibrium
from .evidence import Evidence

MAX_NEWTON_STEPS = 50
"""Most Newton steps of an equilibrium."""
MIN_TRACE = 1e-12
"""Lower bound of the trace of a precision where it divides [1/m^2]: a particle that nothing was seen of."""


class Tethered(eqx.Module):
    """One sheet on springs, for one frame after the other."""

    energy: SheetEnergy
    """Energy of the sheet; its last term is the springs [J]."""

    @classmethod
    def build(cls, energy: SheetEnergy) -> "Tethered":
        """Add the springs to a sheet's energy without attachments."""
        rest = np.asarray(energy.rest)
        return cls(energy=SheetEnergy.build(rest, (*energy.terms, Tether.build(rest)), energy.layout))

    def with_energy(self, energy: SheetEnergy) -> "Tethered":
        """Return the same springs on a sheet of another energy with the same terms."""
        changed = energy.rest, (*energy.terms, self.energy.terms[-1])
        return eqx.tree_at(lambda tethered: (tethered.energy.rest, tethered.energy.terms), self, changed)

    def settle(
        self,
        b: Float[Array, " n"],
        evidence: Evidence,
        start: Float[Array, "n 3"],
        *,
        force_sd: Float[Array, ""],
        force_tolerance: float | Array,
        grip_stiffness: float | Array | None = None,
    ) -> Equilibrium:
        """Return the equilibrium of the sheet on springs to what was observed.

        Args:
            b: stiffness of each attachment [N/m].
            evidence: what was observed.
            start: where the search begins [m].
            force_sd: standard deviation of the model's force error [N]; a particle that is one standard deviation of
                its position off pulls with this force.
            force_tolerance: residual force at which the search ends [N].
            grip_stiffness: of the springs of held particles [N/m]; as those of the others if None.
        """
        sd = jnp.sqrt(3 / jnp.maximum(jnp.trace(evidence.precision, axis1=1, axis2=2), MIN_TRACE))
        pull = (force_sd * sd)[:, None, None] * evidence.precision
        if grip_stiffness is not None:
            stiff = grip_stiffness * jnp.eye(3, dtype=start.dtype)
            pull = jnp.where(evidence.held[:, None, None], stiff, pull)
        energy = eqx.tree_at(lambda e: (e.terms[-1].to, e.terms[-1].stiffness), self.energy, (evidence.y, pull))
        return equilibrium(energy, b, start, force_tolerance=force_tolerance, max_steps=MAX_NEWTON_STEPS)
