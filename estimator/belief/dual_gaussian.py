"""Gaussian over all s for any choice of components, updated at a cost that follows the number of attached particles.

Most particles are free, and all free ones have the same narrow prior of precision T. So the evidence with every
particle free, of precision Lambda and shift eta, is factorised once for all choices of components:

    K = Lambda (Lambda + T I)^-1,    q = T (Lambda + T I)^-1 eta

By Woodbury's identity the attached particles then act like measurements of a Gaussian process with mean q and
covariance K [Rasmussen & Williams 2006, ISBN 0-262-18253-X, section 2.2]. A component of precision T_k and mean mu_k is
a measurement of precision T / T_k - 1 whose precision times value is -T mu_k; free is none. Without its own
measurement, a particle's process has variance g and mean v, and the evidence of all others about its s has

    precision T g / (1 - g),    shift v / (1 - g)

The covariance after measurements is K less one outer product for each of them, so that a column of it costs no product
with all of K.
"""

import itertools
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int

from .gaussian_information import GaussianInformation

FIRST_BLOCK = 64
"""Outer products in the first block, whose sum is taken at once. Every later block has as many as all before it, so
that a sum takes at most twice as many as there are."""
MIN_PRECISION = 1e-8
"""Smallest precision of the evidence about one particle's s, where rounding could make it negative; s is in [0, 1]."""
MIN_COMPLEMENT = 1e-14
"""Smallest of 1 - g and of the share of a particle's variance that its own measurement leaves, where they divide."""


class Cavity(NamedTuple):
    """What the evidence of all other particles says of some s."""

    mean: Float[Array, " m"]
    variance: Float[Array, " m"]


class DualGaussian(eqx.Module):
    """The process with every particle free, and the measurement that each component is."""

    kernel: Float[Array, "n n"]
    """Covariance K of the process."""
    mean: Float[Array, " n"]
    """Mean q of the process."""
    scale: Float[Array, ""]
    """T, the precision of s of a free particle."""
    precision: Float[Array, " c"]
    """Precision of each component as a measurement; 0 for free."""
    shift: Float[Array, " c"]
    """The same times its value."""

    @classmethod
    def build(
        cls,
        precision: Float[Array, "n n"],
        shift: Float[Array, " n"],
        *,
        centre: Float[Array, " c"],
        sd: Float[Array, " c"],
    ) -> "DualGaussian":
        """Factorise the evidence.

        Args:
            precision: Lambda.
            shift: eta.
            centre: mean of s of each component; the first is free, its mean 0.
            sd: standard deviation of s of each component; that of the first must be the smallest.
        """
        T, one = sd[0] ** -2, jnp.eye(len(shift), dtype=shift.dtype)
        inverse = jnp.asarray(GaussianInformation(precision + T * one, shift).covariance())
        return cls(
            kernel=one - T * inverse,
            mean=T * (inverse @ shift),
            scale=T,
            precision=(sd / sd[0]) ** 2 - 1,
            shift=-T * centre,
        )

    def measured(self, component: Int[Array, " n"]) -> "MeasuredGaussian":
        """Return the process with the given components: all attached particles are measured, a block at a time."""
        n, attached = len(component), component > 0
        sizes = _block_sizes(n + FIRST_BLOCK)
        count = jnp.sum(attached)
        order = jnp.append(jnp.argsort(~attached, stable=True), jnp.zeros(sum(sizes) - n, int))
        process = MeasuredGaussian(
            dual=self,
            columns=tuple(jnp.zeros((size, n), self.kernel.dtype) for size in sizes),
            factors=jnp.ones(sum(sizes), self.kernel.dtype),
            count=count,
            mean=self.mean,
            variance=jnp.diagonal(self.kernel),
        )
        for k, size in enumerate(sizes):
            start = sum(sizes[:k])
            i, inside = order[start : start + size], start + jnp.arange(size) < count
            process = process.with_block(k, i, component[i], inside)
        return process


class MeasuredGaussian(eqx.Module):
    """The process after measurements."""

    dual: DualGaussian
    columns: tuple[Float[Array, "_block n"], ...]
    """Vectors of the outer products that are subtracted from the covariance, the first `count` of them, in blocks."""
    factors: Float[Array, " _capacity"]
    """Factor of each."""
    count: Int[Array, ""]
    """Number of outer products."""
    mean: Float[Array, " n"]
    """Mean of the process."""
    variance: Float[Array, " n"]
    """Variance of the process."""

    @property
    def full(self) -> Bool[Array, ""]:
        """Whether there is no room for another change."""
        return self.count >= len(self.factors)

    def cavity(self, i: Int[Array, " m"], component: Int[Array, " m"]) -> Cavity:
        """Return what all other particles say of the s of some, each with its present component."""
        precision, shift = self.dual.precision[component], self.dual.shift[component]
        variance, left = self.variance[i], jnp.maximum(1 - precision * self.variance[i], MIN_COMPLEMENT)
        g, v = variance / left, (self.mean[i] - variance * shift) / left
        complement = jnp.maximum(1 - g, MIN_COMPLEMENT)
        own = jnp.maximum(self.dual.scale * g / complement, MIN_PRECISION)
        return Cavity(mean=v / complement / own, variance=1 / own)

    def changed(self, i: Int[Array, ""], old: Int[Array, ""], new: Int[Array, ""]) -> "MeasuredGaussian":
        """Return the process after a particle's component has changed from the old to the new one."""
        precision = self.dual.precision[new] - self.dual.precision[old]
        shift = self.dual.shift[new] - self.dual.shift[old]
        column = self.dual.kernel[i]
        for start, block in zip(self._starts, self.columns, strict=True):

            def subtracted(column, start=start, block=block):
                return column - (self.factors[start : start + len(block)] * block[:, i]) @ block

            column = jax.lax.cond(self.count > start, subtracted, lambda column: column, column)
        factor = 1 / (1 + precision * column[i])
        return MeasuredGaussian(
            dual=self.dual,
            columns=tuple(map(partial(self._written, column), self._starts, self.columns)),
            factors=jax.lax.dynamic_update_index_in_dim(self.factors, factor * precision, self.count, 0),
            count=self.count + (new != old).astype(self.count.dtype),
            mean=self.mean + factor * (shift - precision * self.mean[i]) * column,
            variance=self.variance - factor * precision * column**2,
        )

    def with_block(
        self, k: int, i: Int[Array, " block"], component: Int[Array, " block"], inside: Bool[Array, " block"]
    ) -> "MeasuredGaussian":
        """Return the process after the k-th block of measurements, of which some are inside, after all of those before.

        Each of them is a measurement with a factor of 1, whose columns are those of the Cholesky factor.
        """

        def measure():
            rows = self.dual.kernel[i]
            for block in self.columns[:k]:
                rows = rows - block[:, i].T @ block
            rows = jnp.where(inside[:, None], rows, 0)
            precision = jnp.where(inside, self.dual.precision[component], 1)
            square = jnp.where(inside[None], rows[:, i], 0) + jnp.diag(1 / precision)
            error = jnp.where(inside, self.dual.shift[component] / precision - self.mean[i], 0)
            rhs = jnp.concatenate([rows, error[:, None]], axis=1)
            solved = solve_triangular(jnp.linalg.cholesky(square), rhs, lower=True)
            columns = solved[:, :-1]
            mean, variance = self.mean + solved[:, -1] @ columns, self.variance - jnp.sum(columns**2, axis=0)
            return columns, mean, variance

        columns, mean, variance = jax.lax.cond(
            jnp.any(inside), measure, lambda: (self.columns[k], self.mean, self.variance)
        )
        return eqx.tree_at(
            lambda process: (process.columns[k], process.mean, process.variance), self, (columns, mean, variance)
        )

    @property
    def _starts(self) -> tuple[int, ...]:
        """Return the number of outer products before each block."""
        return tuple(itertools.accumulate(map(len, self.columns[:-1]), initial=0))

    def _written(self, column: Float[Array, " n"], start: int, block: Float[Array, "m n"]) -> Float[Array, "m n"]:
        """Return a block with a column written behind all others, if that is inside of it."""
        row = jnp.clip(self.count - start, 0, len(block) - 1)
        new = jnp.where(self.count - start == row, column, jax.lax.dynamic_index_in_dim(block, row, keepdims=False))
        return jax.lax.dynamic_update_index_in_dim(block, new, row, 0)


def _block_sizes(capacity: int) -> tuple[int, ...]:
    """Return the sizes of blocks that hold so many outer products."""
    sizes = [FIRST_BLOCK]
    while (total := sum(sizes)) < capacity:
        sizes.append(min(total, capacity - total))
    return tuple(sizes)
