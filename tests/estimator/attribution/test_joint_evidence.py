"""Evidence of several recordings with shared parameters, against fitting all of their data at once in closed form."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import multivariate_normal, norm

from jiggle_mj.estimator.attribution.joint_evidence import OwnInformation, SharedPrior, joint_evidence

SD, OWN_SD, NOISE = np.array([0.7, 0.02]), 0.3, 0.1
"""Prior standard deviations of the shared and of each recording's own parameters, and the noise."""
FREE = SharedPrior(sd=SD, lower=np.full(2, -np.inf))
EXACT = 1e-9
"""Relative rounding of evidences of some hundred nat."""


class LinearRecording:
    """Data y = A theta + B eta + noise, with the parameters eta of this recording alone.

    Args:
        seed: of the design and of the data.
        theta: true shared parameters.
    """

    def __init__(self, seed: int, theta: np.ndarray) -> None:
        rng = np.random.default_rng(seed)
        self.A, self.B = rng.normal(size=(12, 2)) / SD, rng.normal(size=(12, 3))
        self.y = self.A @ theta + self.B @ rng.normal(size=3) * OWN_SD + NOISE * rng.normal(size=12)
        self.covariance = NOISE**2 * np.eye(12) + OWN_SD**2 * self.B @ self.B.T

    def alone(self) -> OwnInformation:
        """Return what it says of theta alone, in closed form."""
        inverse = np.linalg.inv(self.covariance)
        V, h = self.A.T @ inverse @ self.A, self.A.T @ inverse @ self.y
        theta = np.linalg.solve(V + np.diag(SD**-2.0), h)
        marginal = self.covariance + self.A @ np.diag(SD**2) @ self.A.T
        log_evidence = float(multivariate_normal(cov=marginal).logpdf(self.y))
        return OwnInformation(log_evidence=log_evidence, theta=theta, precision=V, slope=h - V @ theta)


def at_once(recordings: list[LinearRecording]) -> tuple[float, np.ndarray, np.ndarray]:
    """Return evidence, mean and standard deviations of theta by the density of all data at once."""
    y, A = np.concatenate([one.y for one in recordings]), np.vstack([one.A for one in recordings])
    covariance = np.zeros((len(y), len(y)))
    for k, one in enumerate(recordings):
        covariance[12 * k : 12 * k + 12, 12 * k : 12 * k + 12] = one.covariance
    marginal = covariance + A @ np.diag(SD**2) @ A.T
    gain = np.diag(SD**2) @ A.T @ np.linalg.inv(marginal)
    posterior = np.diag(SD**2) - gain @ A @ np.diag(SD**2)
    return float(multivariate_normal(cov=marginal).logpdf(y)), gain @ y, np.sqrt(np.diag(posterior))


@pytest.mark.parametrize("count", [1, 2, 5])
def test_linear_recordings_together_are_as_if_fitted_at_once(count):
    recordings = [LinearRecording(seed, np.array([0.5, -0.01])) for seed in range(count)]
    found = joint_evidence([one.alone() for one in recordings], FREE)
    log_evidence, mean, sd = at_once(recordings)
    assert found.log_evidence == pytest.approx(log_evidence, rel=EXACT)
    np.testing.assert_allclose(found.theta, mean, rtol=EXACT)
    np.testing.assert_allclose(found.sd, sd, rtol=1e3 * EXACT)  # by a difference of two covariances
    if count == 1:
        assert found.log_evidence == pytest.approx(recordings[0].alone().log_evidence, rel=EXACT)


def test_recordings_of_different_parameters_have_less_evidence_together():
    """By twenty standard deviations of the data; evidence that is apart does not notice."""
    same, other = LinearRecording(0, np.array([0.5, 0.0])), LinearRecording(1, np.array([-0.5, 0.0]))
    apart = same.alone().log_evidence + other.alone().log_evidence
    assert joint_evidence([same.alone(), other.alone()], FREE).log_evidence < apart - 20
    alike = LinearRecording(1, np.array([0.5, 0.0]))
    assert joint_evidence([same.alone(), alike.alone()], FREE).log_evidence > (
        same.alone().log_evidence + alike.alone().log_evidence
    )


def test_without_shared_parameters_evidences_add():
    nothing = np.zeros(0)
    each = [
        OwnInformation(log_evidence=nat, theta=nothing, precision=np.zeros((0, 0)), slope=nothing)
        for nat in (-3.0, 5.5, 1.0)
    ]
    found = joint_evidence(each, SharedPrior(sd=nothing, lower=nothing))
    assert found.log_evidence == 3.5 and not found.theta.size


def bounded(mean: float, sd: float) -> OwnInformation:
    """Return what a recording says of a parameter that may not be negative, by a normal likelihood of peak 1.

    Its evidence is that of `evidence.log_model_evidence`: Laplace's, or the density at the bound.
    """
    V = sd**-2.0
    best = max(0.0, V * mean / (V + 1))
    log_density = norm.logpdf(mean, best, sd) - norm.logpdf(0, 0, sd) - 0.5 * best**2
    log_width = -0.5 * np.log1p(V) if best > 0 else 0.0
    slope, theta = np.array([V * (mean - best)]), np.array([best])
    return OwnInformation(
        log_evidence=float(log_density + log_width), theta=theta, precision=np.array([[V]]), slope=slope
    )


NOT_NEGATIVE = SharedPrior(sd=np.ones(1), lower=np.zeros(1))


def test_a_recording_at_the_bound_counts_against_the_others():
    """One says 0.6 ± 0.1, one -0.1 ± 0.2 and so 0, which is at the bound; the integral is over the half line."""
    found = joint_evidence([bounded(0.6, 0.1), bounded(-0.1, 0.2)], NOT_NEGATIVE)

    def density(theta: float) -> float:
        each = [np.exp(-0.5 * ((theta - mean) / sd) ** 2) for mean, sd in ((0.6, 0.1), (-0.1, 0.2))]
        return float(np.prod(each) * norm.pdf(theta))

    total = quad(density, 0, 3, epsabs=1e-14)[0]
    mean = quad(lambda theta: theta * density(theta), 0, 3, epsabs=1e-14)[0] / total
    assert found.log_evidence == pytest.approx(np.log(total), abs=1e-3)  # a millionth of the density is below 0
    assert found.theta[0] == pytest.approx(mean, rel=1e-3)
    assert found.theta[0] < 0.5


def test_parameters_at_the_bound_in_all_recordings_stay_there():
    found = joint_evidence([bounded(-0.1, 0.2), bounded(-0.3, 0.2)], NOT_NEGATIVE)
    assert found.theta[0] == 0 and found.sd[0] == 0
    assert found.log_evidence == pytest.approx(-0.5 * 0.5**2 - 0.5 * 1.5**2)


def test_what_is_no_number_has_no_evidence():
    one = LinearRecording(0, np.zeros(2)).alone()
    lost = OwnInformation(log_evidence=-np.inf, theta=one.theta, precision=one.precision, slope=one.slope)
    assert joint_evidence([one, lost], FREE).log_evidence == -np.inf
