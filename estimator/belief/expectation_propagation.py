"""One step of expectation propagation and of belief propagation, for all particles at once.

Each particle's prior is replaced by a Gaussian factor, its site [Minka 2001, arXiv:1301.2294]. The Gaussian over all s
without a particle's own site is its cavity; the particle's posterior is its prior times its cavity; its site is set so
that the Gaussian has the mean and variance of that posterior. Neighbours exchange log odds of being attached.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .attachment_prior import AttachmentPrior
from .gaussian_information import Gaussian, GaussianInformation
from .spike_and_slab import Mixture

NO_EVIDENCE_VARIANCE = 1e8
"""Variance of s that stands for no evidence; s itself is in [0, 1]."""
MIN_SITE_PRECISION, MAX_SITE_PRECISION = 1e-2, 1e14
"""Range of a site's precision. Where free and attached are about equally likely, a particle's own variance exceeds that
of the evidence. Only a negative site precision could express that, and the total precision might lose definiteness."""
MIN_SAMPLED_PROBABILITY = 1e-9
"""Smallest distance of a sampled probability from 0 and 1, so that its log odds stay finite."""
MAX_VARIANCE_STEPS = 10
"""Most fixed-point steps towards the site precisions that give the sampled variances."""
SITE_CHANGE = 0.05
"""Relative change of every site's precision below which they end: samples err by 0.1. Three or four steps are usual."""


def cavity(
    gaussian: Gaussian, site_precision: Float[Array, " n"], site_shift: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Return mean and variance of each particle's s without its own site."""
    precision = jnp.maximum(1 / gaussian.variance - site_precision, 1 / NO_EVIDENCE_VARIANCE)
    return (gaussian.mean / gaussian.variance - site_shift) / precision, 1 / precision


def matching_sites(
    posterior: Mixture, mean: Float[Array, " n"], variance: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Return precision and shift of the sites that give each posterior's moments.

    Args:
        posterior: each particle's own.
        mean: mean of its cavity.
        variance: variance of its cavity.
    """
    own_mean, own_variance = posterior.moments()
    precision = jnp.clip(1 / own_variance - 1 / variance, MIN_SITE_PRECISION, MAX_SITE_PRECISION)
    return precision, own_mean * (precision + 1 / variance) - mean / variance


def passed_messages(
    prior: AttachmentPrior, log_odds: Float[Array, " n"], message: Float[Array, "n d"]
) -> Float[Array, "n d"]:
    """Return the log odds that each neighbour adds: by all that it knows except the message of the receiver.

    Args:
        prior: whose neighbours exchange messages.
        log_odds: log odds of each particle, by all that it knows.
        message: what each neighbour added to them.
    """
    others = log_odds[:, None] - message
    sent = jnp.log1p(jax.nn.sigmoid(others) * jnp.expm1(prior.coupling))
    sent = jnp.concatenate([sent, jnp.zeros((1, sent.shape[1]), sent.dtype)])
    return sent[prior.neighbours, prior.back]


def sites_with_variance(evidence_precision: Float[Array, "n n"], variance: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return the site precisions that give each s a variance, as nearly as their range allows."""

    def step(state):
        sites, _, count = state
        found = GaussianInformation(evidence_precision + jnp.diag(sites), jnp.zeros_like(sites)).variances()
        after = jnp.clip(sites + 1 / variance - 1 / found, MIN_SITE_PRECISION, MAX_SITE_PRECISION)
        return after, jnp.any(jnp.abs(after - sites) > SITE_CHANGE * sites), count + 1

    def changing(state):
        return state[1] & (state[2] < MAX_VARIANCE_STEPS)

    first = jnp.clip(1 / variance, MIN_SITE_PRECISION, MAX_SITE_PRECISION)
    return jax.lax.while_loop(changing, step, (first, jnp.asarray(True), jnp.asarray(0)))[0]


def messages_with_probability(
    prior: AttachmentPrior, free: Float[Array, " n"], log_bayes_factor: Float[Array, " n"]
) -> Float[Array, "n d"]:
    """Return messages, equal for all neighbours of a particle, that give it a probability of being free.

    Args:
        prior: whose neighbours exchange messages.
        free: P(free).
        log_bayes_factor: for attached, by the evidence alone.
    """
    is_neighbour = prior.neighbours < len(free)
    free = jnp.clip(free, MIN_SAMPLED_PROBABILITY, 1 - MIN_SAMPLED_PROBABILITY)
    log_odds = jnp.log1p(-free) - jnp.log(free)
    count = jnp.maximum(jnp.sum(is_neighbour, axis=1), 1).astype(log_odds.dtype)
    message = (log_odds - log_bayes_factor - prior.log_odds) / count
    return jnp.where(is_neighbour, message[:, None], 0.0)
