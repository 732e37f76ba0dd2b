"""A function of every row."""

import jax
import jax.numpy as jnp
import numpy as np

from jiggle_mj.estimator.map_rows import map_rows
from tests.support.compiled_programs import batched_lapack_calls


def log_det(matrix: jax.Array) -> jax.Array:
    return 2 * jnp.sum(jnp.log(jnp.diagonal(jnp.linalg.cholesky(matrix))))


def matrices() -> jax.Array:
    root = np.random.default_rng(0).standard_normal((5, 4, 4))
    return jnp.asarray(root @ root.swapaxes(1, 2) + 4 * np.eye(4))


def test_rows_and_their_gradients_are_those_of_vmap():
    rows = matrices()
    one_by_one, together = (
        jax.value_and_grad(lambda A, map_=map_: jnp.sum(map_(A)))
        for map_ in (lambda A: map_rows(log_det, A), jax.vmap(log_det))
    )
    np.testing.assert_allclose(one_by_one(rows)[0], together(rows)[0], rtol=1e-12)
    np.testing.assert_allclose(one_by_one(rows)[1], together(rows)[1], rtol=1e-9)


def test_on_a_cpu_lapack_gets_one_matrix_at_a_time():
    """It would wait for itself, on two cores, where two batches are factorised at once."""
    rows = matrices()
    assert batched_lapack_calls(jax.vmap(log_det), rows)
    assert not batched_lapack_calls(jax.grad(lambda A: jnp.sum(map_rows(log_det, A))), rows)
