"""Symmetric block-tridiagonal matrices over particles: layout, assembly from elements, Cholesky factorisation, solves.

Particles in a good order interact only within a band; cutting the order into blocks as wide as the band leaves a
block-tridiagonal matrix, whose Cholesky factor costs O(n band^2) instead of O(n^3). `Layout` holds the order,
`BlockTridiagonal` the numbers. Every particle has three degrees of freedom. This is not a general sparse solver:
every pair of coupled particles must lie within the band.

Blocks are eliminated from both ends towards the middle [the twisted factorisation: van der Vorst 1987, Parallel
Computing 5:45]. The work is the same, but a GPU, which waits for each block, eliminates both halves at once, and a
banded right-hand side stays sparse for longer.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float, Int
from scipy.sparse.csgraph import reverse_cuthill_mckee

from ..map_rows import map_rows

ORDER_DIRECTIONS = 36
"""Directions in the sheet's plane along which an order of the particles is tried: one every 5 degrees."""
MAX_SUBSTITUTION_SIZE = 64
"""Largest triangular matrix that a CPU inverts by substitution; larger ones it inverts by halves [rows]."""


class Layout(eqx.Module):
    """Place of each particle in the blocks; the last block is padded."""

    slot: Int[np.ndarray, " n"] | Int[Array, " n"]
    """Place of each particle in the padded order."""
    n_blocks: int = eqx.field(static=True)
    """Number of blocks; odd, so that one is in the middle."""
    width: int = eqx.field(static=True)
    """Number of particles in a block."""

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
            angles = np.linspace(0, np.pi, ORDER_DIRECTIONS, endpoint=False)
            orders += [np.argsort(plane @ (np.cos(angle), np.sin(angle)), kind="stable") for angle in angles]
        ranks = [np.argsort(order) for order in orders]
        bands = [max(1, int(np.abs(rank[rows] - rank[columns]).max(initial=1))) for rank in ranks]
        best, n = int(np.argmin(bands)), len(orders[0])
        n_blocks = (n // bands[best] - 1) // 2 * 2 + 1 if n > bands[best] else 1
        return cls(slot=ranks[best], n_blocks=n_blocks, width=-(-n // n_blocks))

    def blocks(self, values: Float[Array, "n ..."]) -> Float[Array, "blocks width ..."]:
        """Arrange one row per particle in blocks; padding is zero."""
        rest = values.shape[1:]
        padded = jnp.zeros((self.n_blocks * self.width, *rest), values.dtype).at[self.slot].set(values)
        return padded.reshape(self.n_blocks, self.width, *rest)

    def rows(self, blocks: Float[Array, "blocks width ..."]) -> Float[Array, "n ..."]:
        """Return one row per particle from blocks: the inverse of `blocks`."""
        return blocks.reshape(self.n_blocks * self.width, *blocks.shape[2:])[self.slot]

    def pair_index(self, vertices: Int[np.ndarray, "m p"]) -> Int[np.ndarray, "m p p"]:
        """Return where the 3x3 window of each ordered vertex pair of an element is stored.

        Pairs above the diagonal get an index past the end, and are dropped. A vertex of -1 means 'none'.

        Raises:
            ValueError: a pair lies outside the band of the layout.
        """
        rank = np.append(np.asarray(self.slot), -1)[vertices]
        row, column = rank[:, :, None], rank[:, None, :]
        jump = row // self.width - column // self.width
        absent = (row < 0) | (column < 0)
        if np.any((np.abs(jump) > 1) & ~absent):
            raise ValueError(
                "an element couples particles that are further apart than the layout's band; build the Layout from a "
                "pattern that holds every pair of every element."
            )
        window = (jump * self.n_blocks + column // self.width) * self.width**2
        window = window + (row % self.width) * self.width + column % self.width
        return np.where(absent | (jump < 0), 2 * self.n_blocks * self.width**2, window)


class BlockTridiagonal(eqx.Module):
    """A symmetric block-tridiagonal matrix."""

    diagonal: Float[Array, "blocks m m"]
    """Blocks (k, k)."""
    lower: Float[Array, "blocks-1 m m"]
    """Blocks (k + 1, k)."""


class BlockCholesky(eqx.Module):
    """The factor L of A = L L^T, its rows and columns ordered from both ends to the middle.

    The diagonal blocks are stored as inverses: products with them run several times faster than triangular solves.
    """

    inverse: Float[Array, "2 half m m"]
    """Inverse of each diagonal block of the factor, from either end."""
    inward: Float[Array, "2 half m m"]
    """Block that couples each to the next one towards the middle."""
    middle: Float[Array, "m m"]
    """Inverse of the middle's diagonal block of the factor."""


def assemble(
    layout: Layout, elements: list[tuple[Int[Array, "_m _p _p"], Float[Array, "_m _p 3 _p 3"]]]
) -> BlockTridiagonal:
    """Return the sum of element matrices, each given with its `Layout.pair_index`; padding gets an identity."""
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
    """Return the matrix with a 3x3 window added for each particle, and a multiple of the identity for the padding."""
    nb, w = layout.n_blocks, layout.width
    filled = jnp.broadcast_to(padding * jnp.eye(3, dtype=windows.dtype), (nb * w, 3, 3)).at[layout.slot].set(windows)
    place = jnp.arange(w)
    diagonal = matrix.diagonal.reshape(nb, w, 3, w, 3)
    diagonal = diagonal.at[:, place, :, place, :].add(filled.reshape(nb, w, 3, 3).swapaxes(0, 1))
    return BlockTridiagonal(diagonal=diagonal.reshape(nb, 3 * w, 3 * w), lower=matrix.lower)


def cholesky(matrix: BlockTridiagonal) -> BlockCholesky:
    """Return the factor of A = L L^T, computed block by block; NaN where A is not positive definite."""

    def inverse_factor(block):
        return lower_inverse(jnp.linalg.cholesky(block, symmetrize_input=False))

    def step(taken, blocks):
        diagonal, next_to_this = blocks
        inverse = inverse_factor(diagonal - taken)
        inward = next_to_this @ inverse.T
        return inward @ inward.T, (inverse, inward)

    ends, middle = _split(matrix.diagonal)
    half = ends.shape[1]
    couplings = jnp.stack([matrix.lower[:half], matrix.lower[half:][::-1].swapaxes(1, 2)])
    taken, (inverse, inward) = map_rows(partial(jax.lax.scan, step, jnp.zeros_like(middle)), (ends, couplings))
    return BlockCholesky(inverse=inverse, inward=inward, middle=inverse_factor(middle - taken[0] - taken[1]))


def normal_cholesky(
    layout: Layout,
    index: Int[Array, "m p p"],
    rows: Float[Array, "m p 3 3"],
    weight: Float[Array, " m"],
    diagonal: Float[Array, "n 3 3"],
) -> BlockCholesky:
    """Return the factor of H^T W H and a diagonal.

    Args:
        layout: the layout of the matrix.
        index: `Layout.pair_index` of each row of H.
        rows: the rows, one 3x3 window per vertex.
        weight: W of each row.
        diagonal: a 3x3 window that is added for each particle.
    """
    squares = jnp.einsum("n,npij,nqik->npjqk", weight, rows, rows)
    return cholesky(add_to_diagonal(layout, assemble(layout, [(index, squares)]), diagonal))


def log_det(factor: BlockCholesky) -> Float[Array, ""]:
    """Return ln |A| of the factorised matrix; NaN where it is not positive definite."""
    diagonals = [jnp.diagonal(part, axis1=-2, axis2=-1) for part in (factor.inverse, factor.middle)]
    return -2 * (jnp.sum(jnp.log(diagonals[0])) + jnp.sum(jnp.log(diagonals[1])))


def lower_inverse(factor: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """Return the inverse of a lower triangular matrix: by halves on a CPU, whose products are faster than its solves.

    On a GPU one solve takes less time than the launches of the products.
    """
    return jax.lax.platform_dependent(factor, cpu=_inverse_by_halves, default=_inverse_by_substitution)


def _inverse_by_halves(factor: Float[Array, "m m"]) -> Float[Array, "m m"]:
    m = len(factor)
    if m <= MAX_SUBSTITUTION_SIZE:
        return _inverse_by_substitution(factor)
    first, last = _inverse_by_halves(factor[: m // 2, : m // 2]), _inverse_by_halves(factor[m // 2 :, m // 2 :])
    corner = -last @ (factor[m // 2 :, : m // 2] @ first)
    return jnp.block([[first, jnp.zeros_like(corner.T)], [corner, last]])


def _inverse_by_substitution(factor: Float[Array, "m m"]) -> Float[Array, "m m"]:
    return solve_triangular(factor, jnp.eye(len(factor), dtype=factor.dtype), lower=True)


def multiply(layout: Layout, matrix: BlockTridiagonal, x: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Return A x for one vector given per particle."""
    v = layout.blocks(x).reshape(layout.n_blocks, -1)
    out = jnp.einsum("bij,bj->bi", matrix.diagonal, v)
    out = out.at[1:].add(jnp.einsum("bij,bj->bi", matrix.lower, v[:-1]))
    out = out.at[:-1].add(jnp.einsum("bji,bj->bi", matrix.lower, v[1:]))
    return layout.rows(out.reshape(layout.n_blocks, layout.width, 3))


def lower_square(factor: BlockCholesky, rhs: Float[Array, "blocks m n"]) -> Float[Array, "n n"]:
    """Return B^T A^-1 B of a right-hand side B with n / blocks columns a block, in the layout's order.

    Columns may reach no further than one block from their own, as those of a matrix in this layout do. In L^-1 B the
    columns of the other end are then zero up to the middle, and the products omit them.
    """
    nb, m, n = rhs.shape
    half, w = nb // 2, n // nb
    reached = (half + 1) * w

    def outer(blocks):
        inverse, inward, right = blocks
        square, taken = jnp.zeros((reached, reached), rhs.dtype), jnp.zeros((m, 0), rhs.dtype)
        for k in range(half):
            known, reach = (k + 1) * w if k else 0, (k + 2) * w
            z = inverse[k] @ right[k, :, :reach].at[:, :known].add(-taken)
            taken = inward[k] @ z
            square = square.at[:reach, :reach].add(z.T @ z)
        return square, jnp.zeros((m, reached), rhs.dtype).at[:, : taken.shape[1]].add(taken)

    mirrored = rhs.reshape(nb, m, nb, w)[::-1, :, ::-1].reshape(nb, m, n)
    ends = jnp.stack([rhs[:half, :, :reached], mirrored[:half, :, :reached]])
    squares, taken = map_rows(outer, (factor.inverse, factor.inward, ends))
    right = rhs[half].at[:, :reached].add(-taken[0])
    right = right.at[:, n - reached :].add(-taken[1].reshape(m, half + 1, w)[:, ::-1].reshape(m, reached))
    z = factor.middle @ right
    last = squares[1].reshape(half + 1, w, half + 1, w)[::-1, :, ::-1].reshape(reached, reached)
    square = (z.T @ z).at[:reached, :reached].add(squares[0])
    return square.at[n - reached :, n - reached :].add(last)


def inverse_band(factor: BlockCholesky) -> BlockTridiagonal:
    """Return the blocks of A^-1 at the places where A has blocks, from the middle outwards [Takahashi et al. 1973].

    Single precision would take half the time, but a sheet that is seen in part has variances from 1e-10 to 1 m^2, and
    what its stiffness leaves of the largest is lost.
    """
    middle = factor.middle.T @ factor.middle

    def step(following, blocks):
        inverse, inward = blocks
        coupling = inward @ inverse
        off_diagonal = -following @ coupling
        diagonal = inverse.T @ inverse - coupling.T @ off_diagonal
        return diagonal, (diagonal, off_diagonal)

    outwards = partial(jax.lax.scan, step, middle, reverse=True)
    _, (ends, off_diagonal) = map_rows(outwards, (factor.inverse, factor.inward))
    lower = jnp.concatenate([off_diagonal[0], off_diagonal[1, ::-1].swapaxes(1, 2)])
    return BlockTridiagonal(diagonal=_joined(ends, middle), lower=lower)


def window_sums(
    layout: Layout, matrix: BlockTridiagonal, index: Int[Array, "m p p"], rows: Float[Array, "m p 3 3"]
) -> Float[Array, " m"]:
    """Return the trace of B A B^T for each element.

    Args:
        layout: the layout of A.
        matrix: A.
        index: `Layout.pair_index` of the elements.
        rows: each element's B, one 3x3 window per vertex.
    """
    nb, w = layout.n_blocks, layout.width
    lower = jnp.concatenate([matrix.lower, jnp.zeros_like(matrix.diagonal[:1])])[:nb]
    blocks = jnp.stack([matrix.diagonal, lower]).reshape(2, nb, w, 3, w, 3).swapaxes(3, 4).reshape(-1, 3, 3)
    windows = jnp.concatenate([blocks, jnp.zeros((1, 3, 3), blocks.dtype)])[index]
    multiplicity = jnp.where((index >= nb * w * w)[..., None, None], 2.0, 1.0)
    return jnp.einsum("mjab,mjkbc,mkac->m", rows, multiplicity * windows, rows)


def solve(layout: Layout, factor: BlockCholesky, rhs: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Return the solution z of A z = rhs for one right-hand side given per particle."""

    def forward(taken, blocks):
        inverse, inward, right = blocks
        z = inverse @ (right - taken)
        return inward @ z, z

    def backward(following, blocks):
        inverse, inward, z = blocks
        x = inverse.T @ (z - inward.T @ following)
        return x, x

    ends, middle = _split(layout.blocks(rhs).reshape(layout.n_blocks, -1))
    start = partial(jax.lax.scan, forward, jnp.zeros_like(middle))
    taken, z = map_rows(start, (factor.inverse, factor.inward, ends))
    middle = factor.middle.T @ (factor.middle @ (middle - taken[0] - taken[1]))
    _, x = map_rows(partial(jax.lax.scan, backward, middle, reverse=True), (factor.inverse, factor.inward, z))
    return layout.rows(_joined(x, middle).reshape(layout.n_blocks, layout.width, 3))


def _split(blocks: Float[Array, "blocks ..."]) -> tuple[Float[Array, "2 half ..."], Float[Array, "..."]]:
    """Return the blocks from either end towards the middle, and the middle one."""
    half = len(blocks) // 2
    return jnp.stack([blocks[:half], blocks[half + 1 :][::-1]]), blocks[half]


def _joined(ends: Float[Array, "2 half ..."], middle: Float[Array, "..."]) -> Float[Array, "blocks ..."]:
    """Return the blocks in order: the inverse of `_split`."""
    return jnp.concatenate([ends[0], middle[None], ends[1, ::-1]])
