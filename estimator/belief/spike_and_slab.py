"""Prior of one particle's bounded stiffness s in [0, 1], free or attached, and its posterior after a measurement.

The prior is a spike and a slab [Mitchell & Beauchamp 1988, doi:10.1080/01621459.1988.10478694]. Free is a half-normal
so narrow that its width does not matter. Attached is a mixture of normals from soft to rigid, the components. All are
truncated to [0, 1]. The product of each with a Gaussian measurement is a truncated normal too, so odds, moments and
quantiles are closed forms.

The weights of the components are learned from the particles that are called attached, as attachments of one tissue
resemble each other; `attachment_prior` has how those of one particle follow its neighbours. An attachment that ends
between two particles leaves the one at its border any part of the stiffness that the others have;
`SpikeAndSlab.border_kernel` is the distribution of that part.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import log_ndtr, logsumexp
from jax.scipy.stats import norm
from jaxtyping import Array, Float, Int, PRNGKeyArray

QUANTILE_BISECTIONS = 50
"""Halvings of [0, 1] by which a quantile is found: 2^-50 is below 1e-15."""
MIN_WEIGHT = 1e-12
"""Added to a drawn weight, so that its logarithm stays finite."""
MAX_LOG_RATIO = -1e-300
"""Largest logarithm of a ratio of two tail masses, so that the logarithm of their difference stays finite."""
MIN_COMPLEMENT = 1e-9
"""Smallest 1 - s of a component, so that its stiffness b = s / (1 - s) stays finite where s = 1."""


class Mixture(eqx.Module):
    """Mixture of normals truncated to [0, 1] for each particle; the first is the spike."""

    weight: Float[Array, "c n"]
    """Probability of each component; sums to 1 over the components."""
    mean: Float[Array, "c n"]
    """Mean of each normal before it is truncated."""
    sd: Float[Array, "c n"]
    """Standard deviation of each normal before it is truncated."""

    @property
    def attached(self) -> Float[Array, " n"]:
        """Return the probability of the slab."""
        return jnp.sum(self.weight[1:], axis=0)

    def moments(self) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """Return mean and variance of s."""
        below, above = -self.mean / self.sd, (1 - self.mean) / self.sd
        mass = _log_mass(below, above)
        at_zero, at_one = jnp.exp(norm.logpdf(below) - mass), jnp.exp(norm.logpdf(above) - mass)
        means = self.mean + self.sd * (at_zero - at_one)
        variance_ratio = 1 + below * at_zero - above * at_one - (at_zero - at_one) ** 2
        second = self.sd**2 * jnp.maximum(variance_ratio, 0) + means**2
        mean = jnp.sum(self.weight * means, axis=0)
        return mean, jnp.sum(self.weight * second, axis=0) - mean**2

    def quantile(self, probability: float) -> Float[Array, " n"]:
        """Return the s below which the given probability lies."""
        below = -self.mean / self.sd
        mass = _log_mass(below, (1 - self.mean) / self.sd)

        def halve(_, bounds):
            low, high = bounds
            middle = (low + high) / 2
            cumulative = jnp.exp(_log_mass(below, (middle[None] - self.mean) / self.sd) - mass)
            less = jnp.sum(self.weight * cumulative, axis=0) < probability
            return jnp.where(less, middle, low), jnp.where(less, high, middle)

        n = self.mean.shape[1]
        return jax.lax.fori_loop(0, QUANTILE_BISECTIONS, halve, (jnp.zeros(n), jnp.ones(n)))[1]


class SpikeAndSlab(eqx.Module):
    """Prior of s, the same for all particles: a spike for free, and components of the slab for attached."""

    mean: Float[Array, " c"]
    """Mean of each normal before it is truncated; 0 for the spike, the first."""
    sd: Float[Array, " c"]
    """Standard deviation of each normal before it is truncated."""
    weights: Float[Array, " _components"]
    """Probability of each component of a particle with all of its attachment."""
    border_kernel: Float[Array, "_components _components"]
    """Probability of a component (row) of a particle that with all of its attachment would have another (column)."""
    dirichlet_strength: Float[Array, ""]
    """Strength of the Dirichlet prior of the weights, in attached particles; its mean has equal weights."""

    @classmethod
    def build(
        cls, *, spike: float, components: tuple[float, ...], spread: float, dirichlet_strength: float, partial: float
    ) -> "SpikeAndSlab":
        """Return the prior with equal weights.

        Args:
            spike: standard deviation of s of a free particle.
            components: s at the centre of each component of the slab, in ascending order.
            spread: standard deviation of a component over its s.
            dirichlet_strength: attached particles that the equal weights are worth.
            partial: share of attached particles with a part of their attachment, uniform in (0, 1].
        """
        centre = jnp.asarray(components, dtype=float)
        return cls(
            mean=jnp.concatenate([jnp.zeros(1), centre]),
            sd=jnp.concatenate([jnp.full(1, spike), spread * centre]),
            weights=jnp.full(len(components), 1 / len(components)),
            border_kernel=(1 - partial) * jnp.eye(len(components))
            + partial * jnp.asarray(_nearest_component(np.asarray(components))),
            dirichlet_strength=jnp.asarray(dirichlet_strength, dtype=float),
        )

    @property
    def spike(self) -> Float[Array, ""]:
        """Return the width of s where a particle is free."""
        return self.sd[0]

    @property
    def spread(self) -> Float[Array, ""]:
        """Return the relative width of each component."""
        return self.sd[1] / self.mean[1]

    @property
    def share(self) -> Float[Array, " _components"]:
        """Return the probability of each component of an attached particle."""
        return self.border_kernel @ self.weights

    @property
    def source(self) -> Float[Array, "_components _components"]:
        """Return the probability of each component with all of the attachment (row), given the particle's (column)."""
        return self.weights[:, None] * self.border_kernel.T / self.share[None]

    def learned(self, mixture: Mixture, log_bayes_factor: Float[Array, " n"], *, rate: float) -> "SpikeAndSlab":
        """Update the weights by a damped step of expectation maximisation with a Dirichlet prior.

        Only particles that are likelier attached than free count, and of those only the ones whose measurement favours
        attached: hundreds of particles that a weak attachment explains as well as none would otherwise raise each
        other's probability through their neighbours.

        Args:
            mixture: posterior of each particle.
            log_bayes_factor: for attached against free, by its measurement alone.
            rate: share of the step that is taken.
        """
        counted = (mixture.attached > 0.5) & (log_bayes_factor > 0)
        count = jnp.sum(jnp.where(counted, mixture.weight[1:], 0.0), axis=1)
        count = self.source @ count
        weights = (self.dirichlet_strength / len(count) + count) / (self.dirichlet_strength + jnp.sum(count))
        return eqx.tree_at(lambda prior: prior.weights, self, (1 - rate) * self.weights + rate * weights)

    def drawn(self, component: Int[Array, " n"], key: PRNGKeyArray) -> "SpikeAndSlab":
        """Draw the weights from their posterior given the component of each particle: 0 is free, k the k-th."""
        by_source, by_weights = jax.random.split(key)
        log_source = jnp.log(self.weights)[None] + jnp.log(self.border_kernel[jnp.maximum(component - 1, 0)])
        source = jnp.where(component > 0, 1 + jax.random.categorical(by_source, log_source, axis=1), 0)
        count = jnp.zeros(len(self.mean)).at[source].add(1.0)[1:]
        weights = jax.random.dirichlet(by_weights, self.dirichlet_strength / len(count) + count) + MIN_WEIGHT
        return eqx.tree_at(lambda prior: prior.weights, self, weights)

    def posterior(
        self,
        mean: Float[Array, " n"],
        variance: Float[Array, " n"],
        log_odds: Float[Array, " n"],
        share: Float[Array, "_components n"] | None = None,
    ) -> tuple[Mixture, Float[Array, " n"]]:
        """Return the posterior after a measurement of each s, and the log Bayes factor of attached against free.

        Args:
            mean: measured s, which may lie outside of [0, 1].
            variance: variance of the measurement.
            log_odds: log odds of attached before it.
            share: probability of each component of each particle if it is attached, before it; None for `share`.
        """
        combined, evidence = self._combined(mean, variance)
        components = evidence[1:] + jnp.log(self.share[:, None] if share is None else share)
        log_bayes_factor = logsumexp(components, axis=0) - evidence[0]
        attached = jax.nn.sigmoid(log_odds + log_bayes_factor)[None]
        weight = jnp.concatenate([1 - attached, attached * jax.nn.softmax(components, axis=0)])
        return eqx.tree_at(lambda parts: parts.weight, combined, weight), log_bayes_factor

    def log_density_if_free(self, mean: Float[Array, " n"], variance: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return the log density of a measurement of each s if the particle is free, arguments as in `posterior`."""
        return self._combined(mean, variance)[1][0]

    def _combined(self, mean: Float[Array, " n"], variance: Float[Array, " n"]) -> tuple[Mixture, Float[Array, "c n"]]:
        """Return each component times the measurement, with any weights, and the measurement's log density by each."""
        centre, width = self.mean[:, None], self.sd[:, None] ** 2
        mean, variance = mean[None], variance[None]
        combined = 1 / (1 / variance + 1 / width)
        parts = Mixture(weight=combined, mean=combined * (mean / variance + centre / width), sd=jnp.sqrt(combined))
        inside = _log_mass_inside(parts.mean, parts.sd) - _log_mass_inside(centre, self.sd[:, None])
        return parts, norm.logpdf(mean, centre, jnp.sqrt(variance + width)) + inside


def _nearest_component(components: Float[np.ndarray, " r"]) -> Float[np.ndarray, "r r"]:
    """Return the probability that a uniform part of one component's b (column) is nearest in ln b to another (row)."""
    b = components / np.maximum(1 - components, MIN_COMPLEMENT)
    between = np.concatenate([[0], np.sqrt(b[1:] * b[:-1]), [np.inf]])
    return np.diff(np.minimum(between[:, None] / b[None], 1), axis=0)


def _log_mass_inside(mean: Float[Array, "c n"], sd: Float[Array, "c n"]) -> Float[Array, "c n"]:
    """Return the logarithm of a normal's mass in [0, 1]."""
    return _log_mass(-mean / sd, (1 - mean) / sd)


def _log_mass(below: Float[Array, "c n"], above: Float[Array, "c n"]) -> Float[Array, "c n"]:
    """Return the logarithm of the standard normal's mass between two numbers, also far out in either tail."""
    mirrored = below > 0
    low, high = jnp.where(mirrored, -above, below), jnp.where(mirrored, -below, above)
    log_high = log_ndtr(high)
    return log_high + jnp.log1p(-jnp.exp(jnp.minimum(log_ndtr(low) - log_high, MAX_LOG_RATIO)))
