"""Gibbs sampler of which particles are attached, with all stiffnesses integrated out.

Each particle has a component: 0 is free, k is the k-th normal of the slab. Given the components of all particles the
bounded stiffnesses s are Gaussian, and the probability of the components is a closed form. A sweep draws the component
of each particle in turn, given those of all others, and then the weights of the components [collapsed Gibbs sampling
for a spike and a slab: George & McCulloch 1997, Statistica Sinica 7:339]. Unlike expectation propagation it does not
iterate to a fixed point, and it finds the likely particles also where several can bear one load.

To keep the form closed, the normals of the prior are not truncated to [0, 1]. Instead, the component of the particle
that is drawn counts by the probability that its s lies above 0: a model with errors may ask for s < 0, which the widest
component would explain best.

Nothing that other particles depend on changes between two changes of a component. So the next few particles are drawn
together, and a sweep costs one rank-one update of the covariance for each change. Several updates are applied at once.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import log_ndtr
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from .attachment_prior import AttachmentPrior
from .config import SamplerConfig
from .gaussian_information import GaussianInformation
from .spike_and_slab import SpikeAndSlab

MIN_PRECISION = 1e-8
"""Smallest precision of the evidence about one particle's s, where rounding could make it negative; s is in [0, 1]."""


class PosteriorSamples(eqx.Module):
    """Averages over sweeps of the sampler."""

    probability: Float[Array, "c n"]
    """Probability of each component of each particle; 0 is free."""
    mean: Float[Array, " n"]
    """Mean of s."""
    variance: Float[Array, " n"]
    """Variance of s."""
    weights: Float[Array, " _components"]
    """Mean of `SpikeAndSlab.weights`."""
    agree: Bool[Array, ""]
    """Whether P(attached) of both halves of the sweeps agree within `SamplerConfig.agreement`."""


class Moments(eqx.Module):
    """Mean and covariance of s given the components."""

    mean: Float[Array, " n"]
    covariance: Float[Array, "n n"]


class Sampler(eqx.Module):
    """Sampler of the posterior of a prior and Gaussian evidence."""

    prior: AttachmentPrior
    precision: Float[Array, "n n"]
    """Precision of the evidence about s."""
    shift: Float[Array, " n"]
    """Precision times mean of the evidence about s."""
    config: SamplerConfig = eqx.field(static=True, default_factory=SamplerConfig)

    def run(
        self,
        component: Int[Array, " n"],
        key: PRNGKeyArray,
        *,
        burn_in: int,
        rounds: int | Int[Array, ""],
        doublings: int | Int[Array, ""] = 1,
    ) -> PosteriorSamples:
        """Average sweeps of a chain until its two halves agree.

        The chain runs `burn_in` rounds, which do not count, then `rounds`, then as many again as have counted so far,
        and so on. Each time the old and the new half are compared. A round is `SamplerConfig.sweeps_per_round` sweeps.

        Args:
            component: where the chain begins.
            key: its random numbers.
            burn_in: rounds that do not count.
            rounds: rounds of the first part that counts.
            doublings: most times that the number of rounds is doubled.
        """
        rounds, per_round = jnp.asarray(rounds), self.config.sweeps_per_round

        def sweep(k, state):
            component, moments, stiffness, sums = state
            by_component, by_weights = jax.random.split(jax.random.fold_in(key, k))
            component, moments, probability = self.sweep(component, moments, stiffness, by_component)
            stiffness, mean = stiffness.drawn(component, by_weights), moments.mean
            squared = jnp.diagonal(moments.covariance) + mean**2
            sums = jax.tree.map(
                jnp.add, sums, Sums(probability=probability, mean=mean, squared=squared, weights=stiffness.weights)
            )
            return component, moments, stiffness, sums

        def round(k, state):
            component, *others = state
            first = component, self.moments(component), *others
            component, _, *others = jax.lax.fori_loop(k * per_round, (k + 1) * per_round, sweep, first)
            return component, *others

        def extend(state):
            component, stiffness, sums, done, part, _ = state
            count = jnp.where(part == 0, burn_in, rounds * 2 ** jnp.maximum(part - 2, 0))
            component, stiffness, new = jax.lax.fori_loop(done, done + count, round, (component, stiffness, zero))
            difference = jnp.mean(jnp.abs(sums.attached - new.attached))
            sums = jax.tree.map(lambda old, added: jnp.where(part == 0, 0.0, old + added), sums, new)
            agree = (part > 1) & (difference < self.config.agreement)
            return component, stiffness, sums, done + count, part + 1, agree

        def unfinished(state):
            part, agree = state[4:]
            return (part < 2 + doublings) & ~agree

        stiffness = self.prior.stiffness
        zero = Sums.zero(len(stiffness.mean), len(component))
        first = component, stiffness, zero, jnp.asarray(0), jnp.asarray(0), jnp.asarray(False)
        _, _, sums, _, _, agree = jax.lax.while_loop(unfinished, extend, first)
        sweeps = jnp.sum(sums.probability[:, 0])
        mean = sums.mean / sweeps
        return PosteriorSamples(
            probability=sums.probability / jnp.sum(sums.probability, axis=0)[None],
            mean=mean,
            variance=sums.squared / sweeps - mean**2,
            weights=sums.weights / sweeps,
            agree=agree,
        )

    def mode(self, component: Int[Array, " n"], key: PRNGKeyArray) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
        """Return components at a local mode of their joint posterior, and the mean of s given them.

        Iterated conditional modes [Besag 1986, JRSS B 48:259] from the given components, with the weights of the prior:
        no other component of a single particle is likelier. `SamplerConfig.sweeps_per_round` sweeps at most.
        """
        stiffness = self.prior.stiffness

        def sweep(state):
            before, moments, count, _ = state
            by_order = jax.random.fold_in(key, count)
            component, moments, _ = self.sweep(before, moments, stiffness, by_order, likeliest=True)
            return component, moments, count + 1, jnp.any(component != before)

        def changing(state):
            return state[-1] & (state[2] < self.config.sweeps_per_round)

        first = component, self.moments(component), jnp.asarray(0), jnp.asarray(True)
        component, *_ = jax.lax.while_loop(changing, sweep, first)
        return component, self.moments(component).mean

    def moments(self, component: Int[Array, " n"]) -> Moments:
        """Return mean and covariance of s given the components, by one factorisation."""
        precision, shift = self._normals
        given = GaussianInformation(self.precision + jnp.diag(precision[component]), self.shift + shift[component])
        covariance = jnp.asarray(given.covariance())
        return Moments(mean=covariance @ jnp.asarray(given.shift), covariance=covariance)

    @property
    def _normals(self) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
        """Return precision and shift of each of the prior's normals."""
        return self.prior.stiffness.sd**-2, self.prior.stiffness.mean * self.prior.stiffness.sd**-2

    def sweep(
        self,
        component: Int[Array, " n"],
        moments: Moments,
        stiffness: SpikeAndSlab,
        key: PRNGKeyArray,
        *,
        likeliest: bool = False,
    ) -> tuple[Int[Array, " n"], Moments, Float[Array, "c n"]]:
        """Draw the component of every particle once, in random order.

        Args:
            component: that of each particle before.
            moments: `moments` of these components.
            stiffness: prior of s, with the weights of the whole sheet as drawn last.
            key: random numbers of the order and the draws.
            likeliest: take the likeliest component of each particle instead of a draw.

        Returns:
            The components, their moments, and the probabilities from which each was drawn.
        """
        n, c = len(component), len(self.prior.stiffness.mean)
        by_order, by_noise = jax.random.split(key)
        order, noise = jnp.argsort(jax.random.permutation(by_order, n)), jax.random.gumbel(by_noise, (c, n))
        noise = jnp.zeros_like(noise) if likeliest else noise
        change = self._change(jnp.append(order, jnp.full(self.config.candidates, n)), noise, stiffness)

        def batch(state):
            component, moments, probability, position = state
            pending = Pending.none(moments.covariance, self.config.pending_updates)
            first = component, moments.mean, jnp.diagonal(moments.covariance), pending, probability, position
            has_room = lambda state: (state[-1] < n) & (state[3].count < self.config.pending_updates)  # noqa: E731
            component, mean, _, pending, probability, position = jax.lax.while_loop(has_room, change, first)
            return component, Moments(mean=mean, covariance=pending.applied()), probability, position

        first = component, moments, jnp.zeros((c, n)), jnp.asarray(0)
        return jax.lax.while_loop(lambda state: state[-1] < n, batch, first)[:3]

    def _change(self, order: Int[Array, " _padded"], noise: Float[Array, "c n"], stiffness: SpikeAndSlab) -> Callable:
        """Return the step of a sweep: draw particles up to and including the next one that changes its component.

        Args:
            order: particles in the order of the sweep, padded with n.
            noise: Gumbel noise of each draw; 0 takes the likeliest.
            stiffness: prior of s, with the weights of the whole sheet as drawn last.
        """
        n, candidates = noise.shape[1], self.config.candidates
        centre, width = self.prior.stiffness.mean[:, None], self.prior.stiffness.sd[:, None] ** 2
        precision, shift = self._normals
        prior = eqx.tree_at(lambda prior: prior.stiffness, self.prior, stiffness)
        source = jnp.pad(stiffness.source, ((0, 0), (1, 0)))

        def change(state):
            component, mean, variance, pending, probability, position = state
            drawn_now = jax.lax.dynamic_slice(order, (position,), (candidates,))
            i = jnp.minimum(drawn_now, n - 1)
            old = component[i]
            cavity_variance = 1 / jnp.maximum(1 / variance[i] - precision[old], MIN_PRECISION)[None]
            cavity_mean = cavity_variance * (mean[i] / variance[i] - shift[old])[None]
            total = cavity_variance + width
            posterior_ratio = (cavity_mean * width + centre * cavity_variance) / jnp.sqrt(
                total * cavity_variance * width
            )
            log_above_zero = log_ndtr(posterior_ratio[1:])
            beside = jnp.sum(source[:, jnp.append(component, 0)[prior.neighbours[i]]], axis=2)
            share, attached_neighbours = prior.share_among(beside), jnp.sum(beside, axis=0)
            log_odds = prior.log_odds[i] + prior.coupling * attached_neighbours
            log_likelihood = -0.5 * (cavity_mean - centre) ** 2 / total - 0.5 * jnp.log(total)
            log_weight = log_likelihood.at[1:].add(jnp.log(share) + log_odds[None] + log_above_zero)
            drawn = jnp.argmax(log_weight + noise[:, i], axis=0)
            changes = (drawn != old) & (drawn_now < n)
            last = jnp.where(jnp.any(changes), jnp.argmax(changes), candidates - 1)
            done = jnp.where(jnp.arange(candidates) <= last, drawn_now, n)
            probability = probability.at[:, done].set(jax.nn.softmax(log_weight, axis=0), mode="drop")
            changed = i[last]
            new = jnp.where(changes[last], drawn[last], component[changed])
            added_precision = precision[new] - precision[component[changed]]
            added_shift = shift[new] - shift[component[changed]]
            column = pending.column(changed)
            factor = 1 / (1 + added_precision * column[changed])
            mean = mean + factor * (added_shift - added_precision * mean[changed]) * column
            variance = variance - factor * added_precision * column**2
            pending = pending.add(factor * added_precision, column, changes[last])
            return component.at[changed].set(new), mean, variance, pending, probability, position + last + 1

        return change


class Sums(eqx.Module):
    """Sums over sweeps of what `PosteriorSamples` averages."""

    probability: Float[Array, "c n"]
    mean: Float[Array, " n"]
    squared: Float[Array, " n"]
    weights: Float[Array, " _components"]

    @classmethod
    def zero(cls, c: int, n: int) -> "Sums":
        """Return the sums over no sweep, for n particles with c components."""
        return cls(probability=jnp.zeros((c, n)), mean=jnp.zeros(n), squared=jnp.zeros(n), weights=jnp.zeros(c - 1))

    @property
    def attached(self) -> Float[Array, " n"]:
        """Return the mean of P(attached) of each particle; 1 over no sweep."""
        return 1 - self.probability[0] / jnp.maximum(jnp.sum(self.probability, axis=0), 1)


class Pending(eqx.Module):
    """Covariance with rank-one updates that are not applied to it yet."""

    covariance: Float[Array, "n n"]
    columns: Float[Array, "_k n"]
    factors: Float[Array, " _k"]
    count: Int[Array, ""]

    @classmethod
    def none(cls, covariance: Float[Array, "n n"], size: int) -> "Pending":
        """Return a covariance without updates, with room for `size` of them."""
        columns = jnp.zeros((size, len(covariance)))
        return cls(covariance=covariance, columns=columns, factors=jnp.zeros(size), count=jnp.asarray(0))

    def column(self, i: Int[Array, ""]) -> Float[Array, " n"]:
        """Return the i-th column of the updated covariance."""
        return self.covariance[i] - (self.factors * self.columns[:, i]) @ self.columns

    def add(self, factor: Float[Array, ""], column: Float[Array, " n"], counts: Bool[Array, ""]) -> "Pending":
        """Subtract factor * column column^T; where it does not count, factor is 0 and the next update replaces it."""
        return Pending(
            covariance=self.covariance,
            columns=self.columns.at[self.count].set(column),
            factors=self.factors.at[self.count].set(factor),
            count=self.count + counts.astype(self.count.dtype),
        )

    def applied(self) -> Float[Array, "n n"]:
        """Return the updated covariance."""
        return self.covariance - (self.factors[:, None] * self.columns).T @ self.columns
