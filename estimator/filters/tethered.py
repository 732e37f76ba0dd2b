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

STEPS = 25
"""Most Newton steps."""


class Tethered(eqx.Module):
    """One sheet, to be smoothed frame after frame."""

    energy: SheetEnergy
    """Its last term are the springs."""

    @classmethod
    def build(cls, energy: SheetEnergy) -> "Tethered":
        """For a sheet's energy without attachments."""
        rest = np.asarray(energy.rest)
        return cls(energy=SheetEnergy.build(rest, (*energy.terms, Tether.build(rest)), energy.layout))

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
        """Equilibrium with attachments b [N/m], searched from `start`; held particles on springs of their own [N/m]."""
        sd = jnp.sqrt(3 / jnp.maximum(jnp.trace(evidence.precision, axis1=1, axis2=2), 1e-12))
        pull = (force_sd * sd)[:, None, None] * evidence.precision
        if grip_stiffness is not None:
            stiff = grip_stiffness * jnp.eye(3, dtype=start.dtype)
            pull = jnp.where(evidence.held[:, None, None], stiff, pull)
        energy = eqx.tree_at(lambda e: (e.terms[-1].to, e.terms[-1].stiffness), self.energy, (evidence.y, pull))
        return equilibrium(energy, b, start, force_tolerance=force_tolerance, max_steps=STEPS)
