"""One frame's linearised balance of forces, the state fitted to it, and its evidence about s."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..physics.block_tridiagonal import BlockCholesky, BlockTridiagonal
from .evidence import Evidence
from .smooth_noise import FrameNoise


class Frame(eqx.Module):
    """The balance of forces r(x; s) linearised at a state x and bounded stiffnesses s."""

    x: Float[Array, "n 3"]
    """State of the linearisation [m]."""
    s: Float[Array, " n"]
    """Bounded stiffnesses of the linearisation [1]."""
    unbalanced: Float[Array, "n 3"]
    """Residual force r(x; s) [N]."""
    dr_ds: Float[Array, "n 3"]
    """D = dr/ds of each particle by its own s [N]."""
    dD_dx: Float[Array, "n p 3 3"]
    """Derivative of D by the positions of the particle's neighbours [N/m]."""
    dr_dx: Float[Array, "n p 3 3"]
    """H = dr/dx by the positions of the particle's neighbours [N/m]."""
    error: Float[Array, " n"]
    """tau, the standard deviation of the model's force error [N]."""
    weight: Float[Array, " n"]
    """W, the inverse variance of each component of r [1/N^2]; 0 where the force is unknown."""
    factor: BlockCholesky
    """Cholesky factor of A = R^-1 + H^T W H, with R the white noise alone; `smooth` adds what neighbours share."""
    evidence: Evidence
    """What was measured; a cloud as it is matched to the surface at x."""
    smooth: FrameNoise | None
    """Noise that neighbours share; None for none."""
    converged: Bool[Array, ""]
    """Whether the search for x, if there was one, ended before its largest number of steps."""

    @property
    def innovation(self) -> Float[Array, "n 3"]:
        """Return y - x, zero where nothing was seen [m]."""
        return jnp.where(self.evidence.seen[:, None], self.evidence.y - self.x, 0.0)


class Fit(eqx.Module):
    """The state that explains a frame best, for the s of its linearisation."""

    residual: Float[Array, "n 3"]
    """Residual force at the observed positions, e = r + H (y - x) [N]."""
    force_residual: Float[Array, "n 3"]
    """Residual force at the fitted state [N]."""
    position_residual: Float[Array, "n 3"]
    """Observed less fitted position [m]."""
    covariance: BlockTridiagonal
    """Blocks of A^-1 where A has blocks [m^2]: the covariance of the fitted state by white noise alone, without what
    `Frame.smooth` adds to it."""


class FrameInformation(eqx.Module):
    """A frame's evidence about s in information form, its state eliminated."""

    precision: Float[Array, "n n"]
    """Precision of s, D^T N^-1 D."""
    score: Float[Array, " n"]
    """-D^T N^-1 e with e = r + H (y - x): the gradient of the log likelihood at the s of the linearisation."""
    chi2: Float[Array, ""]
    """Squared whitened residual, e^T N^-1 e."""
    at: Float[Array, " n"]
    """s of the linearisation."""

    @property
    def shift(self) -> Float[Array, " n"]:
        """Information vector: the precision times the s that the frame alone prefers."""
        return self.score + self.precision @ self.at
