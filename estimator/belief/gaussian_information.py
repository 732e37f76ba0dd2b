"""Gaussian in information form, with named blocks of variables.

    p(x) ~ exp(-1/2 x^T Lambda x + eta^T x),    Lambda = Sigma^-1,    eta = Lambda mu

With x = (a, b), the operations of this file are (the marginal is a Schur complement)

    product      Lambda_1 + Lambda_2,   eta_1 + eta_2
    condition    Lambda_aa,   eta_a - Lambda_ab b
    marginal     Lambda_aa - Lambda_ab Lambda_bb^-1 Lambda_ba,   eta_a - Lambda_ab Lambda_bb^-1 eta_b
    evidence     ln E[exp(-1/2 x^T L x + e^T x)] over N(mu, Sigma)
                 = 1/2 ln |Lambda| - 1/2 ln |Lambda + L|
                 + 1/2 (eta + e)^T (Lambda + L)^-1 (eta + e) - 1/2 eta^T Lambda^-1 eta

JAX arrays are solved by Cholesky factors and may be traced. NumPy arrays stay on the host and are solved by LAPACK's LU
factors: the normal equations of a fit change their size from call to call, for each of which JAX would compile, and
rounding may cost them their definiteness, without which Cholesky fails.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Bool, Float, Int

from ..physics.block_tridiagonal import lower_inverse

HostArray = np.ndarray
"""Array that stays on the host."""


class Gaussian(eqx.Module):
    """Gaussian whose precision is factorised, with the mean and variance of each variable."""

    factor: Float[Array, "n n"]
    """Lower Cholesky factor L of the precision, Lambda = L L^T."""
    mean: Float[Array, " n"]
    """Mean of each variable."""
    variance: Float[Array, " n"]
    """Variance of each variable."""

    @property
    def sd(self) -> Float[Array, " n"]:
        """Return the standard deviation of each variable."""
        return jnp.sqrt(self.variance)

    def solve(self, vector: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return Lambda^-1 v by two triangular solves."""
        return cho_solve((self.factor, True), vector)

    def covariance(self) -> Float[Array, "n n"]:
        """Return the covariance of all variables."""
        return _covariance(self.factor)

    def entropy(self) -> Float[Array, ""]:
        """Return the differential entropy [nat]."""
        return entropy(self.factor)


class GaussianInformation(eqx.Module):
    """Gaussian in information form; a precision may be singular until it is asked for moments."""

    precision: Float[Array | HostArray, "n n"]
    """Lambda, the inverse covariance."""
    shift: Float[Array | HostArray, " n"]
    """Lambda times the mean, eta."""
    blocks: tuple[tuple[str, int], ...] = eqx.field(static=True, default=())
    """Name and size of each block of variables, in order; empty where no operation names one."""

    @classmethod
    def from_moments(cls, mean: Float[Array, " n"], covariance: Float[Array, "n n"]) -> "GaussianInformation":
        """Return the Gaussian with a mean and a covariance."""
        precision = _covariance(jnp.linalg.cholesky(covariance))
        return cls(precision=precision, shift=precision @ mean)

    @classmethod
    def from_normal_equations(cls, square: Float[HostArray, "k k"], **sizes: int) -> "GaussianInformation":
        """Return exp(-|J x + e|^2 / 2) from the products [J e]^T [J e], whose last row and column are those of e."""
        return cls(precision=square[:-1, :-1], shift=-square[:-1, -1], blocks=tuple(sizes.items()))

    def named(self, **sizes: int) -> "GaussianInformation":
        """Return the same Gaussian with its variables divided into blocks of these sizes, in order."""
        if sum(sizes.values()) != len(self.shift):
            raise ValueError(f"the sizes of all blocks must sum to {len(self.shift)}; got {sizes}.")
        return GaussianInformation(precision=self.precision, shift=self.shift, blocks=tuple(sizes.items()))

    def restricted(self, **indices: Int[HostArray, " _"]) -> "GaussianInformation":
        """Return the Gaussian of some variables as blocks, in the given order, with all others fixed at 0."""
        index = np.concatenate(list(indices.values()))
        return GaussianInformation(
            precision=self.precision[np.ix_(index, index)],
            shift=self.shift[index],
            blocks=tuple((name, len(of_name)) for name, of_name in indices.items()),
        )

    def add(self, other: "GaussianInformation") -> "GaussianInformation":
        """Return the product with independent information about the same variables."""
        return GaussianInformation(
            precision=self.precision + other.precision, shift=self.shift + other.shift, blocks=self.blocks
        )

    def with_independent(
        self, name: str, precision: Float[Array | HostArray, " k"], shift: Float[Array | HostArray, " k"] | None = None
    ) -> "GaussianInformation":
        """Return the product with an independent Gaussian for each variable of a block.

        Args:
            name: the block.
            precision: inverse variance of each of its variables.
            shift: precision times mean; None for a mean of 0.
        """
        where, xp = self._slice(name), np if self._on_host else jnp
        pad = where.start, len(self.shift) - where.stop
        added = self.shift if shift is None else self.shift + xp.pad(shift, pad)
        return GaussianInformation(
            precision=self.precision + xp.diag(xp.pad(precision, pad)), shift=added, blocks=self.blocks
        )

    def condition(self, **values: Float[Array | HostArray, " _"]) -> "GaussianInformation":
        """Return the Gaussian of the other blocks where these have the given values."""
        kept, names = self._split(tuple(name for name, _ in self.blocks if name not in values))
        across, xp = self.precision[np.ix_(names, kept)].T, np if self._on_host else jnp
        known = xp.concatenate([values[name] for name, _ in self.blocks if name in values])
        return GaussianInformation(
            precision=self.precision[np.ix_(kept, kept)],
            shift=self.shift[kept] - across @ known,
            blocks=tuple(block for block in self.blocks if block[0] not in values),
        )

    def marginal(self, *names: str) -> "GaussianInformation":
        """Return the Gaussian of some blocks with all other blocks integrated out; blocks keep their order."""
        kept, eliminated = self._split(names)
        precision, shift = _schur_complement(self.precision, self.shift, kept, eliminated)
        return GaussianInformation(
            precision=precision, shift=shift, blocks=tuple(block for block in self.blocks if block[0] in names)
        )

    def without(self, eliminated: Bool[Array, " n"]) -> "GaussianInformation":
        """Return the marginal with masked variables integrated out, their rows and shifts 0.

        The size stays, so that the mask may be traced.
        """
        inside = eliminated[:, None] & eliminated[None]
        held = jnp.where(inside, self.precision, 0.0) + jnp.diag(jnp.where(eliminated, 0.0, 1.0))
        factor = (jnp.linalg.cholesky(held), True)
        across = jnp.where(eliminated[:, None] & ~eliminated[None], self.precision, 0.0)
        kept = jnp.where(~eliminated[:, None] & ~eliminated[None], self.precision, 0.0)
        shift = self.shift - across.T @ cho_solve(factor, jnp.where(eliminated, self.shift, 0.0))
        return GaussianInformation(
            precision=kept - across.T @ cho_solve(factor, across),
            shift=jnp.where(eliminated, 0.0, shift),
            blocks=self.blocks,
        )

    @property
    def factor(self) -> Float[Array, "n n"]:
        """Return the lower Cholesky factor of the precision; NaN where it is not positive definite."""
        return jnp.linalg.cholesky(jnp.asarray(self.precision))

    def gaussian(self) -> Gaussian:
        """Return the factor, the means and the variances, all from one inverse of the factor."""
        factor = self.factor
        inverse = lower_inverse(factor)
        return Gaussian(factor=factor, mean=inverse.T @ (inverse @ self.shift), variance=jnp.sum(inverse**2, axis=0))

    def mean(self) -> Float[Array | HostArray, " n"]:
        """Return the mean of all variables."""
        return (
            np.linalg.solve(self.precision, self.shift) if self._on_host else cho_solve((self.factor, True), self.shift)
        )

    def moments(self) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
        """Return mean and covariance of all variables, by one factor."""
        factor = self.factor
        return cho_solve((factor, True), self.shift), _covariance(factor)

    def covariance(self, *names: str) -> Float[Array | HostArray, "k k"]:
        """Return the covariance of some blocks, or of all variables, the others integrated out."""
        kept = self._split(names)[0] if names else np.arange(len(self.shift))
        if self._on_host:
            return np.linalg.inv(self.precision)[np.ix_(kept, kept)]
        return _covariance(self.factor, kept if names else None)

    def variances(self) -> Float[Array | HostArray, " n"]:
        """Return the variance of each variable; on a device without the products of a full covariance."""
        return np.diagonal(np.linalg.inv(self.precision)) if self._on_host else variances(self.factor)

    def sample(self, noise: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return mu + L^-T z, a draw where z is standard normal noise."""
        factor = self.factor
        return cho_solve((factor, True), self.shift) + solve_triangular(factor.T, noise, lower=False)

    def log_det(self) -> Float[Array, ""] | float:
        """Return ln |Lambda|."""
        return _log_det_and_chi2(self.precision, self.shift)[0]

    def entropy(self) -> Float[Array, ""]:
        """Return the differential entropy [nat]."""
        return entropy(self.factor)

    def log_evidence(self, evidence: "GaussianInformation") -> Float[Array, ""] | float:
        """Return the logarithm of the expected likelihood exp(-1/2 x^T L x + e^T x) [nat]."""
        log_det, chi2 = _log_det_and_chi2(self.precision, self.shift)
        after = self.add(evidence)
        log_det_after, chi2_after = _log_det_and_chi2(after.precision, after.shift)
        return 0.5 * (log_det - log_det_after) + 0.5 * (chi2_after - chi2)

    @property
    def _on_host(self) -> bool:
        return isinstance(self.precision, np.ndarray)

    def _slice(self, name: str) -> slice:
        """Return where a block is; ValueError where there is none of that name."""
        begin = 0
        for block, size in self.blocks:
            if block == name:
                return slice(begin, begin + size)
            begin += size
        raise ValueError(f"no block {name!r} among {[block for block, _ in self.blocks]}.")

    def _split(self, names: tuple[str, ...]) -> tuple[Int[HostArray, " k"], Int[HostArray, " e"]]:
        """Return the indices of the variables of some blocks, and of all others."""
        inside = np.zeros(len(self.shift), bool)
        for name in names:
            inside[self._slice(name)] = True
        return np.flatnonzero(inside), np.flatnonzero(~inside)


def entropy(factor: Float[Array, "n n"]) -> Float[Array, ""]:
    """Return n/2 (1 + ln 2 pi) - 1/2 ln |Lambda| [nat] from the Cholesky factor of Lambda."""
    return 0.5 * len(factor) * (1 + jnp.log(2 * jnp.pi)) - jnp.sum(jnp.log(jnp.diagonal(factor)))


def variances(factor: Float[Array, "n n"]) -> Float[Array, " n"]:
    """Return the diagonal of (L L^T)^-1."""
    return jnp.sum(lower_inverse(factor) ** 2, axis=0)


def _covariance(factor: Float[Array, "n n"], kept: Int[HostArray, " k"] | None = None) -> Float[Array, "k k"]:
    """Return (L L^T)^-1 of some variables, by products: they run several times faster than triangular solves."""
    inverse = lower_inverse(factor)
    inverse = inverse if kept is None else inverse[:, kept]
    return inverse.T @ inverse


def _schur_complement(
    precision: Float[Array | HostArray, "n n"],
    shift: Float[Array | HostArray, " n"],
    kept: Int[HostArray, " k"],
    eliminated: Int[HostArray, " e"],
) -> tuple[Float[Array | HostArray, "k k"], Float[Array | HostArray, " k"]]:
    """Return precision and shift of the variables that are kept, by one solve with those that are not."""
    xp = np if isinstance(precision, np.ndarray) else jnp
    rows = xp.concatenate([precision[np.ix_(eliminated, kept)], shift[eliminated, None]], axis=1)
    inside = precision[np.ix_(eliminated, eliminated)]
    solved = np.linalg.solve(inside, rows) if xp is np else cho_solve((jnp.linalg.cholesky(inside), True), rows)
    explained = rows[:, :-1].T @ solved
    return precision[np.ix_(kept, kept)] - explained[:, :-1], shift[kept] - explained[:, -1]


def _log_det_and_chi2(
    precision: Float[Array | HostArray, "n n"], shift: Float[Array | HostArray, " n"]
) -> tuple[Float[Array, ""] | float, Float[Array, ""] | float]:
    """Return ln |Lambda| and eta^T Lambda^-1 eta, by one factor."""
    if isinstance(precision, np.ndarray):
        return float(np.linalg.slogdet(precision)[1]), float(shift @ np.linalg.solve(precision, shift))
    factor, shift = jnp.linalg.cholesky(precision), jnp.asarray(shift)
    return 2 * jnp.sum(jnp.log(jnp.diagonal(factor))), shift @ cho_solve((factor, True), shift)
