"""One particle's bounded stiffness s in [0, 1]: free or attached a priori, and what a Gaussian measurement leaves.

The prior is a spike and a slab [Mitchell & Beauchamp 1988, doi:10.1080/01621459.1988.10478694]: free is a half-normal
too narrow to matter, attached a mixture of normals from soft to rigid, the rungs of a ladder, all cut off to [0, 1].
Times a Gaussian each part is a truncated normal, so that odds, moments and quantiles are closed forms. How often each
rung occurs is learned from the particles that are called attached: attachments of one tissue resemble each other, but
an attachment that ends between two particles leaves the one at its border any part of what others have.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr, logsumexp
from jax.scipy.stats import norm
from jaxtyping import Array, Float, Int, PRNGKeyArray

BISECTIONS = 50
RARE = 1e-12
"""Added to a drawn share, which may be too small for its logarithm."""
LEARNED = 0.2
"""Part of each step that the shares take: with all of it, a particle about even tips them, and they tip it back."""


class Mixture(eqx.Module):
    """Normals truncated to [0, 1]; the first is the spike."""

    weight: Float[Array, "c n"]
    """Sums to 1 over the parts."""
    mean: Float[Array, "c n"]
    """Of each normal before it is truncated."""
    sd: Float[Array, "c n"]

    @property
    def attached(self) -> Float[Array, " n"]:
        """Probability of the slab."""
        return jnp.sum(self.weight[1:], axis=0)

    def moments(self) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """Mean and variance."""
        below, above = -self.mean / self.sd, (1 - self.mean) / self.sd
        mass = _log_mass(below, above)
        at_zero, at_one = jnp.exp(norm.logpdf(below) - mass), jnp.exp(norm.logpdf(above) - mass)
        means = self.mean + self.sd * (at_zero - at_one)
        shares = 1 + below * at_zero - above * at_one - (at_zero - at_one) ** 2
        second = self.sd**2 * jnp.maximum(shares, 0) + means**2
        mean = jnp.sum(self.weight * means, axis=0)
        return mean, jnp.sum(self.weight * second, axis=0) - mean**2

    def quantile(self, probability: float) -> Float[Array, " n"]:
        """The s below which lies the given probability."""
        below = -self.mean / self.sd
        mass = _log_mass(below, (1 - self.mean) / self.sd)

        def halve(_, bounds):
            low, high = bounds
            middle = (low + high) / 2
            share = jnp.exp(_log_mass(below, (middle[None] - self.mean) / self.sd) - mass)
            less = jnp.sum(self.weight * share, axis=0) < probability
            return jnp.where(less, middle, low), jnp.where(less, high, middle)

        n = self.mean.shape[1]
        return jax.lax.fori_loop(0, BISECTIONS, halve, (jnp.zeros(n), jnp.ones(n)))[1]


class SpikeAndSlab(eqx.Module):
    """The prior."""

    mean: Float[Array, " c"]
    """Of each normal before it is cut off; 0 for the spike, the first."""
    sd: Float[Array, " c"]
    weights: Float[Array, " _components"]
    """Share of each rung among attachments before they are parted."""
    border_kernel: Float[Array, "_components _components"]
    """Share of each rung (row) among particles whose attachment, if they had all of it, were on another (column)."""
    dirichlet_strength: Float[Array, ""]
    """How many attached particles the even shares are worth, from which learning starts."""

    @classmethod
    def build(
        cls, *, spike: float, components: tuple[float, ...], spread: float, dirichlet_strength: float, partial: float
    ) -> "SpikeAndSlab":
        """For a spike of width `spike` and components at the given s, each as wide as `spread` times its s.

        `partial` is the share of attached particles that have a part, as likely any as another, of their attachment.
        """
        centre = jnp.asarray(components, dtype=float)
        return cls(
            mean=jnp.concatenate([jnp.zeros(1), centre]),
            sd=jnp.concatenate([jnp.full(1, spike), spread * centre]),
            weights=jnp.full(len(components), 1 / len(components)),
            border_kernel=(1 - partial) * jnp.eye(len(components))
            + partial * jnp.asarray(_parted(np.asarray(components))),
            dirichlet_strength=jnp.asarray(dirichlet_strength, dtype=float),
        )

    @property
    def share(self) -> Float[Array, " _components"]:
        """Of each rung among attached particles."""
        return self.border_kernel @ self.weights

    def learned(self, mixture: "Mixture", factor: Float[Array, " n"]) -> "SpikeAndSlab":
        """Shares moved towards those expected after counting the particles likelier attached than not.

        A damped step of expectation maximisation from a Dirichlet prior. Left out are doubtful particles, and those
        that only their neighbours speak for, not what was measured (`factor`, log Bayes factors): hundreds of them,
        each as well explained by a faint attachment as by none, would talk each other into it.
        """
        counted = (mixture.attached > 0.5) & (factor > 0)
        count = jnp.sum(jnp.where(counted, mixture.weight[1:], 0.0), axis=1)
        count = self.weights * (self.border_kernel.T @ (count / self.share))
        weights = (self.dirichlet_strength / len(count) + count) / (self.dirichlet_strength + jnp.sum(count))
        return eqx.tree_at(lambda prior: prior.weights, self, (1 - LEARNED) * self.weights + LEARNED * weights)

    def drawn(self, state: Int[Array, " n"], key: PRNGKeyArray) -> "SpikeAndSlab":
        """Shares drawn from what is known of them given each particle's state: 0 is free, k on the k-th rung."""
        by_part, by_share = jax.random.split(key)
        parted = jnp.log(self.weights)[None] + jnp.log(self.border_kernel[jnp.maximum(state - 1, 0)])
        of = jnp.where(state > 0, 1 + jax.random.categorical(by_part, parted, axis=1), 0)
        count = jnp.zeros(len(self.mean)).at[of].add(1.0)[1:]
        weights = jax.random.dirichlet(by_share, self.dirichlet_strength / len(count) + count) + RARE
        return eqx.tree_at(lambda prior: prior.weights, self, weights)

    def posterior(
        self, mean: Float[Array, " n"], variance: Float[Array, " n"], log_odds: Float[Array, " n"]
    ) -> tuple[Mixture, Float[Array, " n"]]:
        """After measurements of s, and the log Bayes factor of 'attached' against 'free'.

        Args:
            mean: measured s, anywhere.
            variance: of the measurements.
            log_odds: of 'attached' beforehand.
        """
        centre, width = self.mean[:, None], self.sd[:, None] ** 2
        mean, variance = mean[None], variance[None]
        narrowed = 1 / (1 / variance + 1 / width)
        parts = Mixture(weight=narrowed, mean=narrowed * (mean / variance + centre / width), sd=jnp.sqrt(narrowed))
        seen = norm.logpdf(mean, centre, jnp.sqrt(variance + width))
        evidence = seen + _cut_off(parts.mean, parts.sd) - _cut_off(centre, self.sd[:, None])
        components = evidence[1:] + jnp.log(self.share)[:, None]
        factor = logsumexp(components, axis=0) - evidence[0]
        attached = jax.nn.sigmoid(log_odds + factor)[None]
        weight = jnp.concatenate([1 - attached, attached * jax.nn.softmax(components, axis=0)])
        return eqx.tree_at(lambda parts: parts.weight, parts, weight), factor


def _parted(components: Float[np.ndarray, " r"]) -> Float[np.ndarray, "r r"]:
    """Probability of being nearest to each rung (row), in the logarithm of b, for any part of the b of another."""
    b = components / np.maximum(1 - components, 1e-9)
    between = np.concatenate([[0], np.sqrt(b[1:] * b[:-1]), [np.inf]])
    return np.diff(np.minimum(between[:, None] / b[None], 1), axis=0)


def _cut_off(mean: Float[Array, "c n"], sd: Float[Array, "c n"]) -> Float[Array, "c n"]:
    """Log of a normal's mass in [0, 1]."""
    return _log_mass(-mean / sd, (1 - mean) / sd)


def _log_mass(below: Float[Array, "c n"], above: Float[Array, "c n"]) -> Float[Array, "c n"]:
    """Log of the standard normal's mass between two numbers, also far out in either tail."""
    mirrored = below > 0
    low, high = jnp.where(mirrored, -above, below), jnp.where(mirrored, -below, above)
    log_high = log_ndtr(high)
    return log_high + jnp.log1p(-jnp.exp(jnp.minimum(log_ndtr(low) - log_high, -1e-300)))
