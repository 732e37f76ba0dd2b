"""The Gaussian belief: its two forms, evidence and prediction, entropy, and the mean under b >= 0."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import nnls
from scipy.stats import multivariate_normal

from jiggle_mj.estimator.belief.gaussian_belief import GaussianBelief, non_negative_minimum

ROUNDING = 1e-9
"""Relative; matrices here have condition numbers below 1e5."""
N = 12

_minimum = jax.jit(non_negative_minimum)


def minimum(A: jax.Array, c: jax.Array) -> jax.Array:
    return _minimum(A, c, c > 0)


def positive_definite(seed: int, n: int = N, scale: float = 1.0) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(n, n + 3))
    return scale * root @ root.T


def belief(seed: int = 0) -> GaussianBelief:
    precision = positive_definite(seed)
    return GaussianBelief(precision=jnp.asarray(precision), shift=jnp.asarray(precision @ np.linspace(-1, 2, N)))


def test_a_prior_has_its_mean_and_standard_deviation():
    mean, covariance = GaussianBelief.prior(4, mean=0.5, sd=0.2).moments()
    np.testing.assert_allclose(mean, 0.5)
    np.testing.assert_allclose(covariance, 0.04 * np.eye(4), rtol=1e-12)


def test_adding_evidence_is_the_kalman_filter_in_covariance_form():
    """y = F b + noise R: K = P F^T (F P F^T + R)^-1, P' = (I - K F) P against Lambda + F^T R^-1 F."""
    draw = np.random.default_rng(1)
    F, R = draw.normal(size=(5, N)), positive_definite(2, 5)
    y = draw.normal(size=5)
    before = belief()
    mean, P = (np.asarray(part) for part in before.moments())
    gain = P @ F.T @ np.linalg.inv(F @ P @ F.T + R)
    evidence = F.T @ np.linalg.solve(R, np.column_stack([F, y]))
    after_mean, after_covariance = before.add(jnp.asarray(evidence[:, :N]), jnp.asarray(evidence[:, N])).moments()
    np.testing.assert_allclose(after_mean, mean + gain @ (y - F @ mean), rtol=ROUNDING, atol=ROUNDING)
    np.testing.assert_allclose(after_covariance, (np.eye(N) - gain @ F) @ P, rtol=ROUNDING, atol=ROUNDING)


def test_prediction_moves_the_mean_and_adds_to_the_covariance():
    """b + delta_b, Sigma + W."""
    before = belief()
    change, variance = np.linspace(-1, 1, N), np.linspace(0, 2, N)
    mean, covariance = before.moments()
    after_mean, after_covariance = before.predict(jnp.asarray(change), jnp.asarray(variance)).moments()
    np.testing.assert_allclose(after_mean, mean + change, rtol=ROUNDING, atol=ROUNDING)
    np.testing.assert_allclose(after_covariance, covariance + np.diag(variance), rtol=ROUNDING, atol=ROUNDING)


def test_entropy_is_that_of_the_normal_distribution():
    """n/2 (1 + ln 2 pi) + 1/2 ln det Sigma, against scipy."""
    one = belief(3)
    mean, covariance = one.moments()
    expected = multivariate_normal(np.asarray(mean), np.asarray(covariance)).entropy()
    assert float(one.entropy()) == pytest.approx(expected, rel=ROUNDING)


def test_entropy_falls_with_evidence_by_half_the_log_determinant():
    before = belief(3)
    after = before.add(jnp.asarray(positive_definite(4)), jnp.zeros(N))
    expected = 0.5 * np.linalg.slogdet(np.asarray(before.precision) + positive_definite(4))[1]
    expected -= 0.5 * np.linalg.slogdet(np.asarray(before.precision))[1]
    assert float(before.entropy() - after.entropy()) == pytest.approx(expected, rel=ROUNDING)


@pytest.mark.parametrize("seed", range(12))
def test_the_non_negative_minimum_is_nnlss(seed):
    """1/2 z^T A z - c^T z over z >= 0 is |L^T z - L^-1 c|^2 over z >= 0, with A = L L^T."""
    A = positive_definite(seed)
    c = np.random.default_rng(seed + 100).normal(size=N) * (1 if seed % 2 else 20)
    factor = np.linalg.cholesky(A)
    expected = nnls(factor.T, np.linalg.solve(factor, c))[0]
    np.testing.assert_allclose(minimum(jnp.asarray(A), jnp.asarray(c)), expected, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_the_non_negative_minimum_is_optimal_where_exchanging_all_would_cycle(seed):
    """Conditions of optimality: z >= 0, A z - c >= 0, z (A z - c) = 0; strongly coupled, scales six decades apart."""
    n = 60
    draw = np.random.default_rng(seed)
    scale = 10.0 ** draw.uniform(-3, 3, n)
    near = np.exp(-np.abs(np.subtract.outer(np.arange(n), np.arange(n))) / 10) + 1e-3 * np.eye(n)
    A, c = near * np.outer(scale, scale), draw.normal(size=n) * scale
    z = np.asarray(minimum(jnp.asarray(A), jnp.asarray(c)))
    dual = (A @ z - c) / scale
    assert (z >= 0).all() and 0 < (z > 0).sum() < n
    assert dual.min() > -1e-8
    assert np.abs(dual[z > 0]).max() < 1e-8


def test_a_mean_that_is_positive_already_is_kept_and_one_without_evidence_is_zero():
    A = positive_definite(5)
    inside = np.linspace(0.1, 3, N)
    np.testing.assert_allclose(minimum(jnp.asarray(A), jnp.asarray(A @ inside)), inside, rtol=ROUNDING)
    np.testing.assert_array_equal(minimum(jnp.asarray(A), jnp.zeros(N)), 0)


def test_the_beliefs_non_negative_mean_is_not_the_clipped_one():
    """Correlations move the others when one meets zero."""
    one = belief(6)
    mean = np.asarray(one.moments()[0])
    found = np.asarray(one.non_negative_mean())
    assert mean.min() < 0
    assert not np.allclose(found, np.maximum(mean, 0), atol=1e-3)
    cost = lambda z: 0.5 * z @ np.asarray(one.precision) @ z - np.asarray(one.shift) @ z  # noqa: E731
    assert cost(found) < cost(np.maximum(mean, 0))
