"""The paper's four objectives: what a pull is worth, and what it may cost.

Each is a number for one predicted state x. Where the paper has a slip, the intended formula is used here: the entropy
has its 1/2, and the workspace's function grows below the ground, so that its upper bound keeps the tool above.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def uncertainty_weighted_displacement(
    x: Float[Array, "n 3"], rest: Float[Array, "n 3"], covariance: Float[Array, "n n"]
) -> Float[Array, ""]:
    """Return the uncertainty-weighted displacement UWD = |diag(x_i - x_0i) Sigma| [m N^2/m^2].

    It is the Frobenius norm of a 3n x n matrix that is never formed: its square is sum_i |x_i - x_0i|^2 (Sigma^2)_ii.

    Args:
        x: predicted positions [m].
        rest: positions at rest [m].
        covariance: Sigma, of b [N^2/m^2].
    """
    moved = jnp.sum((x - rest) ** 2, axis=1)
    return jnp.sqrt(moved @ jnp.sum(covariance**2, axis=1))


def boundary_energy(x: Float[Array, "n 3"], rest: Float[Array, "n 3"], b: Float[Array, " n"]) -> Float[Array, ""]:
    """Return the boundary energy U_b = 1/2 C_b^T diag(b) C_b, summed over the particles [J]."""
    return 0.5 * jnp.sum(b * jnp.sum((x - rest) ** 2, axis=1))


def workspace(tip: Float[Array, " 3"]) -> Float[Array, ""]:
    """Return Omega = exp(-min(z, 0)), z in metres above the ground: 1 above it, more below."""
    return jnp.exp(-jnp.minimum(tip[2], 0.0))


def outside(tip: Float[Array, " 3"]) -> Float[Array, ""]:
    """Return max(0, Omega - 1), which grows as the tip leaves the workspace.

    The paper prints max(0, Omega_min - Omega), which for Omega_min <= 1 is 0 everywhere.
    """
    return jnp.maximum(workspace(tip) - 1.0, 0.0)


def log_shrinkage(dx_db: Float[Array, "n m 3"], covariance: Float[Array, "n n"], sd: float | Array) -> Float[Array, ""]:
    """Return ln |I - K J|, minus twice the fall of the entropy [nat].

    The paper minimises the determinant itself, which for hundreds of particles is 0 in any precision. By Sylvester's
    identity ln |I - K J| = -ln |I + L^T J^T J L / sd^2| with Sigma = L L^T.

    Args:
        dx_db: J^T, the derivative of m positions by each particle's stiffness [m^2/N].
        covariance: Sigma before the update [N^2/m^2].
        sd: standard deviation of each observed coordinate's white noise [m].
    """
    factor = jnp.linalg.cholesky(covariance)
    whitened = factor.T @ dx_db.reshape(len(dx_db), -1) / sd
    return -jnp.linalg.slogdet(jnp.eye(len(dx_db), dtype=dx_db.dtype) + whitened @ whitened.T)[1]
