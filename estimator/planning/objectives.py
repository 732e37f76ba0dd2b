"""What a pull is worth and what it may cost: the paper's four objectives.

Each is a number for one predicted state x. Where the paper has a slip, what it means is written here: the entropy has
its 1/2, and the workspace's function grows below the ground, so that it is its upper bound that keeps the tool above.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def uncertainty_weighted_displacement(
    x: Float[Array, "n 3"], rest: Float[Array, "n 3"], covariance: Float[Array, "n n"]
) -> Float[Array, ""]:
    """UWD = |diag(x_i - x_0i) Sigma|, the Frobenius norm of a 3n x n matrix [m N^2/m^2].

    The matrix is never formed: its square is sum_i |x_i - x_0i|^2 (Sigma^2)_ii.
    """
    moved = jnp.sum((x - rest) ** 2, axis=1)
    return jnp.sqrt(moved @ jnp.sum(covariance**2, axis=1))


def boundary_energy(x: Float[Array, "n 3"], rest: Float[Array, "n 3"], b: Float[Array, " n"]) -> Float[Array, ""]:
    """U_b = 1/2 C_b^T diag(b) C_b, summed over the particles [J]."""
    return 0.5 * jnp.sum(b * jnp.sum((x - rest) ** 2, axis=1))


def workspace(tip: Float[Array, " 3"]) -> Float[Array, ""]:
    """Omega = exp(-min(z, 0)), z in metres above the ground: 1 above it, more below."""
    return jnp.exp(-jnp.minimum(tip[2], 0.0))


def outside(tip: Float[Array, " 3"]) -> Float[Array, ""]:
    """max(0, Omega - 1): how far the tip has left the workspace.

    The paper prints max(0, Omega_min - Omega), which for Omega_min <= 1 is 0 everywhere.
    """
    return jnp.maximum(workspace(tip) - 1.0, 0.0)


def log_shrinkage(slope: Float[Array, "n m 3"], covariance: Float[Array, "n n"], sd: float | Array) -> Float[Array, ""]:
    """Logarithm of |I - K J| for white noise of that deviation [m]: minus twice what the entropy falls by [nat].

    The paper minimises the determinant itself, which for hundreds of particles is 0 in any precision. By Sylvester's
    identity ln |I - K J| = -ln |I + L^T J^T J L / sd^2| with Sigma = L L^T.

    Args:
        slope: J^T, how each particle's stiffness moves m particles.
        covariance: Sigma before the update.
        sd: of each observed coordinate.
    """
    factor = jnp.linalg.cholesky(covariance)
    seen = factor.T @ slope.reshape(len(slope), -1) / sd
    return -jnp.linalg.slogdet(jnp.eye(len(slope), dtype=slope.dtype) + seen @ seen.T)[1]
