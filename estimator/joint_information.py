"""Evidence of frames about the bounded stiffnesses s and a few parameters together, in information form."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .belief.attachment_belief import AttachmentBelief

MIN_PRECISION = 1e-9
"""Precision without a prior that keeps a covariance finite where the frames hold
no evidence [1/nat^2]."""


class JointInformation(eqx.Module):
    """Evidence about s and q parameters, which adds up over frames."""

    precision: Float[Array, "n n"]
    """Precision of s."""
    cross: Float[Array, "n q"]
    """Precision between s and the parameters."""
    parameter_precision: Float[Array, "q q"]
    """Precision of the parameters."""
    score: Float[Array, " n"]
    """Gradient of the log likelihood by s."""
    parameter_score: Float[Array, " q"]
    """Gradient of the log likelihood by the parameters."""

    def __add__(self, other: "JointInformation") -> "JointInformation":
        """Return the evidence of both together."""
        return jax.tree.map(jnp.add, self, other)

    def marginal(self, belief: AttachmentBelief, s: Float[Array, " n"]) -> "Remainder":
        """Return the evidence about the parameters alone.

        Args:
            belief: its sites are the prior of s.
            s: where the frames were linearised.
        """
        precision = self.precision + jnp.diag(belief.site_precision)
        score = self.score + belief.site_shift - belief.site_precision * s
        explained = jnp.linalg.solve(precision, jnp.column_stack([self.cross, score]))
        return Remainder(
            precision=np.asarray(self.parameter_precision - self.cross.T @ explained[:, :-1]),
            score=np.asarray(self.parameter_score - self.cross.T @ explained[:, -1]),
            with_s_known=np.asarray(self.parameter_precision),
        )


@dataclass(frozen=True, kw_only=True)
class Remainder:
    """Evidence about the parameters, with s marginalised."""

    precision: Float[np.ndarray, "q q"]
    """Precision of the parameters."""
    score: Float[np.ndarray, " q"]
    """Gradient of the log likelihood by the parameters."""
    with_s_known: Float[np.ndarray, "q q"]
    """Precision that the parameters would have if s were known."""

    def step(self, prior_sd: Float[np.ndarray, " q"], at: Float[np.ndarray, " q"]) -> Float[np.ndarray, " q"]:
        """Return the Gauss-Newton step to the largest posterior density.

        Args:
            prior_sd: standard deviation of each parameter before the frames, about 0.
            at: where the frames were linearised.
        """
        prior = prior_sd**-2.0
        return np.linalg.solve(self.precision + np.diag(prior), self.score - prior * at)

    def covariance(self, prior_sd: Float[np.ndarray, " q"]) -> Float[np.ndarray, "q q"]:
        """Return the covariance of the parameters; infinity stands for no prior.

        It is finite also where the frames hold no evidence.
        """
        prior = np.maximum(prior_sd**-2.0, MIN_PRECISION)
        return np.linalg.inv(self.precision + np.diag(prior))

    def correlation_with_s(self) -> Float[np.ndarray, " q"]:
        """Return the multiple correlation of each parameter with all of s, the other parameters known."""
        known, unknown = np.diagonal(self.with_s_known), np.diagonal(self.precision)
        share = np.divide(unknown, known, out=np.ones_like(known), where=known > 0)
        return np.sqrt(np.clip(1 - share, 0.0, 1.0))
