"""Block-tridiagonal assembly, factorisation and solves against dense numpy."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp

from jiggle_mj.estimator.physics.block_tridiagonal import (
    Layout,
    add_to_diagonal,
    assemble,
    cholesky,
    inverse_band,
    lower_square,
    multiply,
    solve,
)
from jiggle_mj.estimator.physics.mesh import pattern
from tests.support.small_sheet import dense

ROUNDING = 1e-11
"""Relative; condition numbers are below 1e3 here: 1e3 roundings of 1e-16, and sums of 60 terms."""


def chain(n: int, reach: int, seed: int) -> np.ndarray:
    """Return random elements of three particles, no further apart than `reach` in a hidden order."""
    generator = np.random.default_rng(seed)
    order = generator.permutation(n)
    start = np.arange(n - reach)
    middle = start + generator.integers(1, reach, len(start)) if reach > 1 else start
    return order[np.column_stack([start, middle, start + reach])]


@pytest.fixture(scope="module", params=[(17, 2, 0), (17, 5, 1), (5, 3, 2)], ids=["padded", "three blocks", "one block"])
def system(request):
    """Return a positive definite matrix, its layout and its dense form assembled by hand."""
    n, reach, seed = request.param
    generator = np.random.default_rng(seed)
    elements = chain(n, reach, seed)
    pairs = np.concatenate([elements[:, [0, 1]], elements[:, [0, 2]], elements[:, [1, 2]]])
    layout = Layout.from_pattern(pattern(n, pairs))
    root = generator.normal(size=(len(elements), 9, 9))
    windows = (root @ root.swapaxes(1, 2)).reshape(-1, 3, 3, 3, 3)
    ridge = 1 + generator.uniform(size=n)[:, None, None] * np.eye(3)
    matrix = assemble(layout, [(jnp.asarray(layout.pair_index(elements)), jnp.asarray(windows))])
    matrix = add_to_diagonal(layout, matrix, jnp.asarray(ridge))
    by_hand = np.zeros((n, 3, n, 3))
    for element, window in zip(elements, windows, strict=True):
        for a in range(3):
            for b in range(3):
                by_hand[element[a], :, element[b], :] += window[a, :, b, :]
    for i in range(n):
        by_hand[i, :, i, :] += ridge[i]
    return layout, matrix, by_hand.reshape(3 * n, 3 * n)


def test_assembly_sums_element_windows_as_a_dense_loop_does(system):
    layout, matrix, by_hand = system
    np.testing.assert_allclose(dense(layout, matrix), by_hand, rtol=ROUNDING, atol=ROUNDING)


def test_rows_undo_blocks_and_padding_is_zero(system):
    layout, _, by_hand = system
    values = np.random.default_rng(3).normal(size=(len(by_hand) // 3, 2))
    blocks = layout.blocks(jnp.asarray(values))
    np.testing.assert_array_equal(layout.rows(blocks), values)
    assert float(jnp.sum(blocks**2)) == pytest.approx(np.sum(values**2), rel=ROUNDING)


def test_products_and_solutions_equal_numpys(system):
    layout, matrix, by_hand = system
    v = np.random.default_rng(4).normal(size=(len(by_hand) // 3, 3))
    factor = cholesky(matrix)
    np.testing.assert_allclose(
        multiply(layout, matrix, jnp.asarray(v)).ravel(), by_hand @ v.ravel(), rtol=ROUNDING, atol=ROUNDING * 100
    )
    z = solve(layout, factor, jnp.asarray(v))
    np.testing.assert_allclose(np.ravel(z), np.linalg.solve(by_hand, v.ravel()), rtol=ROUNDING, atol=ROUNDING)


def test_the_inverses_blocks_equal_numpys(system):
    layout, matrix, by_hand = system
    nb, m = layout.n_blocks, 3 * layout.width
    band = inverse_band(cholesky(matrix))
    inverse = np.zeros((nb * layout.width, 3, nb * layout.width, 3))
    n = len(by_hand) // 3
    inverse[np.ix_(layout.slot, range(3), layout.slot, range(3))] = np.linalg.inv(by_hand).reshape(n, 3, n, 3)
    padding = np.setdiff1d(np.arange(nb * layout.width), layout.slot)
    inverse[padding, :, padding, :] = np.eye(3)
    blocks = inverse.reshape(nb, m, nb, m)
    for k in range(nb):
        np.testing.assert_allclose(band.diagonal[k], blocks[k, :, k], rtol=ROUNDING, atol=ROUNDING)
    for k in range(nb - 1):
        np.testing.assert_allclose(band.lower[k], blocks[k + 1, :, k], rtol=ROUNDING, atol=ROUNDING)


def test_the_square_of_a_banded_right_hand_side_equals_the_dense_product(system):
    """B^T A^-1 B, with every third column of A as B; the omitted sums are zero."""
    layout, matrix, by_hand = system
    n, padded = len(by_hand) // 3, layout.n_blocks * layout.width
    columns = by_hand[:, ::3]
    blocks = np.zeros((padded, 3, padded))
    blocks[np.ix_(layout.slot, range(3), layout.slot)] = columns.reshape(n, 3, n)
    square = lower_square(cholesky(matrix), jnp.asarray(blocks.reshape(layout.n_blocks, 3 * layout.width, padded)))
    expected = columns.T @ np.linalg.solve(by_hand, columns)
    np.testing.assert_allclose(
        np.asarray(square)[np.ix_(layout.slot, layout.slot)], expected, rtol=ROUNDING, atol=ROUNDING * expected.max()
    )


def test_an_indefinite_matrix_gives_nan_and_no_number(system):
    layout, matrix, by_hand = system
    n = len(by_hand) // 3
    spoilt = add_to_diagonal(layout, matrix, jnp.asarray(np.tile(-1e3 * np.eye(3), (n, 1, 1))))
    assert bool(jnp.isnan(cholesky(spoilt).middle).any())


def test_an_absent_vertex_of_an_element_adds_nothing():
    """-1 means 'none': its windows are dropped, the others stay."""
    layout = Layout.from_pattern(pattern(4, np.array([[0, 1], [1, 2], [2, 3]])))
    windows = jnp.ones((1, 2, 3, 2, 3))
    matrix = assemble(layout, [(jnp.asarray(layout.pair_index(np.array([[1, -1]]))), windows)])
    expected = np.zeros((4, 3, 4, 3))
    expected[1, :, 1, :] = 1
    np.testing.assert_array_equal(dense(layout, matrix), expected.reshape(12, 12))


def test_a_pair_outside_the_band_is_refused():
    layout = Layout.from_pattern(pattern(12, np.column_stack([np.arange(11), np.arange(1, 12)])))
    with pytest.raises(ValueError, match="further apart than the layout's band"):
        layout.pair_index(np.array([[0, 11]]))


def test_positions_narrow_the_band_of_a_square_sheet():
    """Along a side of a 12 x 12 lattice the band is its diagonal, 13; Cuthill-McKee's levels at a corner are wider."""
    i, j = np.divmod(np.arange(144), 12)
    steps = [(i < 11, 12), (j < 11, 1), ((i < 11) & (j < 11), 13), ((i < 11) & (j > 0), 11)]
    pairs = np.concatenate([np.column_stack([np.flatnonzero(has), np.flatnonzero(has) + by]) for has, by in steps])
    narrow = Layout.from_pattern(pattern(144, pairs), np.column_stack([i, j, 0 * i]).astype(float))
    assert (narrow.n_blocks, narrow.width) == (11, 14)
    assert Layout.from_pattern(pattern(144, pairs)).width > narrow.width


def test_particles_that_touch_nobody_still_get_a_layout():
    layout = Layout.from_pattern(sp.identity(3, dtype=bool, format="csr"))
    assert sorted(np.asarray(layout.slot).tolist()) == [0, 1, 2]
    assert layout.n_blocks * layout.width >= 3
