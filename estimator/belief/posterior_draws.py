"""Joint draws of all attachments from the posterior, as calibration and predictions of whole sheets need them.

`Sampler.run` averages over its sweeps; here a chain of the sampler stops now and then, far enough apart that the draws
are nearly independent. Given the components, s is normal.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from .attachment_prior import AttachmentPrior
from .attachment_sampler import Chain, Sampler, advanced
from .gaussian_information import GaussianInformation

BURN_IN = 100
"""Sweeps before the first draw, from the chain's begin with all particles free."""


@eqx.filter_jit
def posterior_draws(
    prior: AttachmentPrior, evidence: GaussianInformation, key: PRNGKeyArray, *, count: int, thin: int
) -> Float[Array, "_count n"]:
    """Return draws of s; 0 where a particle is free, and within [0, 1] where it is attached.

    Args:
        prior: of the attachments.
        evidence: about s.
        key: random numbers of a chain that begins with all particles free.
        count: number of draws.
        thin: sweeps from one draw to the next.
    """
    precision, shift = jnp.asarray(evidence.precision), jnp.asarray(evidence.shift)
    sampler, normals = Sampler.build(prior, precision, shift), prior.stiffness
    number, none = jnp.asarray(0), jnp.asarray(0)

    def draw(chain: Chain, key: PRNGKeyArray) -> tuple[Chain, Float[Array, " n"]]:
        by_sweeps, by_noise = jax.random.split(key)
        chain = advanced(sampler, chain, number, by_sweeps, jnp.asarray(thin), none)
        width, mean = normals.sd[chain.component] ** -2, normals.mean[chain.component]
        given = GaussianInformation(precision=precision + jnp.diag(width), shift=shift + width * mean)
        s = jnp.asarray(given.sample(jax.random.normal(by_noise, shift.shape)))
        return chain, jnp.where(chain.component > 0, jnp.clip(s, 0, 1), 0.0)

    by_burn_in, by_draws = jax.random.split(key)
    first = advanced(sampler, sampler.start(jnp.zeros(len(shift), int)), number, by_burn_in, jnp.asarray(BURN_IN), none)
    return jax.lax.scan(draw, first, jax.random.split(by_draws, count))[1]
