"""The largest modes of a smooth field, against the eigenvectors of the whole kernel."""

import numpy as np
import pytest
from scipy.linalg import eigh

from jiggle_mj.estimator.perception.smooth_modes import MAX_LANDMARKS, smooth_modes

COUNT = 45
COVARIANCE_ERROR = 0.02
"""Largest error of the modes' covariance, by the Frobenius norm, that is asked for."""
VARIANCE_ERROR = 1e-3
"""Largest share of the variance of the best modes that the ones found lack. Where the eigenvalues lie close together
other modes are as good, and their covariance may differ."""
ROUNDING = 1e-6
"""Largest amount by which a mode's covariance may exceed the field's [variances of the field]."""


def places(n: int) -> np.ndarray:
    """Return random points on a curved and tilted sheet of 0.1 x 0.07 m."""
    x, y = np.random.default_rng(0).uniform(0, 1, (2, n))
    return np.column_stack([0.1 * x, 0.07 * y + 0.03 * x, 0.02 * np.sin(3 * x)])


def kernel(points: np.ndarray, length: float) -> np.ndarray:
    return np.exp(-0.5 * np.sum((points[:, None] - points[None]) ** 2, axis=2) / length**2)


@pytest.mark.parametrize("length", [2e-3, 5e-3, 1e-2, 5e-2])
@pytest.mark.parametrize("n", [300, MAX_LANDMARKS + 500])
def test_modes_have_the_covariance_of_the_largest_eigenvectors(n, length):
    points = places(n)
    K, modes = kernel(points, length), smooth_modes(points, length, COUNT)
    values, vectors = eigh(K, subset_by_index=(n - COUNT, n - 1))
    best = (vectors * values) @ vectors.T
    assert np.sum(modes**2) == pytest.approx(np.maximum(values, 0).sum(), rel=VARIANCE_ERROR)
    if length > 2e-3:
        assert np.linalg.norm(modes @ modes.T - best) < COVARIANCE_ERROR * np.linalg.norm(best)
    assert eigh(K - modes @ modes.T, subset_by_index=(0, 0), eigvals_only=True)[0] > -ROUNDING


def test_the_same_points_give_the_same_bits_and_few_points_few_modes():
    points = places(MAX_LANDMARKS + 500)
    np.testing.assert_array_equal(smooth_modes(points, 5e-3, COUNT), smooth_modes(points, 5e-3, COUNT))
    assert smooth_modes(points[:7], 5e-3, COUNT).shape == (7, 7)
    assert smooth_modes(np.repeat(points[:1], 5, axis=0), 5e-3, COUNT).shape == (5, 1)
