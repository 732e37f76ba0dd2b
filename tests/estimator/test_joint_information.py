"""Evidence about stiffnesses and parameters together agrees with dense linear algebra."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from jiggle_mj.estimator.joint_information import JointInformation
from tests.support.small_sheet import sheet_prior

Q = 3


def drawn(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a precision over s and `Q` parameters, and a score."""
    n = len(sheet_prior().shift) + Q
    generator = np.random.default_rng(seed)
    root = generator.normal(size=(n, 2 * n))
    return root @ root.T, generator.normal(size=n)


def split(precision: np.ndarray, score: np.ndarray) -> JointInformation:
    return JointInformation(
        precision=jnp.asarray(precision[:-Q, :-Q]),
        cross=jnp.asarray(precision[:-Q, -Q:]),
        parameter_precision=jnp.asarray(precision[-Q:, -Q:]),
        score=jnp.asarray(score[:-Q]),
        parameter_score=jnp.asarray(score[-Q:]),
    )


def test_the_step_is_that_of_stiffnesses_and_parameters_together():
    """Delta = (P + prior)^-1 (g + prior (mean - at)) over all, of which the parameters are the last rows."""
    (first, g1), (second, g2) = drawn(0), drawn(1)
    n, prior_sd, at = len(sheet_prior().shift), np.array([2.0, 1e-2, 0.3]), np.array([0.5, 0.0, -0.2])
    sites, s = np.linspace(1, 2, n), np.full(n, 0.4)
    belief = replace(sheet_prior(), site_precision=jnp.asarray(sites), site_shift=jnp.asarray(0.1 * sites))
    found = (split(first, g1) + split(second, g2)).marginal(belief, jnp.asarray(s))
    prior = np.append(sites, prior_sd**-2.0)
    mean, where = np.append(np.full(n, 0.1), np.zeros(Q)), np.append(s, at)
    whole = first + second + np.diag(prior)
    expected = np.linalg.solve(whole, g1 + g2 + prior * (mean - where))[-Q:]
    np.testing.assert_allclose(found.step(prior_sd, at), expected, rtol=1e-8)
    np.testing.assert_allclose(found.covariance(prior_sd), np.linalg.inv(whole)[-Q:, -Q:], rtol=1e-8)


def test_the_correlation_with_stiffnesses_is_1_where_they_explain_a_parameter_and_0_where_they_do_not_act():
    n = len(sheet_prior().shift)
    precision = np.eye(n + Q)
    precision[0, n] = precision[n, 0] = 1 - 1e-12
    precision[1, n + 1] = precision[n + 1, 1] = 0.6
    belief = replace(sheet_prior(), site_precision=jnp.zeros(n), site_shift=jnp.zeros(n))
    found = split(precision, np.zeros(n + Q)).marginal(belief, jnp.zeros(n))
    np.testing.assert_allclose(found.correlation_with_s(), [1, 0.6, 0], atol=1e-5)


def test_without_evidence_the_standard_errors_are_finite_and_large():
    n = len(sheet_prior().shift)
    found = split(np.zeros((n + Q, n + Q)), np.zeros(n + Q)).marginal(sheet_prior(), jnp.zeros(n))
    sd = np.sqrt(np.diagonal(found.covariance(np.array([np.inf, np.inf, 5e-4]))))
    assert (sd[:2] > 1e3).all() and np.isclose(sd[2], 5e-4)
    assert np.isfinite(found.correlation_with_s()).all()
