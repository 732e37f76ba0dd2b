"""Joint draws of all attachments from the posterior, as calibration and predictions of whole sheets need them.

`Sampler.run` averages over its sweeps; here single sweeps of the same chain are kept, far enough apart that they are
nearly independent. Given the components, s is normal.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from .attachment_sampler import Sampler

BURN_IN = 100
"""Sweeps before the first draw; a release burns in 30, from the likeliest component of each particle."""


@eqx.filter_jit
def posterior_draws(sampler: Sampler, key: PRNGKeyArray, *, count: int, thin: int) -> Float[Array, "_count n"]:
    """Return draws of s; 0 where a particle is free, and within [0, 1] where it is attached.

    Args:
        sampler: of the posterior.
        key: random numbers of a chain that begins with all particles free.
        count: number of draws.
        thin: sweeps from one draw to the next.
    """
    n = len(sampler.shift)

    def sweep(k, state):
        component, moments, stiffness, key = state
        by_component, by_weights = jax.random.split(jax.random.fold_in(key, k))
        component, moments, _ = sampler.sweep(component, moments, stiffness, by_component)
        return component, moments, stiffness.drawn(component, by_weights), key

    def swept(component, stiffness, key, sweeps):
        state = component, sampler.moments(component), stiffness, key
        return jax.lax.fori_loop(0, sweeps, sweep, state)

    def draw(state, key):
        component, stiffness = state
        by_sweeps, by_noise = jax.random.split(key)
        component, _, stiffness, _ = swept(component, stiffness, by_sweeps, thin)
        moments = sampler.moments(component)
        factor = jnp.linalg.cholesky(moments.covariance)
        s = moments.mean + factor @ jax.random.normal(by_noise, (n,))
        return (component, stiffness), jnp.where(component > 0, jnp.clip(s, 0, 1), 0.0)

    by_burn_in, by_draws = jax.random.split(key)
    component, _, stiffness, _ = swept(jnp.zeros(n, int), sampler.prior.stiffness, by_burn_in, BURN_IN)
    return jax.lax.scan(draw, (component, stiffness), jax.random.split(by_draws, count))[1]
