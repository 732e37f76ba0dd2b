"""Samples of which particles are attached against the sum over all states."""

from itertools import product

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import logit
from scipy.stats import multivariate_normal

from jiggle_mj.estimator.belief.attachment_belief import AttachmentBelief
from jiggle_mj.estimator.belief.attachment_prior import AttachmentPrior
from jiggle_mj.estimator.belief.attachment_sampler import PosteriorSamples, Sampler
from jiggle_mj.estimator.belief.config import SamplerConfig
from jiggle_mj.estimator.belief.spike_and_slab import SpikeAndSlab

N, PROBABILITY, COUPLING = 5, 0.1, 1.0
EDGES = np.column_stack([np.arange(N - 1), np.arange(1, N)])
SWEEPS = 4000
PROBABILITY_ERROR = 0.02
"""Standard error of a probability by 32 000 correlated sweeps, with room: two particles exchange a load rarely."""
MEAN_ERROR = 0.05
"""The same of the mean, in the largest standard deviation of any s."""
VARIANCE_ERROR = 0.15
"""The same of a variance, relative: that of two peaks follows the probability of each."""
SITE_ERROR = 0.2
"""The same of the variance of a belief, whose sites match it by a damped iteration within a range."""


def prior(dirichlet_strength: float = 1e12) -> AttachmentPrior:
    """Return the prior of a row of particles, by default so strong that the weights of the components stay."""
    stiffness = SpikeAndSlab.build(
        spike=3e-3, components=(0.03, 0.3), spread=0.3, dirichlet_strength=dirichlet_strength, partial=0.0
    )
    return AttachmentPrior.build(N, EDGES, stiffness=stiffness, probability=PROBABILITY, coupling=COUPLING)


def seen(load: float) -> tuple[np.ndarray, np.ndarray]:
    """Return precision and shift: the first two bear a load together, the last is free, the third was not seen."""
    precision = np.diag([1.0, 1.0, 0.0, 1e3, 1e5])
    precision[:2, :2] += 1e4
    return precision, np.array([1e4 * load, 1e4 * load, 0.0, 30.0, 0.0])


def sampler(load: float, dirichlet_strength: float = 1e12, **settings: int) -> Sampler:
    precision, shift = seen(load)
    return Sampler.build(
        prior(dirichlet_strength), jnp.asarray(precision), jnp.asarray(shift), SamplerConfig(**settings)
    )


def sampled(
    load: float, sweeps: int = SWEEPS, doublings: int = 0, dirichlet_strength: float = 1e12
) -> tuple[PosteriorSamples, bool]:
    chain = sampler(load, dirichlet_strength)
    start = [chain.start(jnp.zeros(N, int))] * chain.config.chains
    chains, agree = chain.run(start, jax.random.key(1), burn_in=20, sweeps=sweeps, doublings=doublings)
    return eqx.filter_jit(PosteriorSamples.of)(chains), agree


def given(load: float, state: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the log probability of a state with all attached s above 0, up to a constant, and moments of s without."""
    stiffness, (precision, shift) = prior().stiffness, seen(load)
    centre, narrow = np.asarray(stiffness.mean), np.asarray(stiffness.sd) ** -2.0
    T, attached = np.diag(narrow[state]), np.minimum(state, 1)
    covariance = np.linalg.inv(precision + T)
    at = covariance @ (shift + T @ centre[state])
    log = attached @ np.full(N, logit(PROBABILITY) + np.log(0.5)) + COUPLING * (attached[1:] @ attached[:-1])
    log += 0.5 * (np.linalg.slogdet(T)[1] + np.linalg.slogdet(covariance)[1])
    log += 0.5 * (at @ np.linalg.solve(covariance, at) - centre[state] @ T @ centre[state])
    if (index := np.flatnonzero(attached)).size:
        log += np.log(multivariate_normal(cov=covariance[np.ix_(index, index)]).cdf(at[index]))
    return float(log), at, covariance


def summed(load: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the probabilities of all states of each particle, and mean and variance of s."""
    total, weight, mean, squared = 0.0, np.zeros((3, N)), np.zeros(N), np.zeros(N)
    for each in product(range(3), repeat=N):
        state = np.array(each)
        log, at, covariance = given(load, state)
        total += (p := np.exp(log))
        weight += p * (state == np.arange(3)[:, None])
        mean, squared = mean + p * at, squared + p * (at**2 + np.diag(covariance))
    return weight / total, mean / total, squared / total - (mean / total) ** 2


@pytest.mark.parametrize("load", [0.0, 0.03, 0.06])
def test_samples_are_those_of_the_posterior(load):
    """Also where one of two particles may bear the whole load, so that they exchange it. A load of 0.3 is exchanged too
    rarely for so many samples: P errs by 0.05."""
    (found, agree), (weight, mean, variance) = sampled(load), summed(load)
    np.testing.assert_allclose(found.probability, weight, atol=PROBABILITY_ERROR)
    np.testing.assert_allclose(found.mean, mean, atol=MEAN_ERROR * np.sqrt(variance).max())
    np.testing.assert_allclose(found.variance, variance, rtol=VARIANCE_ERROR)
    assert agree


@pytest.mark.parametrize("load", [0.0, 0.03, 0.3])
def test_in_a_mode_no_other_component_of_a_particle_is_likelier_and_a_load_is_supported(load):
    """By the first or by the second, each of which may have even odds; no third particle can bear it."""
    state, mean = eqx.filter_jit(sampler(load).mode)(jnp.zeros(N, int), jax.random.key(0))
    found = np.asarray(state)
    for i, other in product(range(N), range(3)):
        assert given(load, np.where(np.arange(N) == i, other, found))[0] <= given(load, found)[0] + 1e-9
    np.testing.assert_allclose(mean, given(load, found)[1], rtol=1e-9, atol=1e-12)
    assert np.minimum(found[:2], 1).sum() == (load > 0)


def test_chains_with_too_few_sweeps_report_it_or_continue():
    assert not sampled(0.06, sweeps=1)[1]
    assert sampled(0.06, sweeps=1, doublings=12)[1]


def test_a_chain_continues_where_it_ended():
    """Two parts of a run count together, and the same key gives the same chains to the last bit."""
    chain, key = sampler(0.06), jax.random.key(2)
    start = [chain.start(jnp.zeros(N, int))] * chain.config.chains
    (first, _), (again, _) = (chain.run(start, key, burn_in=1, sweeps=2, doublings=0) for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, first, again)
    assert len({tuple(np.asarray(one.sums.mean)) for one in first}) > 1
    further, _ = chain.run(first, key, burn_in=1, sweeps=3, doublings=0)
    assert [float(jnp.sum(one.sums.probability)) for one in further] == pytest.approx([5 * N] * len(further))


@pytest.mark.parametrize("settings", [{"candidates": 1}, {"candidates": 3}])
def test_settings_of_speed_do_not_change_the_draws(settings):
    """The same components and, to rounding in single precision, the same log probabilities, however many particles are
    drawn at once."""
    component = jnp.array([1, 2, 0, 0, 2])
    expected, found = (
        eqx.filter_jit(chain.sweep)(component, chain.prior.stiffness, jax.random.key(3))
        for chain in (sampler(0.06), sampler(0.06, **settings))
    )
    assert (expected.component != component).any()
    np.testing.assert_array_equal(found.component, expected.component)
    np.testing.assert_allclose(found.log_weight, expected.log_weight, rtol=1e-5)
    np.testing.assert_allclose(found.cavity.mean, expected.cavity.mean, rtol=1e-9)


def test_sampler_settings_outside_of_their_range_are_refused():
    with pytest.raises(ValueError, match=r"SamplerConfig\.candidates = 0: must be an integer of at least 1"):
        SamplerConfig(candidates=0)
    with pytest.raises(ValueError, match=r"SamplerConfig\.agreement must be above 0"):
        SamplerConfig(agreement=0.0)


def test_component_weights_are_learned_from_attached_particles():
    """Two stiff particles: with a weak prior the stiff component gets more weight than the soft one."""
    found, _ = sampled(0.6, dirichlet_strength=1.0)
    assert float(found.weights[1]) > 0.7
    assert float(jnp.sum(found.weights)) == pytest.approx(1)


@pytest.mark.parametrize("by", ["samples", "propagation"])
def test_what_was_not_seen_is_as_stiff_as_its_neighbours(by):
    """A row, stiff at one end and soft at the other, both measured; of each half the particle inside was not seen. That
    does not change how likely those are attached. With an equal share the first would be stiff with a chance of 1/2."""
    edges, mean = np.column_stack([np.arange(5), np.arange(1, 6)]), jnp.array([0.3, 0.3, 0.0, 0.0, 0.03, 0.03])
    precision, found = jnp.array([1e4, 1e4, 0.0, 0.0, 1e6, 1e6]), []
    for strength in (0.25, np.inf):
        stiffness = SpikeAndSlab.build(
            spike=3e-3, components=(0.03, 0.3), spread=0.3, dirichlet_strength=1e12, partial=0.0
        )
        prior = AttachmentPrior.build(
            6, edges, stiffness=stiffness, probability=0.5, coupling=2.0, sheet_strength=strength
        )
        belief = AttachmentBelief.before(prior, reference=1.0).add(jnp.diag(precision), precision * mean)
        if by == "samples":
            belief, agree = belief.sampled(jax.random.key(0), burn_in=0, first_burn_in=30, sweeps=400, doublings=0)
            assert agree
        else:
            belief = eqx.filter_jit(belief.swept)(30)
        found.append(np.asarray(belief.mixture().weight))
    alike, equal = (weight[2, 2:4] / weight[1:, 2:4].sum(axis=0) for weight in found)
    assert alike[0] > 0.65 and alike[1] < 0.35
    np.testing.assert_allclose(equal, 0.5, atol=PROBABILITY_ERROR)
    np.testing.assert_allclose(*(weight[0, 2:4] for weight in found), atol=PROBABILITY_ERROR)


def test_particles_that_the_evidence_pulls_below_zero_are_free():
    """The widest component, 0.3 with a spread of 0.09, lies within 5 sd of the load, free 10 away."""
    found, _ = sampled(-0.15)
    assert (np.asarray(found.probability)[0, :2] > 0.99).all()


def test_a_belief_matches_the_samples():
    precision, shift = seen(0.06)
    belief = AttachmentBelief.before(prior(), reference=30.0).add(jnp.asarray(precision), jnp.asarray(shift))
    belief, agree = belief.sampled(jax.random.key(1), burn_in=0, first_burn_in=20, sweeps=SWEEPS, doublings=0)
    weight, mean, variance = summed(0.06)
    posterior = eqx.filter_jit(belief.posterior)()
    assert agree
    np.testing.assert_allclose(posterior.attached, 1 - weight[0], atol=PROBABILITY_ERROR)
    np.testing.assert_allclose(posterior.mean, np.clip(mean, 0, 1), atol=MEAN_ERROR * np.sqrt(variance).max())
    np.testing.assert_allclose(posterior.sd**2, variance, rtol=SITE_ERROR)
