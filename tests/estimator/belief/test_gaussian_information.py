"""Operations of a Gaussian in information form against dense means and covariances."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from jiggle_mj.estimator.belief.gaussian_information import GaussianInformation

SIZES = {"s": 4, "theta": 3, "field": 2}
N = sum(SIZES.values())
WHERE = {"s": slice(0, 4), "theta": slice(4, 7), "field": slice(7, 9)}
ROUNDING = 1e-9
"""Relative; the matrices have condition numbers below 1e4."""


def of(name: str):
    """Return a method as a function, compiled where its arrays are on the device."""
    method = getattr(GaussianInformation, name)
    compiled = eqx.filter_jit(method)
    return lambda given, *args, **kwargs: (method if isinstance(given.precision, np.ndarray) else compiled)(
        given, *args, **kwargs
    )


marginal, condition, mean_of, covariance_of = of("marginal"), of("condition"), of("mean"), of("covariance")
log_evidence, log_det, variances_of = of("log_evidence"), of("log_det"), of("variances")


def positive_definite(seed: int, n: int = N) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(n, 2 * n))
    return root @ root.T


def dense(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a random mean and covariance."""
    return np.random.default_rng(seed + 100).normal(size=N), np.linalg.inv(positive_definite(seed))


@pytest.fixture(params=["host", "device"])
def array(request: pytest.FixtureRequest):
    """Return what makes an array of each kind that the class takes."""
    return {"host": np.asarray, "device": jnp.asarray}[request.param]


def information(seed: int, array=jnp.asarray) -> GaussianInformation:
    precision, mean = positive_definite(seed), dense(seed)[0]
    return GaussianInformation(array(precision), array(precision @ mean), tuple(SIZES.items()))


def close(actual, expected) -> None:
    expected = np.asarray(expected)
    np.testing.assert_allclose(actual, expected, rtol=ROUNDING, atol=ROUNDING * np.abs(expected).max())


@pytest.mark.parametrize("names", [("s",), ("theta",), ("s", "field"), ("s", "theta", "field")])
def test_a_marginal_is_the_block_of_mean_and_covariance(array, names):
    """N(mu_a, Sigma_aa), so that the Schur complement of Lambda is the inverse of Sigma_aa."""
    mean, covariance = dense(0)
    index = np.concatenate([np.arange(N)[WHERE[name]] for name in names])
    found = marginal(information(0, array), *names)
    assert found.blocks == tuple((name, SIZES[name]) for name in names)
    close(found.precision, np.linalg.inv(covariance[np.ix_(index, index)]))
    close(mean_of(found), mean[index])
    close(covariance_of(information(0, array), *names), covariance[np.ix_(index, index)])


def test_a_marginal_of_a_marginal_is_the_marginal(array):
    step = marginal(marginal(information(1, array), "s", "theta"), "theta")
    whole = marginal(information(1, array), "theta")
    close(step.precision, whole.precision)
    close(step.shift, whole.shift)


def test_a_condition_is_the_textbook_one(array):
    """mu_a + Sigma_ab Sigma_bb^-1 (b - mu_b) and Sigma_aa - Sigma_ab Sigma_bb^-1 Sigma_ba, with b = theta."""
    (mean, covariance), value = dense(2), np.array([0.3, -1.0, 2.0])
    b = np.arange(N)[WHERE["theta"]]
    a = np.setdiff1d(np.arange(N), b)
    gain = covariance[np.ix_(a, b)] @ np.linalg.inv(covariance[np.ix_(b, b)])
    found = condition(information(2, array), theta=array(value))
    assert found.blocks == (("s", 4), ("field", 2))
    close(mean_of(found), mean[a] + gain @ (value - mean[b]))
    close(covariance_of(found), covariance[np.ix_(a, a)] - gain @ covariance[np.ix_(b, a)])


def test_a_sum_is_the_product_of_two_gaussians(array):
    """(Sigma_1^-1 + Sigma_2^-1)^-1 and its mean, and with independent variances on one block."""
    (m1, S1), (m2, S2) = dense(3), dense(4)
    expected = np.linalg.inv(np.linalg.inv(S1) + np.linalg.inv(S2))
    found = information(3, array).add(information(4, array))
    close(covariance_of(found), expected)
    close(mean_of(found), expected @ (np.linalg.solve(S1, m1) + np.linalg.solve(S2, m2)))
    variance, center = np.array([0.1, 0.2, 0.4]), np.array([1.0, 2.0, -1.0])
    added = np.zeros(N)
    added[WHERE["theta"]] = 1 / variance
    expected = np.linalg.inv(np.linalg.inv(S1) + np.diag(added))
    found = information(3, array).with_independent("theta", array(1 / variance), array(center / variance))
    close(covariance_of(found), expected)
    added[WHERE["theta"]] = center / variance
    close(mean_of(found), expected @ (np.linalg.solve(S1, m1) + added))


def test_the_order_of_blocks_changes_nothing():
    """Marginals and log determinant of permuted blocks; with the others at 0 where some are not given."""
    plain = information(5, np.asarray)
    index = {name: np.arange(N)[where] for name, where in WHERE.items()}
    permuted = plain.restricted(field=index["field"], s=index["s"], theta=index["theta"])
    assert permuted.blocks == (("field", 2), ("s", 4), ("theta", 3))
    close(permuted.marginal("theta").precision, plain.marginal("theta").precision)
    close(permuted.marginal("theta").shift, plain.marginal("theta").shift)
    close(permuted.log_det(), plain.log_det())
    some = plain.restricted(theta=index["theta"], s=index["s"])
    close(some.mean()[:3], plain.condition(field=np.zeros(2)).mean()[4:])


def test_the_log_determinant_splits_into_marginal_and_condition(array):
    """|Lambda| = |Lambda_bb| |Lambda_aa - Lambda_ab Lambda_bb^-1 Lambda_ba|, against numpy."""
    whole = information(6, array)
    parts = log_det(marginal(whole, "s")) + log_det(condition(whole, s=array(np.zeros(4))))
    close(log_det(whole), np.linalg.slogdet(positive_definite(6))[1])
    close(parts, log_det(whole))


def test_the_evidence_is_that_of_two_normal_densities(array):
    """ln E[exp(-1/2 x^T L x + e^T x)] is ln N(m; mu, Sigma + L^-1) less the terms of L and m = L^-1 e alone."""
    (mean, covariance), (observed, noise) = dense(7), dense(8)
    precision = np.linalg.inv(noise)
    expected = multivariate_normal(mean, covariance + noise).logpdf(observed)
    expected += 0.5 * N * np.log(2 * np.pi) - 0.5 * np.linalg.slogdet(precision)[1]
    expected += 0.5 * observed @ precision @ observed
    close(log_evidence(information(7, array), information(8, array)), expected)


def test_moments_variances_and_entropy_agree_with_the_covariance(array):
    mean, covariance = dense(9)
    plain = information(9, array)
    close(mean_of(plain), mean)
    close(variances_of(plain), np.diagonal(covariance))
    expected = multivariate_normal(mean, covariance).entropy()
    close(plain.entropy(), expected)
    factored = plain.gaussian()
    close(factored.mean, mean)
    close(factored.sd, np.sqrt(np.diagonal(covariance)))
    close(factored.covariance(), covariance)
    close(factored.entropy(), expected)
    close(factored.solve(jnp.ones(N)), covariance @ np.ones(N))


def test_both_forms_of_moments_are_inverse():
    mean, covariance = dense(10)
    found = GaussianInformation.from_moments(jnp.asarray(mean), jnp.asarray(covariance)).moments()
    close(found[0], mean)
    close(found[1], covariance)


def test_normal_equations_are_those_of_least_squares():
    """exp(-|J x + e|^2 / 2): mean -J^+ e and precision J^T J."""
    draw = np.random.default_rng(11)
    J, e = draw.normal(size=(20, N)), draw.normal(size=20)
    columns = np.column_stack([J, e])
    found = GaussianInformation.from_normal_equations(columns.T @ columns, **SIZES)
    close(found.mean(), -np.linalg.lstsq(J, e)[0])
    close(found.precision, J.T @ J)


def test_masked_variables_are_integrated_out_in_place():
    """As `marginal` does, with the size kept and zeros in the rows that are integrated out."""
    mask, plain = np.arange(N) % 3 == 0, information(12)
    found = eqx.filter_jit(plain.without)(jnp.asarray(mask))
    covariance = dense(12)[1][np.ix_(~mask, ~mask)]
    close(found.precision[np.ix_(~mask, ~mask)], np.linalg.inv(covariance))
    close(found.shift[~mask], np.linalg.solve(covariance, dense(12)[0][~mask]))
    assert not np.asarray(found.precision)[mask].any() and not np.asarray(found.shift)[mask].any()


def test_samples_are_a_linear_map_of_noise_with_the_covariance():
    """mu + L^-T z: the map's square is Sigma."""
    mean, covariance = dense(13)
    columns = np.stack([eqx.filter_jit(information(13).sample)(unit) for unit in jnp.eye(N)], axis=1) - mean[:, None]
    close(columns @ columns.T, covariance)


def test_unknown_blocks_and_wrong_sizes_are_refused():
    with pytest.raises(ValueError, match="no block 'b'"):
        information(0).marginal("b")
    with pytest.raises(ValueError, match="must sum to 9"):
        information(0).named(s=3)
