"""Tests of the tracker's walk."""

import numpy as np
import pytest

from jiggle_mj.estimator.attribution.tracker_walk import known_walk, without_walk

T, M, K = 5, 3, 4


def case(*, scale: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return inner products of a walk's columns in some frames, those with others, and variances of its steps."""
    rng = np.random.default_rng(0)
    roots = rng.normal(size=(T, 6, M))
    own = np.einsum("tia,tib->tab", roots, roots)
    return own, rng.normal(size=(T, M, K)), scale * rng.uniform(0.5, 2.0, T)


def dense(own: np.ndarray, variances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the information of all frames together, and the prior covariance of the walk."""
    information = np.zeros((T * M, T * M))
    for t, block in enumerate(own):
        information[t * M : (t + 1) * M, t * M : (t + 1) * M] = block
    walked = np.cumsum(variances)[np.minimum(np.arange(T)[:, None], np.arange(T)[None])]
    return information, np.kron(walked, np.eye(M))


@pytest.mark.parametrize("scale", [1e-9, 1e-2, 1.0, 1e4])
def test_the_walk_is_eliminated_as_by_its_dense_covariance(scale: float) -> None:
    own, beside, variances = case(scale=scale)
    information, prior = dense(own, variances)
    found = without_walk(own, beside, variances)
    b = beside.reshape(T * M, K)
    covariance = np.linalg.inv(np.linalg.inv(prior) + information)
    np.testing.assert_allclose(found.square, -b.T @ covariance @ b, rtol=1e-6, atol=1e-6 * abs(found.square).max())
    whole = np.linalg.slogdet(np.eye(T * M) + information @ prior)[1]
    assert found.log_det == pytest.approx(whole, rel=1e-6)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e4])
def test_what_is_known_of_the_walk_is_that_of_its_dense_covariance(scale: float) -> None:
    own, beside, variances = case(scale=scale)
    information, prior = dense(own, variances)
    known = known_walk(own, beside, variances)
    covariance = np.linalg.inv(np.linalg.inv(prior) + information)
    mean = (covariance @ beside.reshape(T * M, K)).reshape(T, M, K)
    np.testing.assert_allclose(known.mean, mean, rtol=1e-6, atol=1e-6 * abs(mean).max())
    for t, block in enumerate(known.covariance):
        exact = covariance[t * M : (t + 1) * M, t * M : (t + 1) * M]
        np.testing.assert_allclose(block, exact, rtol=1e-6, atol=1e-6 * abs(exact).max())


def test_what_is_no_number_stays_none() -> None:
    own, beside, variances = case(scale=1.0)
    own[2, 0, 0] = np.nan
    assert np.isnan(without_walk(own, beside, variances).log_det)
