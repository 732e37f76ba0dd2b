"""What a frame gives to a filter, and what the filter gives back: one interface for all of them."""

from abc import ABC, abstractmethod
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..belief.attachment_belief import AttachmentBelief
from ..belief.boundary_belief import BoundaryBelief
from .noise import Noise


class Pull(eqx.Module):
    """The tool's step that led to a frame, for filters that simulate it."""

    before: Float[Array, "n 3"]
    """Positions in the frame before [m]."""
    tip: Float[Array, " 3"]
    """Where the tip moved [m]."""
    length: Float[Array, " n"]
    """Distance of each particle from the tip when the jaws closed [m]."""


class Evidence(eqx.Module):
    """One frame's measurements of the particles."""

    y: Float[Array, "n 3"]
    """Observed positions, anything finite where there is none [m]."""
    precision: Float[Array, "n 3 3"]
    """R^-1, zero where a particle is missing [1/m^2]."""
    held: Bool[Array, " n"]
    """Particles in the grip, which follow the tip."""
    force_unknown: Bool[Array, " n"]
    """Particles that the grip may pull at, the held ones among them, whose balance of forces is unknown."""
    pull: Pull | None = None

    def widened(self, variance: float) -> "Evidence":
        """With that many times the variance of what was seen; what the grip says of held particles stays."""
        precision = jnp.where(self.held[:, None, None], self.precision, self.precision / variance)
        return eqx.tree_at(lambda one: one.precision, self, precision)

    @property
    def seen(self) -> Bool[Array, " n"]:
        """Particles of which anything is known, from sight or from the grip."""
        return jnp.trace(self.precision, axis1=1, axis2=2) > 0


class PosteriorSummary(eqx.Module):
    """What a filter believes; what it does not state (uncertainty, or P(attached)) is NaN."""

    belief: BoundaryBelief | AttachmentBelief
    """Of the kind that the filter was given."""
    b: Float[Array, " n"]
    """Non-negative mean [N/m]."""
    sd: Float[Array, " n"]
    """Standard deviation of each b, without the constraint [N/m]."""
    probability: Float[Array, " n"]
    """P(attached)."""
    entropy: Float[Array, ""]
    """Of the belief [nat]."""
    converged: Bool[Array, ""]
    """Of a frame, whether the search for its state came to an end, or was cut off; when the jaws open, whether both
    halves of the samples agree. True where nothing is searched or sampled."""


class Update(PosteriorSummary):
    """The outcome of one frame."""

    x: Float[Array, "n 3"]
    """State after the update [m]."""
    nis: Float[Array, ""]
    """Normalised innovation squared per degree of freedom, before the update; 1 where the stated noises are right."""


class Filter(ABC):
    """A way to update the belief; it may keep frames of its own for later updates."""

    @property
    def noise(self) -> Noise | None:
        """How much wider than typed the noises had to be; None where that is not learned."""
        return None

    @abstractmethod
    def update(self, belief: Any, b: Float[Array, " n"], evidence: Evidence, start: Float[Array, "n 3"]) -> Update:
        """Take one frame into the belief.

        Args:
            belief: before the frame, of the filter's own kind.
            b: its non-negative mean [N/m].
            evidence: what was seen.
            start: where a search for the state may begin [m].
        """

    def forget(self) -> None:  # noqa: B027  # most keep nothing
        """Something was cut or sewn: take nothing again that was seen before."""

    def reconsider(self, belief: Any) -> PosteriorSummary | None:
        """A second look at a belief between two frames, for whoever acts on it; None where there is none."""
        return None

    def release(self, belief: Any, *, thorough: bool = True) -> PosteriorSummary | None:
        """Say that the jaws have opened; None where that changes nothing. In passing if more grasps are to come."""
        return None


def unavailable(like: Float[Array, " n"]) -> Float[Array, " n"]:
    """NaN for every particle."""
    return jnp.full_like(like, jnp.nan)
