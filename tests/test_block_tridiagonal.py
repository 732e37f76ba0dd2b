"""Block-tridiagonal assembly, factorisation and solves against dense numpy."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp
from jiggle_mj.estimator.block_tridiagonal import (
    Layout,
    add_to_diagonal,
    assemble,
    cholesky,
    half_log_determinant,
    multiply,
    solve,
    solve_lower,
    solve_upper,
)
from jiggle_mj.estimator.mesh import pattern
from small_sheet import dense

ROUNDING = 1e-11
"""Relative; condition numbers stay below 1e3 here, so 1e3 roundings of 1e-16, with room for sums of 60 terms."""


def chain(n: int, reach: int, seed: int) -> np.ndarray:
    """Random elements of three particles, no further apart than `reach` in a hidden order."""
    generator = np.random.default_rng(seed)
    order = generator.permutation(n)
    start = np.arange(n - reach)
    middle = start + generator.integers(1, reach, len(start)) if reach > 1 else start
    return order[np.column_stack([start, middle, start + reach])]


@pytest.fixture(scope="module", params=[(17, 2, 0), (5, 3, 2)], ids=["padded", "one block"])
def system(request):
    """A positive definite matrix, its layout and its dense form assembled by hand."""
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


def test_products_solutions_and_determinant_equal_numpys(system):
    layout, matrix, by_hand = system
    v = np.random.default_rng(4).normal(size=(len(by_hand) // 3, 3))
    factor = cholesky(matrix)
    np.testing.assert_allclose(
        multiply(layout, matrix, jnp.asarray(v)).ravel(), by_hand @ v.ravel(), rtol=ROUNDING, atol=ROUNDING * 100
    )
    z = solve(layout, factor, jnp.asarray(v))
    np.testing.assert_allclose(np.ravel(z), np.linalg.solve(by_hand, v.ravel()), rtol=ROUNDING, atol=ROUNDING)
    # The padding's identity adds nothing to the determinant.
    assert float(half_log_determinant(factor)) == pytest.approx(0.5 * np.linalg.slogdet(by_hand)[1], rel=ROUNDING)


def test_the_two_half_solves_make_the_inverse_for_many_right_hand_sides(system):
    """|L^-1 B|^2 = B^T A^-1 B and L^-T L^-1 B = A^-1 B."""
    layout, matrix, by_hand = system
    n = len(by_hand) // 3
    right = np.random.default_rng(5).normal(size=(n, 3, 4))
    blocks = layout.blocks(jnp.asarray(right)).reshape(layout.n_blocks, 3 * layout.width, 4)
    factor = cholesky(matrix)
    half = solve_lower(factor, blocks)
    expected = np.linalg.solve(by_hand, right.reshape(3 * n, 4))
    gram = np.einsum("bki,bkj->ij", half, half)
    np.testing.assert_allclose(gram, right.reshape(3 * n, 4).T @ expected, rtol=ROUNDING, atol=ROUNDING)
    whole = layout.rows(solve_upper(factor, half).reshape(layout.n_blocks, layout.width, 3, 4))
    np.testing.assert_allclose(np.reshape(whole, (3 * n, 4)), expected, rtol=ROUNDING, atol=ROUNDING)


def test_an_indefinite_matrix_gives_nan_and_no_number(system):
    layout, matrix, by_hand = system
    n = len(by_hand) // 3
    spoilt = add_to_diagonal(layout, matrix, jnp.asarray(np.tile(-1e3 * np.eye(3), (n, 1, 1))))
    assert bool(jnp.isnan(half_log_determinant(cholesky(spoilt))))


def test_an_absent_vertex_of_an_element_adds_nothing():
    """-1 stands for 'none': its windows fall off, the others stay."""
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


def test_particles_that_touch_nobody_still_get_a_layout():
    layout = Layout.from_pattern(sp.identity(3, dtype=bool, format="csr"))
    assert sorted(np.asarray(layout.slot).tolist()) == [0, 1, 2]
    assert layout.n_blocks * layout.width >= 3
