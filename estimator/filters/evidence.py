"""One frame's measurements of the particles, as every filter takes them."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..perception.cloud_surface import Cloud
from ..physics.energy import SheetEnergy

MIN_DIRECTION = 1e-6
"""Smallest precision that counts as an observation of a direction [largest precision of the particle]."""
MIN_PRECISION = 1e-3
"""The same where nothing is known of a particle [1/m^2]: a standard deviation of 30 m."""


class Pull(eqx.Module):
    """The tool's step that led to a frame, for filters that simulate it."""

    before: Float[Array, "n 3"]
    """Positions in the frame before [m]."""
    tip: Float[Array, " 3"]
    """Where the tip moved to [m]."""
    length: Float[Array, " n"]
    """Distance of each particle from the tip when the jaws closed [m]."""


class MeasuredPull(eqx.Module):
    """The force of the tool on the tissue, as it was measured in a frame."""

    index: Int[Array, ""]
    """Index of the observation."""
    pull: Float[Array, " 3"]
    """The force in the world [N]: minus that on the tool."""
    covariance: Float[Array, "3 3"]
    """Covariance of its noise [N^2], without that of the sensor's offset."""
    offset_sd: Float[Array, ""]
    """Standard deviation of each component of the offset that was subtracted [N]; 0 where none was."""
    offset_number: Int[Array, ""]
    """Number of that offset: frames of the same number err by it alike."""


class Evidence(eqx.Module):
    """One frame's measurements of the particles."""

    y: Float[Array, "n 3"]
    """Observed positions [m]; anything finite where there is no observation."""
    precision: Float[Array, "n 3 3"]
    """Inverse covariance of each position, with all its noise [1/m^2]; zero where a particle is missing."""
    held: Bool[Array, " n"]
    """Particles in the grip, which follow the tip."""
    force_unknown: Bool[Array, " n"]
    """Particles that the grip may pull at, the held ones included: their balance of forces is unknown."""
    fields: Float[Array, "n m"] | None = None
    """F, the part of the noise that neighbours share, as fields of unit amplitude, the same for each coordinate [m].
    One array serves all frames of a recording: it counts as `seen_fields`. None where no noise is shared."""
    pull: Pull | None = None
    """The tool's step; None for filters that simulate none."""
    cloud: Cloud | None = None
    """A cloud without identities, whose observations depend on the state: see `near`. Position and precision are then
    what is known without it. None where the particles are identified."""
    force: MeasuredPull | None = None
    """The tool's force; None where it was not measured, and for the prediction of a pull."""
    energy: SheetEnergy | None = None
    """Energy of the sheet in this frame, as declared effects change it; None for the same in all frames."""

    def near(self, x: Float[Array, "n 3"], *, gate: float = 0.0) -> "Evidence":
        """Return the evidence with a cloud matched to the surface at a state; see `Cloud.matched` for the gate."""
        if self.cloud is None:
            return self
        pull, precision = self.cloud.matched(x, self.held, gate=gate)
        pull = pull + jnp.einsum("nij,nj->ni", self.precision, self.y - x)
        precision = precision + self.precision
        floor = jnp.maximum(MIN_DIRECTION * jnp.trace(precision, axis1=1, axis2=2), MIN_PRECISION)
        y = x + jnp.linalg.solve(precision + floor[:, None, None] * jnp.eye(3)[None], pull[:, :, None])[:, :, 0]
        return eqx.tree_at(
            lambda e: (e.y, e.precision, e.cloud), self, (y, precision, None), is_leaf=lambda leaf: leaf is None
        )

    def of_grip(self) -> "Evidence":
        """Return what the jaws alone say."""
        held = jnp.where(self.held[:, None, None], self.precision, 0.0)
        return eqx.tree_at(lambda e: (e.precision, e.cloud), self, (held, None), is_leaf=lambda leaf: leaf is None)

    def inflated(self, variance: float | Float[Array, ""]) -> "Evidence":
        """Return the evidence with `variance` times the variance of what was seen; the held particles keep theirs."""
        precision = jnp.where(self.held[:, None, None], self.precision, self.precision / variance)
        fields = None if self.fields is None else self.fields * jnp.sqrt(variance)
        cloud = self.cloud
        if cloud is not None:
            cloud = eqx.tree_at(lambda c: c.sd_ratio, cloud, cloud.sd_ratio * jnp.sqrt(variance))
        return eqx.tree_at(
            lambda evidence: (evidence.precision, evidence.fields, evidence.cloud),
            self,
            (precision, fields, cloud),
            is_leaf=lambda leaf: leaf is None,
        )

    @property
    def white_precision(self) -> Float[Array, "n 3 3"]:
        """R^-1, the inverse covariance of each position without the noise that neighbours share [1/m^2]."""
        if self.fields is None:
            return self.precision
        shared = jnp.sum(self.seen_fields**2, axis=1)[:, None, None]
        return jnp.linalg.solve(jnp.eye(3)[None] - shared * self.precision, self.precision)

    @property
    def seen_fields(self) -> Float[Array, "n m"]:
        """F in this frame [m]: 0 where a particle is missing or held, and without columns where no noise is shared."""
        if self.fields is None:
            return jnp.zeros((len(self.y), 0), self.y.dtype)
        return jnp.where((self.seen & ~self.held)[:, None], self.fields, 0.0)

    def without_fields(self) -> "Evidence":
        """Return the evidence with all noise taken for that of single particles."""
        return eqx.tree_at(lambda evidence: evidence.fields, self, None, is_leaf=lambda leaf: leaf is None)

    @property
    def seen(self) -> Bool[Array, " n"]:
        """Particles of which anything is known, by perception or by the grip."""
        return jnp.trace(self.precision, axis1=1, axis2=2) > 0

    @property
    def directions(self) -> Int[Array, " n"]:
        """In how many directions each particle is observed [1]: 3, or fewer by a cloud."""
        values = jnp.linalg.eigvalsh(self.precision)
        known = values > jnp.maximum(MIN_DIRECTION * values[:, -1:], MIN_PRECISION)
        return jnp.sum(known, axis=1)
