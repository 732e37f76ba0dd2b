"""Symmetric block-tridiagonal matrices over particles: layout, assembly from elements, Cholesky factorisation, solves.

Particles in a good order interact only within a band; cutting the order into blocks as wide as the band leaves a
block-tridiagonal matrix, whose Cholesky factor costs O(n band^2) instead of O(n^3). `Layout` holds the order,
`BlockTridiagonal` the numbers. Every particle carries three degrees of freedom. Not a general sparse solver: the band
must fit.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, Int
from scipy.sparse.csgraph import reverse_cuthill_mckee

SWEEPS = 36
"""Directions in which an order along a line is tried."""
SMALL = 64
"""Triangles up to this size are inverted by substitution."""


class Layout(eqx.Module):
    """Which particle sits where in the blocks; the last block is padded."""

    slot: Int[np.ndarray, " n"] | Int[Array, " n"]
    """Place of each particle in the padded order."""
    n_blocks: int = eqx.field(static=True)
    width: int = eqx.field(static=True)
    """Particles in a block."""

    @classmethod
    def from_pattern(cls, pattern: sp.csr_matrix, points: Float[np.ndarray, "n d"] | None = None) -> "Layout":
        """Order the particles of a symmetric n x n sparsity pattern so that its band is narrow.

        Reverse Cuthill-McKee [Cuthill & McKee 1969, doi:10.1145/800195.805928], or, where the particles' positions
        are given and that is narrower, along a direction in the plane of their two largest extents.
        """
        rows, columns = pattern.nonzero()
        orders = [reverse_cuthill_mckee(pattern.tocsr(), symmetric_mode=True)]
        if points is not None:
            centred = points - points.mean(axis=0)
            plane = centred @ np.linalg.svd(centred, full_matrices=False)[2][:2].T
            angles = np.linspace(0, np.pi, SWEEPS, endpoint=False)
            orders += [np.argsort(plane @ (np.cos(angle), np.sin(angle)), kind="stable") for angle in angles]
        ranks = [np.argsort(order) for order in orders]
        bands = [max(1, int(np.abs(rank[rows] - rank[columns]).max(initial=1))) for rank in ranks]
        best, n = int(np.argmin(bands)), len(orders[0])
        n_blocks = max(1, n // bands[best])
        return cls(slot=ranks[best], n_blocks=n_blocks, width=-(-n // n_blocks))

    def blocks(self, values: Float[Array, "n ..."]) -> Float[Array, "blocks width ..."]:
        """Lay particle rows out in blocks; padding is zero."""
        rest = values.shape[1:]
        padded = jnp.zeros((self.n_blocks * self.width, *rest), values.dtype).at[self.slot].set(values)
        return padded.reshape(self.n_blocks, self.width, *rest)

    def rows(self, blocks: Float[Array, "blocks width ..."]) -> Float[Array, "n ..."]:
        """The inverse of `blocks`."""
        return blocks.reshape(self.n_blocks * self.width, *blocks.shape[2:])[self.slot]

    def pair_index(self, vertices: Int[np.ndarray, "m p"]) -> Int[np.ndarray, "m p p"]:
        """Where the 3x3 window of each ordered vertex pair of an element is stored; pairs above the diagonal fall off.

        A vertex of -1 stands for 'none'.

        Raises:
            ValueError: a pair lies outside the band that the layout was made for.
        """
        rank = np.append(np.asarray(self.slot), -1)[vertices]
        row, column = rank[:, :, None], rank[:, None, :]
        jump = row // self.width - column // self.width
        absent = (row < 0) | (column < 0)
        if np.any((np.abs(jump) > 1) & ~absent):
            raise ValueError("an element couples particles further apart than the layout's band.")
        window = (jump * self.n_blocks + column // self.width) * self.width**2
        window = window + (row % self.width) * self.width + column % self.width
        return np.where(absent | (jump < 0), 2 * self.n_blocks * self.width**2, window)


class BlockTridiagonal(eqx.Module):
    """A symmetric block-tridiagonal matrix."""

    diagonal: Float[Array, "blocks m m"]
    lower: Float[Array, "blocks-1 m m"]
    """Block (k + 1, k)."""


class BlockCholesky(eqx.Module):
    """The factor L of A = L L^T, block-bidiagonal.

    The diagonal blocks are kept as inverses: products with them run several times faster than triangular solves.
    """

    inverse: Float[Array, "blocks m m"]
    """Inverse of each diagonal block."""
    lower: Float[Array, "blocks-1 m m"]
    """Block (k + 1, k)."""


def assemble(
    layout: Layout, elements: list[tuple[Int[Array, "_m _p _p"], Float[Array, "_m _p 3 _p 3"]]]
) -> BlockTridiagonal:
    """Sum element matrices, each given with its `Layout.pair_index`; padding gets an identity."""
    nb, w = layout.n_blocks, layout.width
    index = jnp.concatenate([i.reshape(-1) for i, _ in elements])
    windows = jnp.concatenate([jnp.swapaxes(h, 2, 3).reshape(-1, 3, 3) for _, h in elements])
    storage = jnp.zeros((2 * nb * w * w + 1, 3, 3), windows.dtype).at[index].add(windows)
    blocks = storage[:-1].reshape(2, nb, w, w, 3, 3).swapaxes(3, 4).reshape(2, nb, 3 * w, 3 * w)
    return add_to_diagonal(
        layout,
        BlockTridiagonal(diagonal=blocks[0], lower=blocks[1, : nb - 1]),
        jnp.zeros((len(layout.slot), 3, 3)),
        1.0,
    )


def add_to_diagonal(
    layout: Layout, matrix: BlockTridiagonal, windows: Float[Array, "n 3 3"], padding: float = 0.0
) -> BlockTridiagonal:
    """Add a 3x3 window to each particle's place on the diagonal, and a multiple of the identity to the padding's."""
    nb, w = layout.n_blocks, layout.width
    filled = jnp.broadcast_to(padding * jnp.eye(3, dtype=windows.dtype), (nb * w, 3, 3)).at[layout.slot].set(windows)
    place = jnp.arange(w)
    diagonal = matrix.diagonal.reshape(nb, w, 3, w, 3)
    diagonal = diagonal.at[:, place, :, place, :].add(filled.reshape(nb, w, 3, 3).swapaxes(0, 1))
    return BlockTridiagonal(diagonal=diagonal.reshape(nb, 3 * w, 3 * w), lower=matrix.lower)


def cholesky(matrix: BlockTridiagonal) -> BlockCholesky:
    """Factor A = L L^T block by block; NaN where A is not positive definite."""

    def step(previous, blocks):
        diagonal, lower = blocks
        coupling = lower @ previous.T
        factor = jnp.linalg.cholesky(diagonal - coupling @ coupling.T, symmetrize_input=False)
        inverse = lower_inverse(factor)
        return inverse, (inverse, coupling)

    before_first = jnp.zeros_like(matrix.diagonal[0])
    lower = jnp.concatenate([before_first[None], matrix.lower])
    _, (inverse, lower) = jax.lax.scan(step, before_first, (matrix.diagonal, lower))
    return BlockCholesky(inverse=inverse, lower=lower[1:])


def lower_inverse(factor: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """Inverse of a lower triangular matrix, by halves: products run several times faster than triangular solves."""
    m = len(factor)
    if m <= SMALL:
        return solve_triangular(factor, jnp.eye(m, dtype=factor.dtype), lower=True)
    first, last = lower_inverse(factor[: m // 2, : m // 2]), lower_inverse(factor[m // 2 :, m // 2 :])
    corner = -last @ (factor[m // 2 :, : m // 2] @ first)
    return jnp.block([[first, jnp.zeros_like(corner.T)], [corner, last]])


def multiply(layout: Layout, matrix: BlockTridiagonal, x: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """A x for one vector given per particle."""
    v = layout.blocks(x).reshape(layout.n_blocks, -1)
    out = jnp.einsum("bij,bj->bi", matrix.diagonal, v)
    out = out.at[1:].add(jnp.einsum("bij,bj->bi", matrix.lower, v[:-1]))
    out = out.at[:-1].add(jnp.einsum("bji,bj->bi", matrix.lower, v[1:]))
    return layout.rows(out.reshape(layout.n_blocks, layout.width, 3))


def solve_lower(factor: BlockCholesky, rhs: Float[Array, "blocks m k"]) -> Float[Array, "blocks m k"]:
    """L z = rhs."""

    def step(previous, blocks):
        inverse, lower, right = blocks
        z = inverse @ (right - lower @ previous)
        return z, z

    lower = jnp.concatenate([jnp.zeros_like(factor.inverse[:1]), factor.lower])
    return jax.lax.scan(step, jnp.zeros_like(rhs[0]), (factor.inverse, lower, rhs))[1]


def lower_square(factor: BlockCholesky, rhs: Float[Array, "blocks m n"]) -> Float[Array, "n n"]:
    """(L^-1 rhs)^T (L^-1 rhs) of a right-hand side with n / blocks columns a block, in the layout's order.

    Columns may reach no further than one block from their own, as those of a matrix in this layout do: what lies above
    stays zero in L^-1 rhs, and is left out of the products.
    """
    nb, _, n = rhs.shape
    square = jnp.zeros((n, n), rhs.dtype)
    z = jnp.zeros_like(rhs[0, :, :0])
    for k in range(nb):
        known, reach = z.shape[1], min(k + 2, nb) * (n // nb)
        right = rhs[k, :, :reach]
        if k:
            right = right.at[:, :known].add(-factor.lower[k - 1] @ z)
        z = factor.inverse[k] @ right
        square = square.at[:reach, :reach].add(z.T @ z)
    return square


def inverse_band(factor: BlockCholesky) -> BlockTridiagonal:
    """The blocks of A^-1 that lie where A has blocks, from the last to the first [Takahashi et al. 1973]."""

    def step(following, blocks):
        inverse, lower = blocks
        coupling = lower @ inverse
        beside = -following @ coupling
        diagonal = inverse.T @ inverse - coupling.T @ beside
        return diagonal, (diagonal, beside)

    lower = jnp.concatenate([factor.lower, jnp.zeros_like(factor.inverse[:1])])
    _, (diagonal, beside) = jax.lax.scan(step, jnp.zeros_like(factor.inverse[0]), (factor.inverse, lower), reverse=True)
    return BlockTridiagonal(diagonal=diagonal, lower=beside[:-1])


def window_sums(
    layout: Layout, matrix: BlockTridiagonal, index: Int[Array, "m p p"], rows: Float[Array, "m p 3 3"]
) -> Float[Array, " m"]:
    """Trace of B A B^T for each element's B, given as one 3x3 window a vertex; `index` is its `Layout.pair_index`."""
    nb, w = layout.n_blocks, layout.width
    lower = jnp.concatenate([matrix.lower, jnp.zeros_like(matrix.diagonal[:1])])[:nb]
    blocks = jnp.stack([matrix.diagonal, lower]).reshape(2, nb, w, 3, w, 3).swapaxes(3, 4).reshape(-1, 3, 3)
    windows = jnp.concatenate([blocks, jnp.zeros((1, 3, 3), blocks.dtype)])[index]
    twice = jnp.where((index >= nb * w * w)[..., None, None], 2.0, 1.0)
    return jnp.einsum("mjab,mjkbc,mkac->m", rows, twice * windows, rows)


def solve_upper(factor: BlockCholesky, rhs: Float[Array, "blocks m k"]) -> Float[Array, "blocks m k"]:
    """L^T z = rhs."""

    def step(following, blocks):
        inverse, lower, right = blocks
        z = inverse.T @ (right - lower.T @ following)
        return z, z

    lower = jnp.concatenate([factor.lower, jnp.zeros_like(factor.inverse[:1])])
    return jax.lax.scan(step, jnp.zeros_like(rhs[0]), (factor.inverse, lower, rhs), reverse=True)[1]


def solve(layout: Layout, factor: BlockCholesky, rhs: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """A z = rhs for one right-hand side given per particle."""
    blocks = layout.blocks(rhs).reshape(layout.n_blocks, 3 * layout.width, 1)
    z = solve_upper(factor, solve_lower(factor, blocks))
    return layout.rows(z.reshape(layout.n_blocks, layout.width, 3))
