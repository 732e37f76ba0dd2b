"""Evidence of a model, ln int p(s) exp(-1/2 s^T Lambda s + eta^T s) ds, with the attachments integrated out.

Expectation propagation gives it with the sites of the belief [Minka 2001, arXiv:1301.2294; Rasmussen & Williams 2006,
eq. 3.65, ISBN 026218253X]: the Gaussian integral with all sites, and for each particle the ratio of its cavity's
integral under the prior to that under its site. The Ising prior enters by the Bethe approximation, which is exact on a
tree [Yedidia, Freeman & Weiss 2005, doi:10.1109/TIT.2005.850085]. Where sites and messages are at their fixed point, it
does not change to first order in them.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .attachment_belief import AttachmentBelief


@eqx.filter_jit
def log_evidence(belief: AttachmentBelief) -> Float[Array, ""]:
    """Return the logarithm of the integral of prior times evidence [nat], up to the constant of the Ising prior alone.

    That constant depends on the prior's numbers and the mesh, and not on the evidence.
    """
    prior, stiffness, message = belief.prior, belief.prior.stiffness, belief.message
    mean, variance = belief.cavity_of(belief.gaussian())
    log_odds = prior.log_odds + jnp.sum(message, axis=1)
    log_bayes_factor = stiffness.posterior(mean, variance, log_odds, prior.share)[1]
    free = stiffness.log_density_if_free(mean, variance)
    by_prior = free + jnp.logaddexp(0.0, log_odds + log_bayes_factor)
    # the cavity, a normal density, times the site
    with_site = 1 / (1 / variance + belief.site_precision)
    mean_with_site = with_site * (mean / variance + belief.site_shift)
    by_site = 0.5 * (jnp.log(with_site / variance) + mean_with_site**2 / with_site - mean**2 / variance)
    return _integral(belief) + jnp.sum(by_prior - by_site) - _pairs(belief, log_odds + log_bayes_factor)


def _integral(belief: AttachmentBelief) -> Float[Array, ""]:
    """Return the logarithm of the integral of evidence and sites."""
    information = belief.information
    factor = information.factor
    chi2 = information.shift @ jax.scipy.linalg.cho_solve((factor, True), information.shift)
    return 0.5 * (len(factor) * jnp.log(2 * jnp.pi) + chi2) - jnp.sum(jnp.log(jnp.diagonal(factor)))


def _pairs(belief: AttachmentBelief, log_odds: Float[Array, " n"]) -> Float[Array, ""]:
    """Return the sum over neighbouring particles of ln E[exp(J a_i a_j)], each by what it knows without the other."""
    prior = belief.prior
    alone = jax.nn.sigmoid(log_odds[:, None] - belief.message)
    padded = jnp.concatenate([alone, jnp.zeros((1, alone.shape[1]))])
    pairs = jnp.log1p(alone * padded[prior.neighbours, prior.back] * jnp.expm1(prior.coupling))
    return 0.5 * jnp.sum(jnp.where(prior.neighbours < len(alone), pairs, 0.0))
