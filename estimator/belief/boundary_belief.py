"""Gaussian belief over the attachment stiffnesses b in information form, and its mean under b >= 0.

    p(b) ~ exp(-1/2 b^T Lambda b + eta^T b)

Evidence adds; a cut or a suture adds to the covariance, as in the paper's prediction step. float64 throughout: a
float32 covariance of 600 stiffnesses loses definiteness.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Bool, Float


class BoundaryBelief(eqx.Module):
    """Information form of N(mean, covariance)."""

    precision: Float[Array, "n n"]
    """Lambda [m^2/N^2]."""
    shift: Float[Array, " n"]
    """eta = Lambda mean [m/N]."""

    @classmethod
    def prior(cls, n: int, *, mean: float, sd: float) -> "BoundaryBelief":
        """Independent particles [N/m]."""
        return cls(precision=jnp.eye(n) / sd**2, shift=jnp.full(n, mean / sd**2, dtype=float))

    def add(self, precision: Float[Array, "n n"], shift: Float[Array, " n"]) -> "BoundaryBelief":
        """The belief after independent evidence in information form."""
        return BoundaryBelief(precision=self.precision + precision, shift=self.shift + shift)

    def predict(self, change: Float[Array, " n"], variance: Float[Array, " n"]) -> "BoundaryBelief":
        """After a cut or suture: b + delta_b [N/m] with noise of diagonal covariance W [N^2/m^2], the motion model."""
        mean, covariance = self.moments()
        covariance = covariance + jnp.diag(variance)
        precision = cho_solve((jnp.linalg.cholesky(covariance), True), jnp.eye(len(mean)))
        return BoundaryBelief(precision=precision, shift=precision @ (mean + change))

    def mean(self) -> Float[Array, " n"]:
        """Without the constraint b >= 0 [N/m]."""
        return cho_solve((jnp.linalg.cholesky(self.precision), True), self.shift)

    def moments(self) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
        """Mean [N/m] and covariance [N^2/m^2]."""
        factor = (jnp.linalg.cholesky(self.precision), True)
        return cho_solve(factor, self.shift), cho_solve(factor, jnp.eye(len(self.shift)))

    def entropy(self) -> Float[Array, ""]:
        """Differential entropy n/2 (1 + ln 2 pi) - 1/2 ln det Lambda [nat]; the paper's form lacks the second half."""
        return entropy(jnp.linalg.cholesky(self.precision))

    def non_negative_mean(self, free: Bool[Array, " n"] | None = None) -> Float[Array, " n"]:
        """The most probable b >= 0: argmin 1/2 z^T Lambda z - eta^T z over z >= 0 [N/m].

        `free` is a guess of the particles where it is above 0, to begin with.

        Block principal pivoting [Kim & Park 2011, doi:10.1137/110821172]: exchange all particles that break the
        conditions of optimality, and only one of them once exchanging all stops to help.
        """
        return non_negative_minimum(self.precision, self.shift, self.shift > 0 if free is None else free)


def entropy(factor: Float[Array, "n n"]) -> Float[Array, ""]:
    """Differential entropy [nat] of a Gaussian whose precision has this Cholesky factor."""
    return 0.5 * len(factor) * (1 + jnp.log(2 * jnp.pi)) - jnp.sum(jnp.log(jnp.diagonal(factor)))


def standard_deviations(factor: Float[Array, "n n"]) -> Float[Array, " n"]:
    """Square roots of the diagonal of (L L^T)^-1."""
    inverse = solve_triangular(factor, jnp.eye(len(factor), dtype=factor.dtype), lower=True)
    return jnp.sqrt(jnp.sum(inverse**2, axis=0))


def non_negative_minimum(
    precision: Float[Array, "n n"], shift: Float[Array, " n"], free: Bool[Array, " n"]
) -> Float[Array, " n"]:
    """Argmin 1/2 z^T A z - c^T z over z >= 0 for a positive definite A; see `BoundaryBelief.non_negative_mean`."""
    n = len(shift)
    scale = jnp.sqrt(jnp.diagonal(precision))
    A, c = precision / scale[:, None] / scale[None, :], shift / scale
    tolerance = 1e-12 * jnp.max(jnp.abs(c))

    def solve_on(free: Bool[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        masked = jnp.where(free[:, None] & free[None, :], A, jnp.eye(n, dtype=A.dtype))
        z = cho_solve((jnp.linalg.cholesky(masked), True), jnp.where(free, c, 0))
        return z, A @ z - c

    def wrong(free: Bool[Array, " n"]) -> tuple[Bool[Array, " n"], Float[Array, " n"]]:
        z, dual = solve_on(free)
        return jnp.where(free, z < -tolerance, dual < -tolerance), z

    def exchange(state):
        free, bad, _, fewest, patience, count = state
        number = jnp.sum(bad)
        better = number < fewest
        patience = jnp.where(better, 3, patience - 1)
        last = n - 1 - jnp.argmax(bad[::-1])
        free = jnp.where(better | (patience >= 0), free ^ bad, free.at[last].set(~free[last]))
        bad, z = wrong(free)
        return free, bad, z, jnp.minimum(fewest, number), patience, count + 1

    def unfinished(state):
        _, bad, _, _, _, count = state
        return jnp.any(bad) & (count < 5 * n)

    bad, z = wrong(free)
    state = (free, bad, z, jnp.asarray(n + 1), jnp.asarray(3), jnp.asarray(0))
    free, _, z, _, _, _ = jax.lax.while_loop(unfinished, exchange, state)
    return jnp.where(free, jnp.maximum(z, 0), 0) / scale
