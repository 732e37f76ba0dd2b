"""Free or attached: odds, moments and quantiles against numerical integration."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from jiggle_mj.estimator.belief.spike_and_slab import Mixture, SpikeAndSlab

SPIKE, COMPONENTS, SPREAD = 3e-3, (0.01, 0.1, 1.0), 0.5
LOG_ODDS = -3.0
RATE = 0.2
"""Share of a step of expectation maximisation that each call takes."""
PRIOR = SpikeAndSlab.build(spike=SPIKE, components=COMPONENTS, spread=SPREAD, dirichlet_strength=3.0, partial=0.0)

posterior = eqx.filter_jit(SpikeAndSlab.posterior)
learned_from = eqx.filter_jit(partial(SpikeAndSlab.learned, rate=RATE))
drawn_for = eqx.filter_jit(SpikeAndSlab.drawn)
moments, quantile = eqx.filter_jit(Mixture.moments), eqx.filter_jit(Mixture.quantile)


def density(mean: float, variance: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Return a grid, the posterior on it, and the log Bayes factor."""
    s = np.unique(np.concatenate([np.linspace(0, 1, 100_001), np.linspace(0, 0.03, 100_001)]))
    seen = np.exp(norm.logpdf(s, mean, np.sqrt(variance)) - norm.logpdf(np.clip(mean, 0, 1), mean, np.sqrt(variance)))

    def cut_off(centre: float, width: float) -> np.ndarray:
        shape = np.exp(-0.5 * ((s - centre) / width) ** 2)
        return shape / np.trapezoid(shape, s)

    free = cut_off(0, SPIKE) * seen
    attached = np.mean([cut_off(component, SPREAD * component) for component in COMPONENTS], axis=0) * seen
    odds = np.trapezoid(attached, s) / np.trapezoid(free, s)
    weights = free + np.exp(LOG_ODDS) * attached
    return s, weights / np.trapezoid(weights, s), float(np.log(odds))


@pytest.mark.parametrize(
    ("mean", "variance"),
    [(0.02, 1e-4), (-0.05, 1e-4), (0.005, 1e-6), (0.5, 1e4), (0.9, 1e-2), (1.3, 1e-2), (0.0, 1e-6)],
)
def test_posterior_equals_numerical_integration(mean, variance):
    mixture, factor = posterior(PRIOR, jnp.array([mean]), jnp.array([variance]), jnp.array([LOG_ODDS]))
    s, p, expected_factor = density(mean, variance)
    below = np.concatenate([[0], np.cumsum((p[1:] + p[:-1]) / 2 * np.diff(s))])
    expected = np.trapezoid(p * s, s)
    found, spread = (float(part[0]) for part in moments(mixture))
    assert float(factor[0]) == pytest.approx(expected_factor, abs=1e-4)
    assert float(mixture.attached[0]) == pytest.approx(1 / (1 + np.exp(-LOG_ODDS - expected_factor)), abs=1e-4)
    assert found == pytest.approx(expected, rel=1e-4)
    assert np.sqrt(spread) == pytest.approx(np.sqrt(np.trapezoid(p * (s - expected) ** 2, s)), rel=1e-3)
    for level in (0.05, 0.5, 0.95):
        assert float(quantile(mixture, level)[0]) == pytest.approx(np.interp(level, below, s), rel=1e-2, abs=1e-5)


def test_far_out_in_the_tails_nothing_overflows():
    mean, variance = jnp.array([-5.0, 0.3, 9.0]), jnp.array([1e-6, 1e-12, 1e-6])
    mixture, factor = posterior(PRIOR, mean, variance, jnp.full(3, LOG_ODDS))
    found, spread = moments(mixture)
    assert np.isfinite(factor).all() and np.isfinite(spread).all()
    np.testing.assert_allclose(found, [0, 0.3, 1], atol=1e-4)
    np.testing.assert_allclose(quantile(mixture, 0.5), [0, 0.3, 1], atol=1e-4)


def test_the_weights_are_those_of_the_particles_called_attached():
    """Twenty on one component, measured well. Not counted are two free ones, one that was not measured, and two that
    are called attached only because their neighbours are."""
    mean = jnp.array([0.1] * 20 + [0.0, 0.0, 0.5, 0.0, 0.0])
    variance = jnp.array([1e-6] * 22 + [1e6, 1e-6, 1e-6])
    odds = jnp.array([LOG_ODDS] * 23 + [20.0, 20.0])
    mixture, factor = posterior(PRIOR, mean, variance, odds)
    assert (mixture.attached[-2:] > 0.5).all()
    learned = once = learned_from(PRIOR, mixture, factor)
    for _ in range(100):
        learned = learned_from(learned, mixture, factor)
    on_it = np.asarray(mixture.weight[2, :20]).sum()
    assert float(learned.share[1]) == pytest.approx((1 + on_it) / 23, rel=1e-6)
    assert float(jnp.sum(learned.share)) == pytest.approx(1)
    np.testing.assert_allclose(once.share, PRIOR.share + RATE * (learned.share - PRIOR.share), rtol=1e-5)
    nobody, factor = posterior(PRIOR, jnp.zeros(4), jnp.full(4, 1e-6), jnp.full(4, LOG_ODDS))
    np.testing.assert_allclose(learned_from(PRIOR, nobody, factor).share, 1 / 3)


def test_a_part_of_an_attachment_has_the_nearest_softer_component():
    """A million equally likely parts of the b = s / (1 - s) of each component."""
    components = np.array([0.01, 0.1, 0.5, 0.95])
    prior = SpikeAndSlab.build(
        spike=SPIKE, components=tuple(components), spread=SPREAD, dirichlet_strength=3.0, partial=1.0
    )
    parts = np.linspace(0, 1, 1_000_001)[1:]
    logs = np.log(components / (1 - components))
    for column, log in enumerate(logs):
        nearest = np.argmin(np.abs(np.log(parts)[:, None] + log - logs), axis=1)
        np.testing.assert_allclose(prior.border_kernel[:, column], np.bincount(nearest, minlength=4) / 1e6, atol=1e-5)


def test_weights_are_learned_through_the_border_kernel():
    """Half of the particles have all of an attachment of the third component, half a part of one: where EM converges,
    and the mean of the draws."""
    prior = SpikeAndSlab.build(
        spike=SPIKE, components=(0.01, 0.03, 0.1, 0.3), spread=0.1, dirichlet_strength=1.0, partial=0.5
    )
    count = np.rint(2000 * np.asarray(prior.border_kernel[:, 2])).astype(int)
    state = np.append(np.zeros(50, int), np.repeat(np.arange(4), count) + 1)
    s = jnp.asarray(np.append(0.0, [0.01, 0.03, 0.1, 0.3])[state])
    mixture, factor = posterior(prior, s, jnp.full(len(s), 1e-9), jnp.full(len(s), LOG_ODDS))
    learned = prior
    for _ in range(200):
        learned = learned_from(learned, mixture, factor)
    assert float(learned.weights[2]) > 0.98
    np.testing.assert_allclose(learned.share, prior.border_kernel[:, 2], atol=0.02)
    drawn, kept = prior, []
    for k in range(300):
        drawn = drawn_for(drawn, jnp.asarray(state), jax.random.key(k))
        kept.append(np.asarray(drawn.weights))
    np.testing.assert_allclose(np.mean(kept[100:], axis=0), learned.weights, atol=0.02)
