"""Noise that neighbours share, in one linearised frame.

Observed positions err by white noise of each particle and by smooth fields over the sheet,

    y = x + F a + n_y,  a ~ N(0, I),  n_y ~ N(0, R).

By Woodbury's identity, with U = R^-1 F, M = I + F^T U and A the frame's matrix with R alone,

    (R + F F^T)^-1 = R^-1 - U M^-1 U^T,
    (A - U M^-1 U^T)^-1 = A^-1 + G S^-1 G^T,  G = A^-1 U,  S = M - U^T G.

Every coordinate has the same fields. `FrameNoise` holds U, M, G and S.
"""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Float

from ..physics.block_tridiagonal import BlockCholesky, Layout, solve


class FrameNoise(eqx.Module):
    """Smooth noise of one frame, with c = 3 m columns: each field in the three directions."""

    fields: Float[Array, "n m"]
    """Fields of unit amplitude: F [m]; 0 where nothing was seen."""
    weighted: Float[Array, "n 3 c"]
    """Fields weighted by R^-1: U [1/m]."""
    among: Float[Array, "c c"]
    """Lower Cholesky factor of M."""
    states: Float[Array, "n 3 c"]
    """How the fitted state follows each column: G [m]."""
    spread: Float[Array, "c c"]
    """Lower Cholesky factor of S."""

    @classmethod
    def build(
        cls, layout: Layout, factor: BlockCholesky, precision: Float[Array, "n 3 3"], fields: Float[Array, "n m"]
    ) -> "FrameNoise":
        """Prepare the fields for a factor of A = R^-1 + H^T W H, given R^-1."""
        weighted = jnp.einsum("nij,nm->nimj", precision, fields).reshape(*precision.shape[:2], -1)
        M = jnp.eye(weighted.shape[2]) + _products(fields, weighted)
        states = each(partial(solve, layout, factor), weighted)
        S = M - jnp.einsum("nia,nib->ab", weighted, states)
        return cls(
            fields=fields,
            weighted=weighted,
            among=jnp.linalg.cholesky(M),
            states=states,
            spread=jnp.linalg.cholesky(S),
        )

    def amplitudes(self, residual: Float[Array, "n 3"]) -> Float[Array, " c"]:
        """Return the likeliest a for a residual y - x [m]."""
        return cho_solve((self.among, True), jnp.einsum("nic,ni->c", self.weighted, residual))

    def explained(self, residual: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Return which part of a residual y - x is most likely smooth noise [m]."""
        return self.fields @ self.amplitudes(residual).reshape(-1, 3)

    def added_pull(self, residual: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Return ((R + F F^T)^-1 - R^-1) times a residual [1/m]."""
        return -self.weighted @ self.amplitudes(residual)

    def added_cost(self, residual: Float[Array, "n 3"]) -> Float[Array, ""]:
        """Return what smooth noise adds to the squared norm of a residual y - x, which is never positive."""
        return jnp.sum(residual * self.added_pull(residual))

    def added_state(self, state: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """Return G S^-1 U^T times A^-1 v: what smooth noise adds to the solution for v [m]."""
        return self.states @ cho_solve((self.spread, True), jnp.einsum("nic,ni->c", self.weighted, state))

    def whitened(self, columns: Float[Array, "... c"]) -> Float[Array, "... c"]:
        """Return rows of columns times S^(-T/2): their squares are what G S^-1 G^T adds to a covariance."""
        flat = columns.reshape(-1, columns.shape[-1])
        return solve_triangular(self.spread, flat.T, lower=True).T.reshape(columns.shape)

    def spread_of(self, linear_map: Callable[[Array], Array]) -> Float[Array, " n"]:
        """Return what smooth noise adds to the trace of B A^-1 B^T, for each particle's rows B of a linear map."""
        return jnp.sum(self.whitened(each(linear_map, self.states)) ** 2, axis=(1, 2))

    def added_degrees(self, root: Float[Array, "n 3 3"]) -> Float[Array, ""]:
        """Return what smooth noise adds to the degrees of freedom of the white residuals, which is negative.

        It is tr(S^-1 M) + tr(S^-1) - 2 c - tr(S^-1 G^T R^-1 G).

        Args:
            root: of R^-1 = root^T root, 0 for particles whose residual does not count.
        """
        M, c = self.among @ self.among.T, len(self.among)
        seen = self.whitened(jnp.einsum("nij,njc->nic", root, self.states))
        return jnp.trace(cho_solve((self.spread, True), M + jnp.eye(c))) - 2 * c - jnp.sum(seen**2)


def each(linear_map: Callable[[Array], Array], columns: Float[Array, "n 3 c"]) -> Float[Array, "n 3 c"]:
    """Return a linear map of each column."""
    return jax.vmap(linear_map, in_axes=2, out_axes=2)(columns)


def _products(fields: Float[Array, "n m"], weighted: Float[Array, "n 3 c"]) -> Float[Array, "c c"]:
    """Return F^T U."""
    c = weighted.shape[2]
    return jnp.einsum("nm,nic->mic", fields, weighted).reshape(c, c)
