"""Samples of who is attached against the sum over all states."""

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
from jiggle_mj.estimator.belief.spike_and_slab import SpikeAndSlab

N, PROBABILITY, COUPLING = 5, 0.1, 1.0
EDGES = np.column_stack([np.arange(N - 1), np.arange(1, N)])
ROUNDS = 3000


def prior(dirichlet_strength: float = 1e12) -> AttachmentPrior:
    """A row of particles; by default so sure of its shares that nothing is learned."""
    stiffness = SpikeAndSlab.build(
        spike=3e-3, components=(0.03, 0.3), spread=0.3, dirichlet_strength=dirichlet_strength, partial=0.0
    )
    return AttachmentPrior.build(N, EDGES, stiffness=stiffness, probability=PROBABILITY, coupling=COUPLING)


def seen(load: float) -> tuple[np.ndarray, np.ndarray]:
    """Precision and shift: the first two carry a load together, the last is free, of the third nothing is known."""
    precision = np.diag([1.0, 1.0, 0.0, 1e3, 1e5])
    precision[:2, :2] += 1e4
    return precision, np.array([1e4 * load, 1e4 * load, 0.0, 30.0, 0.0])


def sampler(load: float, dirichlet_strength: float = 1e12) -> Sampler:
    precision, shift = seen(load)
    return Sampler(prior=prior(dirichlet_strength), precision=jnp.asarray(precision), shift=jnp.asarray(shift))


def sampled(
    load: float, rounds: int = ROUNDS, doublings: int = 1, dirichlet_strength: float = 1e12
) -> PosteriorSamples:
    return eqx.filter_jit(sampler(load, dirichlet_strength).run)(
        jnp.zeros(N, int),
        jax.random.key(1),
        burn_in=2,
        rounds=jnp.asarray(rounds),
        doublings=jnp.asarray(doublings),
    )


def given(load: float, state: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Log probability of a state, whose attached s are above 0, up to a constant; mean and covariance of s without."""
    stiffness, (precision, shift) = prior().stiffness, seen(load)
    centre, narrow = np.asarray(stiffness.mean), np.asarray(stiffness.sd) ** -2.0
    T, attached = np.diag(narrow[state]), np.minimum(state, 1)
    covariance = np.linalg.inv(precision + T)
    at = covariance @ (shift + T @ centre[state])
    log = attached @ np.full(N, logit(PROBABILITY) + np.log(0.5)) + COUPLING * (attached[1:] @ attached[:-1])
    log += 0.5 * (np.linalg.slogdet(T)[1] + np.linalg.slogdet(covariance)[1])
    log += 0.5 * (at @ np.linalg.solve(covariance, at) - centre[state] @ T @ centre[state])
    if (of := np.flatnonzero(attached)).size:
        log += np.log(multivariate_normal(cov=covariance[np.ix_(of, of)]).cdf(at[of]))
    return float(log), at, covariance


def summed(load: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Probabilities of all states of each particle; mean and variance of s."""
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
    """Also where the load of two may be that of one, so that each takes turns. A load of 0.3 is handed over too rarely
    for so many samples: P is 0.05 off."""
    found, (weight, mean, variance) = sampled(load), summed(load)
    np.testing.assert_allclose(found.weight, weight, atol=0.02)
    np.testing.assert_allclose(found.mean, mean, atol=0.05 * np.sqrt(variance).max())
    np.testing.assert_allclose(found.variance, variance, rtol=0.15)
    assert found.agree


@pytest.mark.parametrize("load", [0.0, 0.03, 0.3])
def test_in_a_mode_no_particle_is_likelier_otherwise_and_a_load_is_carried(load):
    """By the first or by the second, where the odds of each may be even; there is nothing else to choose from."""
    state, mean = eqx.filter_jit(sampler(load).mode)(jnp.zeros(N, int), jax.random.key(0))
    found = np.asarray(state)
    for i, other in product(range(N), range(3)):
        assert given(load, np.where(np.arange(N) == i, other, found))[0] <= given(load, found)[0] + 1e-9
    np.testing.assert_allclose(mean, given(load, found)[1], rtol=1e-9, atol=1e-12)
    assert np.minimum(found[:2], 1).sum() == (load > 0)


def test_a_chain_that_has_not_seen_enough_says_so_or_goes_on():
    assert not sampled(0.03, rounds=1).agree
    assert sampled(0.03, rounds=1, doublings=12).agree


def test_a_sweep_keeps_the_moments_up_to_date():
    one = sampler(0.06)
    state = jnp.array([1, 2, 0, 0, 2])
    after, moments, _ = eqx.filter_jit(one._sweep)(
        state, one._moments(state), one.prior.stiffness.share, jax.random.key(3)
    )
    assert (after != state).any()
    anew = one._moments(after)
    np.testing.assert_allclose(moments.mean, anew.mean, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(moments.covariance, anew.covariance, rtol=1e-6, atol=1e-12)


def test_shares_are_learned_from_those_that_are_attached():
    """Two stiff ones; with few expected beforehand the stiff rung is the commoner."""
    found = sampled(0.6, dirichlet_strength=1.0)
    assert float(found.weights[1]) > 0.7
    assert float(jnp.sum(found.weights)) == pytest.approx(1)


def test_what_asks_for_less_than_nothing_is_free():
    """The widest rung, 0.3 with a spread of 0.09, lies within 5 sd of the load, free 10 away."""
    found = sampled(-0.15)
    assert (np.asarray(found.weight)[0, :2] > 0.99).all()


def test_a_belief_takes_over_what_the_samples_say():
    precision, shift = seen(0.06)
    belief = AttachmentBelief.before(prior(), reference=30.0).add(jnp.asarray(precision), jnp.asarray(shift))
    belief, agree = eqx.filter_jit(belief.sampled)(jax.random.key(1), burn_in=2, rounds=jnp.asarray(ROUNDS))
    weight, mean, variance = summed(0.06)
    posterior = eqx.filter_jit(belief.posterior)()
    assert agree
    np.testing.assert_allclose(posterior.attached, 1 - weight[0], atol=0.02)
    np.testing.assert_allclose(posterior.mean, np.clip(mean, 0, 1), atol=0.05 * np.sqrt(variance).max())
    np.testing.assert_allclose(posterior.sd**2, variance, rtol=0.2)
