"""Marginal posterior of each particle, as filters and plans read it."""

import equinox as eqx
from jaxtyping import Array, Float

MAX_MEAN = 0.999
"""Largest mean of s that is reported, as s = 1 is infinitely stiff; 999 b_ref [N/m]."""


class Posterior(eqx.Module):
    """Marginal posterior of each particle."""

    mean: Float[Array, " n"]
    """Mean of s, in [0, MAX_MEAN]."""
    sd: Float[Array, " n"]
    """Standard deviation of s."""
    stiffness: Float[Array, " n"]
    """Stiffness b at the mean of s [N/m]."""
    stiffness_sd: Float[Array, " n"]
    """Standard deviation of b, with b linearised at the mean of s [N/m]."""
    attached: Float[Array, " n"]
    """Probability of being attached."""
    entropy: Float[Array, ""]
    """Differential entropy of the Gaussian over all s [nat]."""
