"""Expectation and belief propagation against what can be summed or integrated exactly."""

from itertools import product

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import expit, logit

from jiggle_mj.estimator.belief.attachment_belief import AttachmentBelief
from jiggle_mj.estimator.belief.attachment_prior import AttachmentPrior
from jiggle_mj.estimator.belief.config import BeliefConfig
from jiggle_mj.estimator.belief.spike_and_slab import SpikeAndSlab

COMPONENTS, SPREAD = (0.03, 0.3), 0.5
STIFFNESS = SpikeAndSlab.build(spike=3e-3, components=COMPONENTS, spread=SPREAD, dirichlet_strength=1e12, partial=0.0)
"""With so many equal particles beforehand that the weights stay as they are."""
PROBABILITY, REFERENCE = 0.1, 30.0
NO_MESH_ERROR = {"edge_transfer": 0.0, "rim_transfer": 0.0, "common_error": 0.0}
"""Settings of a belief whose mesh represents any attachment."""
NO_TRANSFER = BeliefConfig(**NO_MESH_ERROR)
CONVERGED = 1e-6
"""Relative; error of a fixed point after 30 damped sweeps."""
EP_ERROR = 0.05
"""Relative error of the mean where two particles share a load: a Gaussian stands for a posterior with two peaks."""

swept, posterior = eqx.filter_jit(AttachmentBelief.swept), eqx.filter_jit(AttachmentBelief.posterior)
moments = eqx.filter_jit(AttachmentBelief.moments)
interval = eqx.filter_jit(AttachmentBelief.interval)


def chain(n: int, *, coupling: float, config: BeliefConfig | None = None) -> AttachmentBelief:
    """Return the belief over particles in a row before any evidence."""
    edges = np.column_stack([np.arange(n - 1), np.arange(1, n)])
    prior = AttachmentPrior.build(n, edges, stiffness=STIFFNESS, probability=PROBABILITY, coupling=coupling)
    return AttachmentBelief.before(prior, reference=REFERENCE, config=config)


def alone(mean: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the moments of particles without neighbours, measured independently."""
    odds = jnp.full(len(mean), logit(PROBABILITY))
    mixture, _ = eqx.filter_jit(STIFFNESS.posterior)(jnp.asarray(mean), jnp.asarray(variance), odds)
    means, variances = eqx.filter_jit(mixture.moments)()
    return np.asarray(means), np.asarray(variances)


def test_independent_measurements_give_each_particle_its_own_posterior():
    mean, variance = np.array([0.0, 0.02, 0.15, 0.9]), np.array([1e-5, 1e-4, 1e-4, 1e-2])
    belief = chain(4, coupling=0.0, config=NO_TRANSFER)
    belief = swept(belief.add(jnp.diag(jnp.asarray(1 / variance)), jnp.asarray(mean / variance)), 30)
    expected, spread = alone(mean, variance)
    found = posterior(belief)
    np.testing.assert_allclose(found.mean, expected, rtol=CONVERGED)
    np.testing.assert_allclose(found.sd**2, spread, rtol=CONVERGED)


def test_odds_along_a_chain_are_exact():
    """Belief propagation on a tree: against the sum over all 2^n states."""
    n, coupling = 5, 1.5
    mean, variance = np.array([0.0, 0.01, 0.012, 0.0, 0.05]), np.full(5, 3e-5)
    belief = chain(n, coupling=coupling)
    belief = swept(belief.add(jnp.diag(jnp.asarray(1 / variance)), jnp.asarray(mean / variance)), 60)
    log_odds = jnp.full(n, logit(PROBABILITY))
    factor = np.asarray(STIFFNESS.posterior(jnp.asarray(mean), jnp.asarray(variance), log_odds)[1])
    total, attached = 0.0, np.zeros(n)
    for state in product((0, 1), repeat=n):
        a = np.array(state)
        weight = np.exp(a @ (logit(PROBABILITY) + factor) + coupling * np.sum(a[1:] * a[:-1]))
        total += weight
        attached += weight * a
    np.testing.assert_allclose(posterior(belief).attached, attached / total, rtol=CONVERGED)


def test_two_particles_that_share_a_load():
    """Only their sum is measured, so either may bear the load: the mean against integration over the square.

    A Gaussian cannot have two peaks; its standard deviation is not too small, and at most twice the true one.
    """
    total, variance, weak = 0.2, 1e-4, 1e-3
    precision = np.full((2, 2), 1 / variance) + weak * np.eye(2)
    belief = swept(chain(2, coupling=0.0).add(jnp.asarray(precision), jnp.asarray(np.full(2, total / variance))), 60)
    s = np.concatenate([np.linspace(0, 0.02, 400, endpoint=False), np.linspace(0.02, 1, 2400)])
    parts = [
        np.exp(-0.5 * ((s - at) / sd) ** 2)
        for at, sd in ((0, 3e-3), *((component, SPREAD * component) for component in COMPONENTS))
    ]
    free, soft, stiff = (part / np.trapezoid(part, s) for part in parts)
    prior = (1 - PROBABILITY) * free + PROBABILITY * (soft + stiff) / 2
    joint = np.exp(-0.5 * (s[:, None] + s[None] - total) ** 2 / variance) * prior[:, None] * prior[None]
    joint /= np.trapezoid(np.trapezoid(joint, s, axis=1), s)
    expected = np.trapezoid(np.trapezoid(joint, s, axis=1) * s, s)
    found = posterior(belief)
    np.testing.assert_allclose(found.mean, expected, rtol=EP_ERROR)
    np.testing.assert_allclose(found.mean.sum(), total, atol=np.sqrt(variance))
    spread = np.sqrt(np.trapezoid(np.trapezoid(joint, s, axis=1) * (s - expected) ** 2, s))
    assert (spread < np.asarray(found.sd)).all() and (np.asarray(found.sd) < 2 * spread).all()


def test_particles_without_evidence_stay_at_the_prior():
    belief = chain(3, coupling=0.0)
    seen = swept(belief.add(jnp.diag(jnp.array([1e6, 0.0, 0.0])), jnp.array([1e5, 0.0, 0.0])), 30)
    assert float(posterior(seen).attached[0]) > 0.99
    np.testing.assert_allclose(posterior(seen).attached[1:], PROBABILITY, rtol=CONVERGED)
    assert float(belief.entropy()) > float(seen.entropy())


def test_an_attached_neighbour_raises_the_odds():
    """A neighbour that is certain multiplies them by e^J."""
    coupling = 1.2
    belief = swept(chain(2, coupling=coupling).add(jnp.diag(jnp.array([1e6, 0.0])), jnp.array([3e5, 0.0])), 60)
    assert float(posterior(belief).attached[1]) == pytest.approx(expit(logit(PROBABILITY) + coupling), rel=CONVERGED)


def test_intervals_open_upwards_where_only_a_lower_end_is_known():
    mean, sd = np.array([0.0, 0.1, 0.99]), np.array([1e-3, 5e-3, 5e-2])
    belief = chain(3, coupling=0.0, config=NO_TRANSFER)
    belief = swept(belief.add(jnp.diag(jnp.asarray(sd**-2)), jnp.asarray(mean / sd**2)), 30)
    lower, upper = (np.asarray(end) for end in interval(belief))
    assert lower[0] == 0 and upper[0] < REFERENCE * 0.01
    assert lower[1] < REFERENCE * 0.1 / 0.9 < upper[1] < np.inf
    assert lower[2] > 4 * REFERENCE and upper[2] == np.inf


def test_a_part_of_the_difference_between_neighbours_adds_to_each_variance_and_not_to_sums():
    """A narrow band: the two particles at its edges may have more, by a part of the difference on each edge."""
    mean, variance = np.array([0.004, 0.05, 0.004]), np.full(3, 1e-8)
    summary = []
    for part in (0.0, 0.1):
        belief = chain(
            3, coupling=0.0, config=BeliefConfig(**{**NO_MESH_ERROR, "edge_transfer": part, "rim_transfer": part})
        )
        belief = belief.add(jnp.diag(jnp.asarray(1 / variance)), jnp.asarray(mean / variance))
        summary.append((np.asarray(moments(belief)[1]), posterior(belief).sd, interval(belief)))
    (sharp, sharp_sd, sharp_interval), (wide, wide_sd, wide_interval) = summary
    s = np.asarray(moments(belief)[0])
    edges = np.array([[1, -1, 0], [0, 1, -1]]) * 0.1 * np.diff(s)[:, None]
    np.testing.assert_allclose(wide - sharp, edges.T @ edges, atol=1e-12)
    np.testing.assert_allclose(wide.sum(), sharp.sum(), rtol=1e-6)
    np.testing.assert_allclose(wide_sd**2 - sharp_sd**2, np.diagonal(edges.T @ edges), rtol=1e-6)
    assert float(wide_interval[0][1]) < float(sharp_interval[0][1]) < float(sharp_interval[1][1])
    assert (np.asarray(wide_interval[1]) > np.asarray(sharp_interval[1])).all()


def test_the_common_error_adds_to_the_sum_and_not_to_ratios():
    mean, variance = np.array([0.02, 0.05, 0.04]), np.full(3, 1e-8)
    belief = chain(3, coupling=0.0, config=BeliefConfig(**{**NO_MESH_ERROR, "common_error": 0.06}))
    belief = belief.add(jnp.diag(jnp.asarray(1 / variance)), jnp.asarray(mean / variance))
    covariance, ratio = np.asarray(moments(belief)[1]), np.array([0.05 * 0.95, -0.02 * 0.98, 0.0])
    common = 0.06 * np.sum(mean * (1 - mean))
    assert covariance.sum() == pytest.approx(common**2 + variance.sum(), rel=0.01)
    assert ratio @ covariance @ ratio == pytest.approx(ratio @ (variance * ratio), rel=0.05)
    np.testing.assert_allclose(posterior(belief).sd ** 2, np.diagonal(covariance), rtol=1e-6)


def test_a_particle_at_the_rim_of_a_weld_may_have_any_stiffness():
    """Measured as nearly free beside a weld, its deviation is that of a share in [0, 1]; not so beside a soft one."""
    mean, variance = np.array([0.9, 0.05, 0.0, 0.05, 0.1]), np.full(5, 1e-6)
    belief = chain(5, coupling=0.0, config=BeliefConfig(**{**NO_MESH_ERROR, "rim_transfer": 0.5}))
    belief = belief.add(jnp.diag(jnp.asarray(1 / variance)), jnp.asarray(mean / variance))
    sd = np.asarray(posterior(belief).sd)
    assert sd[1] == pytest.approx(0.9**2 * (0.9 - 0.05) / 2, rel=1e-2)
    assert sd[3] < 0.05 / 10
    assert float(jnp.sum(moments(belief)[1])) == pytest.approx(variance.sum(), rel=1e-2)
    lower, upper = (np.asarray(end) for end in interval(belief))
    measured = REFERENCE * 0.05 / 0.95
    assert lower[1] < measured / 2 and upper[1] > 5 * measured


def test_stiffness_and_its_bounded_form_are_inverse():
    belief, b = chain(4, coupling=0.0), jnp.array([0.0, 0.3, 30.0, np.inf])
    np.testing.assert_allclose(belief.bounded(b), [0, 0.3 / 30.3, 0.5, 1])
    np.testing.assert_allclose(belief.stiffness(belief.bounded(b)), b)


@pytest.mark.parametrize(
    "setting", [{"damping": 0.0}, {"learning_rate": 1.5}, {"edge_transfer": -0.1}, {"open_above": 2.0}, {"tail": 0.5}]
)
def test_settings_outside_of_their_range_are_refused(setting):
    (name,) = setting
    with pytest.raises(ValueError, match=f"BeliefConfig.{name} must"):
        BeliefConfig(**setting)
