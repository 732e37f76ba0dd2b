"""The posterior after a frame or a grasp, with the reason where a search or samples did not converge."""

from enum import IntEnum
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..belief.attachment_belief import AttachmentBelief
from ..belief.gaussian_belief import GaussianBelief


class Convergence(IntEnum):
    """How a search or a round of samples ended; `PosteriorSummary` holds the code as an array, so that JAX compiles."""

    CONVERGED = 0
    """The search ended by itself, the samples agree, or nothing was searched or sampled."""
    SEARCH_CUT_OFF = 1
    """The search for a frame's state reached its largest number of steps."""
    SAMPLES_DISAGREE = 2
    """The two halves of the chains of samples give different P(attached)."""

    def unless(self, converged: Bool[Array, ""]) -> Int[Array, ""]:
        """Return the code CONVERGED where that is true, else this one's."""
        return jnp.where(converged, int(Convergence.CONVERGED), int(self))

    @property
    def code(self) -> Int[Array, ""]:
        """The code as an array."""
        return jnp.asarray(int(self))


class PosteriorSummary(eqx.Module):
    """A filter's belief and each particle's own numbers; NaN where a filter gives no uncertainty or no P(attached)."""

    belief: GaussianBelief | AttachmentBelief
    """Posterior over all attachments, of the filter's own kind."""
    b: Float[Array, " n"]
    """Non-negative mean of each stiffness [N/m]."""
    sd: Float[Array, " n"]
    """Standard deviation of each b, without the constraint b >= 0 [N/m]."""
    probability: Float[Array, " n"]
    """P(attached) of each particle."""
    entropy: Float[Array, ""]
    """Differential entropy of the belief [nat]."""
    convergence: Int[Array, ""]
    """Code of the `Convergence`: of the search for the state after a frame, of the samples after a release."""

    @property
    def converged(self) -> Bool[Array, ""]:
        """Whether neither the search was cut off nor the samples disagree."""
        return self.convergence == int(Convergence.CONVERGED)

    @property
    def reason(self) -> Convergence:
        """How the search or the samples ended; outside of compiled functions only."""
        return Convergence(int(self.convergence))

    @property
    def is_finite(self) -> bool:
        """Whether b, its standard deviation and P(attached) are all numbers; outside of compiled functions only."""
        return are_finite(self.b, self.sd, self.probability)


class Update(PosteriorSummary):
    """The outcome of one frame."""

    x: Float[Array, "n 3"]
    """State after the update [m]."""
    nis: Float[Array, ""]
    """Normalised innovation squared per degree of freedom, before the update; 1 where the noises are right."""

    @property
    def explains_the_frame(self) -> bool:
        """Whether state and stiffnesses are all numbers; if not, no sheet explains the frame."""
        return are_finite(self.x, self.b)


def prior_summary(belief: GaussianBelief | AttachmentBelief, n: int) -> PosteriorSummary:
    """Return the summary of a prior over n particles: b = 0, and no number for a single particle."""
    unknown = jnp.full(n, jnp.nan)
    return PosteriorSummary(
        belief=belief,
        b=jnp.zeros(n),
        sd=unknown,
        probability=unknown,
        entropy=belief.entropy(),
        convergence=Convergence.CONVERGED.code,
    )


def are_finite(*arrays: Any) -> bool:
    """Whether every entry of every array is a number."""
    return all(bool(np.isfinite(array).all()) for array in arrays)


def unavailable(like: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return NaN for every particle: the filter does not give this number."""
    return jnp.full_like(like, jnp.nan)
