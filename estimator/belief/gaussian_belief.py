"""Gaussian belief over the attachment stiffnesses b in information form, and its mean under b >= 0.

    p(b) ~ exp(-1/2 b^T Lambda b + eta^T b)

Evidence adds to Lambda and eta; a cut or a suture adds to the covariance, as in the paper's prediction step. All arrays
are float64: a float32 covariance of 600 stiffnesses loses definiteness.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Bool, Float

from .gaussian_information import Gaussian, GaussianInformation

RELATIVE_TOLERANCE = 1e-12
"""Violation of a condition of optimality that counts as rounding, over the largest scaled shift."""
PATIENCE = 3
"""Exchanges of all violating particles that may fail to reduce their number before one is exchanged at a time."""
MAX_EXCHANGES_PER_PARTICLE = 5
"""Exchanges over particles after which the search ends, where rounding keeps it from settling."""


class GaussianBelief(eqx.Module):
    """Gaussian N(mean, covariance) over b in information form."""

    precision: Float[Array, "n n"]
    """Inverse covariance Lambda [m^2/N^2]."""
    shift: Float[Array, " n"]
    """Precision times mean, eta = Lambda mean [m/N]."""

    @classmethod
    def prior(cls, n: int, *, mean: float, sd: float) -> "GaussianBelief":
        """Return independent particles, each with this mean and standard deviation [N/m]."""
        return cls(precision=jnp.eye(n) / sd**2, shift=jnp.full(n, mean / sd**2, dtype=float))

    def add(self, precision: Float[Array, "n n"], shift: Float[Array, " n"]) -> "GaussianBelief":
        """Return the belief after independent evidence in information form."""
        return GaussianBelief(precision=self.precision + precision, shift=self.shift + shift)

    def predict(self, change: Float[Array, " n"], variance: Float[Array, " n"]) -> "GaussianBelief":
        """Predict b after a cut or suture: b + delta_b [N/m] with noise of diagonal covariance W [N^2/m^2]."""
        mean, covariance = self.moments()
        after = GaussianInformation.from_moments(mean + change, covariance + jnp.diag(variance))
        return GaussianBelief(precision=jnp.asarray(after.precision), shift=jnp.asarray(after.shift))

    @property
    def information(self) -> GaussianInformation:
        """Return the same Gaussian, for marginals, evidence and draws."""
        return GaussianInformation(precision=self.precision, shift=self.shift)

    def gaussian(self) -> Gaussian:
        """Return the Gaussian over b with its factor, means and variances."""
        return self.information.gaussian()

    def mean(self) -> Float[Array, " n"]:
        """Return the mean without the constraint b >= 0 [N/m]."""
        return jnp.asarray(self.information.mean())

    def moments(self) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
        """Return mean [N/m] and covariance [N^2/m^2]."""
        return self.information.moments()

    def entropy(self) -> Float[Array, ""]:
        """Return n/2 (1 + ln 2 pi) - 1/2 ln |Lambda| [nat]; the paper's form lacks the second term."""
        return self.information.entropy()

    def non_negative_mean(self, free: Bool[Array, " n"] | None = None) -> Float[Array, " n"]:
        """Return the most probable b >= 0, argmin 1/2 z^T Lambda z - eta^T z over z >= 0 [N/m].

        Block principal pivoting [Kim & Park 2011, doi:10.1137/110821172]: exchange all particles that violate the
        conditions of optimality, or only one of them where exchanging all does not reduce their number.

        Args:
            free: first guess of the particles with b > 0; by default those with a positive shift.
        """
        return non_negative_minimum(self.precision, self.shift, self.shift > 0 if free is None else free)


def non_negative_minimum(
    precision: Float[Array, "n n"], shift: Float[Array, " n"], free: Bool[Array, " n"]
) -> Float[Array, " n"]:
    """Return argmin 1/2 z^T A z - c^T z over z >= 0, A positive definite; see `GaussianBelief.non_negative_mean`."""
    n = len(shift)
    scale = jnp.sqrt(jnp.diagonal(precision))
    A, c = precision / scale[:, None] / scale[None, :], shift / scale
    tolerance = RELATIVE_TOLERANCE * jnp.max(jnp.abs(c))

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
        patience = jnp.where(better, PATIENCE, patience - 1)
        last = n - 1 - jnp.argmax(bad[::-1])
        free = jnp.where(better | (patience >= 0), free ^ bad, free.at[last].set(~free[last]))
        bad, z = wrong(free)
        return free, bad, z, jnp.minimum(fewest, number), patience, count + 1

    def unfinished(state):
        _, bad, _, _, _, count = state
        return jnp.any(bad) & (count < MAX_EXCHANGES_PER_PARTICLE * n)

    bad, z = wrong(free)
    state = (free, bad, z, jnp.asarray(n + 1), jnp.asarray(PATIENCE), jnp.asarray(0))
    free, _, z, _, _, _ = jax.lax.while_loop(unfinished, exchange, state)
    return jnp.where(free, jnp.maximum(z, 0), 0) / scale
