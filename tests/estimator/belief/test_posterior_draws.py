"""Joint draws of the posterior of a row of particles."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import norm

from jiggle_mj.estimator.belief.attachment_prior import AttachmentPrior
from jiggle_mj.estimator.belief.gaussian_information import GaussianInformation
from jiggle_mj.estimator.belief.posterior_draws import posterior_draws
from jiggle_mj.estimator.belief.spike_and_slab import SpikeAndSlab

N, COUNT = 5, 2000
PROBABILITY_ERROR, MEAN_ERROR = 0.045, 0.1
"""Four standard errors of a probability by so many draws; the same of a mean, in standard deviations of s."""


def test_draws_follow_the_posterior_of_each_particle_and_of_what_two_share():
    """Without a coupling, particles that are seen one by one have closed forms: normals, of which the attached count by
    their mass above 0, as in the sampler. Of the first two only the sum is seen: it is known better than either."""
    stiffness = SpikeAndSlab.build(spike=3e-3, components=(0.03, 0.3), spread=0.3, dirichlet_strength=1e12, partial=0.0)
    edges = np.column_stack([np.arange(N - 1), np.arange(1, N)])
    prior = AttachmentPrior.build(N, edges, stiffness=stiffness, probability=0.4, coupling=0.0)
    seen, variance = np.array([0.02, 0.03, 0.25]), np.array([2e-4, 1e-4, 1e-3])
    precision = np.diag([1.0, 1.0, *(1 / variance)])
    precision[:2, :2] += 1e4
    shift = np.array([4e3, 4e3, *(seen / variance)])
    evidence = GaussianInformation(precision=jnp.asarray(precision), shift=jnp.asarray(shift))
    draws = np.asarray(posterior_draws(prior, evidence, jax.random.key(0), count=COUNT, thin=3))
    centre, width = np.asarray(stiffness.mean)[:, None], np.asarray(stiffness.sd)[:, None] ** 2
    narrow = 1 / (1 / variance + 1 / width)
    at = narrow * (seen / variance + centre / width)
    weight = norm.pdf(seen, centre, np.sqrt(variance + width)) * np.array([0.6, 0.2, 0.2])[:, None]
    weight[1:] *= norm.cdf(at[1:], 0, np.sqrt(narrow[1:]))
    weight /= weight.sum(axis=0)
    np.testing.assert_allclose((draws > 0).mean(axis=0)[2:], weight[1:].sum(axis=0), atol=PROBABILITY_ERROR)
    mean = np.sum(weight[1:] * at[1:], axis=0)
    np.testing.assert_allclose(draws.mean(axis=0)[2:], mean, atol=MEAN_ERROR * draws[:, 2:].std(axis=0).max())
    load = draws[:, 0] + draws[:, 1]
    assert abs(load.mean() - 0.4) < 0.02 and load.std() < 0.2 * draws[:, 0].std()
    assert draws.min() >= 0 and draws.max() <= 1
