"""One frame's measurements of the particles, as every filter takes them."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class Pull(eqx.Module):
    """The tool's step that led to a frame, for filters that simulate it."""

    before: Float[Array, "n 3"]
    """Positions in the frame before [m]."""
    tip: Float[Array, " 3"]
    """Where the tip moved to [m]."""
    length: Float[Array, " n"]
    """Distance of each particle from the tip when the jaws closed [m]."""


class Evidence(eqx.Module):
    """One frame's measurements of the particles."""

    y: Float[Array, "n 3"]
    """Observed positions [m]; anything finite where there is no observation."""
    precision: Float[Array, "n 3 3"]
    """R^-1, the inverse covariance of each position [1/m^2]; zero where a particle is missing."""
    held: Bool[Array, " n"]
    """Particles in the grip, which follow the tip."""
    force_unknown: Bool[Array, " n"]
    """Particles that the grip may pull at, the held ones included: their balance of forces is unknown."""
    pull: Pull | None = None
    """The tool's step; None for filters that simulate none."""

    def inflated(self, variance: float) -> "Evidence":
        """Return the evidence with `variance` times the variance of what was seen; the held particles keep theirs."""
        precision = jnp.where(self.held[:, None, None], self.precision, self.precision / variance)
        return eqx.tree_at(lambda evidence: evidence.precision, self, precision)

    @property
    def seen(self) -> Bool[Array, " n"]:
        """Particles of which anything is known, by perception or by the grip."""
        return jnp.trace(self.precision, axis1=1, axis2=2) > 0
