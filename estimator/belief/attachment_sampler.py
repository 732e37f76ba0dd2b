"""Gibbs sampler of which particles are attached, with all stiffnesses integrated out.

Each particle has a component: 0 is free, k is the k-th normal of the slab. Given the components of all particles the
bounded stiffnesses s are Gaussian (`dual_gaussian`), and the probability of the components is a closed form. A sweep
draws the component of each particle in turn, given those of all others, and then the weights of the components
[collapsed Gibbs sampling for a spike and a slab: George & McCulloch 1997, Statistica Sinica 7:339]. Unlike expectation
propagation it does not iterate to a fixed point, and it finds the likely particles also where several can bear a load.

Several chains run side by side, on all cores. A chain may continue where it ended after the frame before: one frame
changes the posterior little, so that a few sweeps suffice.

To keep the form closed, the normals of the prior are not truncated to [0, 1]. Instead, the component of the particle
that is drawn counts by the probability that its s lies above 0: a model with errors may ask for s < 0, which the widest
component would explain best.

Nothing that other particles depend on changes between two changes of a component. So the next few particles are drawn
together. Their log probabilities are computed in single precision, which errs by 1e-6 of their size, the Gaussian in
double precision.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import log_ndtr
from jaxtyping import Array, Float, Int, PRNGKeyArray

from ..parallel_map import parallel_map
from .attachment_prior import AttachmentPrior
from .config import SamplerConfig
from .dual_gaussian import Cavity, DualGaussian
from .spike_and_slab import SpikeAndSlab

MAX_MODE_SWEEPS = 10
"""Most sweeps of the search for a mode; it ends by itself after three or four."""


class Sums(eqx.Module):
    """Sums over sweeps of what is averaged, each the expectation given the components of all other particles."""

    probability: Float[Array, "c n"]
    """Probability of each component of each particle; 0 is free."""
    mean: Float[Array, " n"]
    """Mean of s."""
    squared: Float[Array, " n"]
    """Mean of the square of s."""
    weights: Float[Array, " _components"]
    """Component weights, as `SpikeAndSlab.weights`."""

    @classmethod
    def zero(cls, c: int, n: int) -> "Sums":
        """Return the sums over no sweep, for n particles with c components."""
        return cls(probability=jnp.zeros((c, n)), mean=jnp.zeros(n), squared=jnp.zeros(n), weights=jnp.zeros(c - 1))

    def __add__(self, other: "Sums") -> "Sums":
        """Return the sums over the sweeps of both."""
        return jax.tree.map(jnp.add, self, other)

    @property
    def attached(self) -> Float[Array, " n"]:
        """Return the mean of P(attached) of each particle."""
        return 1 - self.probability[0] / jnp.sum(self.probability, axis=0)


class Chain(eqx.Module):
    """One chain: where it is, and what it has summed so far."""

    component: Int[Array, " n"]
    """Component of each particle."""
    weights: Float[Array, " _components"]
    """`SpikeAndSlab.weights` as drawn last."""
    sums: Sums
    """Sums over the sweeps that count."""


class PosteriorSamples(eqx.Module):
    """Averages over the sweeps of all chains."""

    probability: Float[Array, "c n"]
    """Probability of each component of each particle; 0 is free."""
    mean: Float[Array, " n"]
    """Mean of s."""
    variance: Float[Array, " n"]
    """Variance of s."""
    weights: Float[Array, " _components"]
    """Mean of `SpikeAndSlab.weights`."""

    @classmethod
    def of(cls, chains: list[Chain]) -> "PosteriorSamples":
        """Return the averages over chains of equally many sweeps."""
        sums = _total(chains)
        sweeps = jnp.sum(sums.probability[:, 0])
        mean = sums.mean / sweeps
        return cls(
            probability=sums.probability / jnp.sum(sums.probability, axis=0)[None],
            mean=mean,
            variance=sums.squared / sweeps - mean**2,
            weights=sums.weights / sweeps,
        )


class Sampler(eqx.Module):
    """Sampler of the posterior of a prior and Gaussian evidence."""

    prior: AttachmentPrior
    gaussian: DualGaussian
    """The evidence about s, with every particle free."""
    config: SamplerConfig = eqx.field(static=True)

    @classmethod
    def build(
        cls,
        prior: AttachmentPrior,
        precision: Float[Array, "n n"],
        shift: Float[Array, " n"],
        config: SamplerConfig | None = None,
    ) -> "Sampler":
        """Factorise the evidence about s.

        Args:
            prior: of which particles are attached, and how stiffly.
            precision: that of the evidence.
            shift: precision times mean of the evidence.
            config: the defaults if None.
        """
        gaussian = DualGaussian.build(precision, shift, centre=prior.stiffness.mean, sd=prior.stiffness.sd)
        return cls(prior=prior, gaussian=gaussian, config=config or SamplerConfig())

    def start(self, component: Int[Array, " n"], weights: Float[Array, " _components"] | None = None) -> Chain:
        """Return a chain that begins at given components, and at the weights of the prior if none are given."""
        stiffness = self.prior.stiffness
        weights = stiffness.weights if weights is None else weights
        return Chain(component=component, weights=weights, sums=Sums.zero(len(stiffness.mean), len(component)))

    def run(
        self,
        chains: list[Chain],
        key: PRNGKeyArray,
        *,
        burn_in: int,
        sweeps: int,
        doublings: int = 1,
    ) -> tuple[list[Chain], bool]:
        """Run chains until both halves of them give the same P(attached); not for use in compiled functions.

        Every chain runs `burn_in` sweeps, which do not count, then `sweeps`, then as many again as have counted so far,
        and so on.

        Args:
            chains: where they begin.
            key: of the random numbers.
            burn_in: sweeps of each chain that do not count.
            sweeps: sweeps of each chain that count at first.
            doublings: most times that their number is doubled.

        Returns:
            The chains, and whether their halves agree within `SamplerConfig.agreement`.
        """
        agree = False
        for part in range(1 + doublings):
            arguments = jax.random.fold_in(key, part), jnp.asarray(0 if part else burn_in), jnp.asarray(sweeps)

            def advance(k: int, arguments=arguments, chains=tuple(chains)) -> Chain:
                return jax.block_until_ready(advanced(self, chains[k], jnp.asarray(k), *arguments))

            chains = list(parallel_map(advance, range(len(chains))).values())
            agree = bool(_difference(chains) < self.config.agreement)
            if agree:
                break
            sweeps = sweeps * 2 if part else sweeps
        return chains, agree

    def mode(self, component: Int[Array, " n"], key: PRNGKeyArray) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
        """Return components at a local mode of their joint posterior, and the mean of s given them.

        Iterated conditional modes [Besag 1986, JRSS B 48:259] from the given components, with the weights of the prior:
        no other component of a single particle is likelier. `MAX_MODE_SWEEPS` sweeps at most.
        """
        stiffness = self.prior.stiffness

        def sweep(state):
            before, count, _ = state
            after = self.sweep(before, stiffness, jax.random.fold_in(key, count), likeliest=True).component
            return after, count + 1, jnp.any(after != before)

        def changing(state):
            return state[-1] & (state[1] < MAX_MODE_SWEEPS)

        component, *_ = jax.lax.while_loop(changing, sweep, (component, jnp.asarray(0), jnp.asarray(True)))
        cavity = self.gaussian.measured(component).cavity(jnp.arange(len(component)), component)
        mean, _ = _moments(stiffness, cavity)
        return component, jnp.take_along_axis(mean, component[None], axis=0)[0]

    def sweep(
        self, component: Int[Array, " n"], stiffness: SpikeAndSlab, key: PRNGKeyArray, *, likeliest: bool = False
    ) -> "Swept":
        """Draw the component of every particle once, in random order.

        Args:
            component: that of each particle before.
            stiffness: prior of s, with the weights of the whole sheet as drawn last.
            key: random numbers of the order and the draws.
            likeliest: take the likeliest component of each particle instead of a draw.
        """
        n, c, candidates = len(component), len(stiffness.mean), self.config.candidates
        by_order, by_noise = jax.random.split(key)
        order = jax.random.permutation(by_order, n)
        noise = jnp.zeros((c, n)) if likeliest else jax.random.gumbel(by_noise, (c, n), jnp.float32)
        change = self._change(order, jnp.pad(noise, ((0, 0), (0, candidates))), stiffness)

        def batch(state):
            component, *others = state
            first = component, self.gaussian.measured(component[:n]), *others
            component, _, *others = jax.lax.while_loop(lambda state: (state[-1] < n) & ~state[1].full, change, first)
            return component, *others

        padded = n + candidates
        swept = Swept(
            component=jnp.append(component, 0),
            log_weight=jnp.zeros((c, padded), noise.dtype),
            cavity=Cavity(mean=jnp.zeros(padded), variance=jnp.zeros(padded)),
        )
        first = swept.component, swept, jnp.asarray(0)
        component, swept, _ = jax.lax.while_loop(lambda state: state[-1] < n, batch, first)
        position = jnp.argsort(order)
        log_weight, cavity = jax.tree.map(lambda drawn: drawn[..., position], (swept.log_weight, swept.cavity))
        return Swept(component=component[:n], log_weight=log_weight, cavity=cavity)

    def _change(self, order: Int[Array, " n"], noise: Float[Array, "c _padded"], stiffness: SpikeAndSlab) -> Callable:
        """Return the step of a sweep: draw particles up to and including the next one that changes its component.

        What is drawn is stored in the order of the sweep. What a step stores of particles behind that one, the next
        step replaces.

        Args:
            order: particles in the order of the sweep.
            noise: Gumbel noise of each draw in that order, in the precision of the log probabilities; 0 takes the
                likeliest.
            stiffness: prior of s, with the weights of the whole sheet as drawn last.
        """
        n, candidates = len(order), self.config.candidates
        prior = eqx.tree_at(lambda prior: prior.stiffness, self.prior, stiffness)
        prior = jax.tree.map(lambda x: x.astype(noise.dtype) if eqx.is_inexact_array(x) else x, prior)
        source = jnp.pad(prior.stiffness.source, ((0, 0), (1, 0)))
        order = jnp.pad(order, (0, candidates))
        neighbours, log_odds = prior.neighbours[order], prior.log_odds[order]

        def change(state):
            component, gaussian, swept, position = state

            def now(array, axis=0):
                return jax.lax.dynamic_slice_in_dim(array, position, candidates, axis)

            i, inside = now(order), position + jnp.arange(candidates) < n
            old = component[i]
            cavity = gaussian.cavity(i, old)
            beside = jnp.sum(source[:, component[now(neighbours)]], axis=2)
            log_weight = _log_weight(prior, now(log_odds), beside, cavity)
            drawn = jnp.argmax(log_weight + now(noise, 1), axis=0)
            changes = (drawn != old) & inside
            any_changes = jnp.any(changes)
            last = jnp.where(any_changes, jnp.argmax(changes), candidates - 1)
            changed, before = i[last], old[last]
            new = jnp.where(any_changes, drawn[last], before)
            component = jax.lax.dynamic_update_index_in_dim(component, new, changed, 0)
            swept = swept.with_draws(position, log_weight, cavity)
            return component, gaussian.changed(changed, before, new), swept, position + last + 1

        return change


class Swept(NamedTuple):
    """The outcome of a sweep, and what it was drawn from."""

    component: Int[Array, " n"]
    """Component of each particle."""
    log_weight: Float[Array, "c n"]
    """Log probability of each component when it was drawn, up to a constant for each particle."""
    cavity: Cavity
    """What all other particles said of each s when it was drawn."""

    def with_draws(self, position: Int[Array, ""], log_weight: Float[Array, "c m"], cavity: Cavity) -> "Swept":
        """Return the sweep with draws stored from a position on."""

        def stored(old: Array, new: Array) -> Array:
            return jax.lax.dynamic_update_slice_in_dim(old, new, position, -1)

        return self._replace(
            log_weight=stored(self.log_weight, log_weight), cavity=Cavity(*map(stored, self.cavity, cavity))
        )


@eqx.filter_jit
def advanced(
    sampler: Sampler,
    chain: Chain,
    number: Int[Array, ""],
    key: PRNGKeyArray,
    burn_in: Int[Array, ""],
    sweeps: Int[Array, ""],
) -> Chain:
    """Return a chain after sweeps that do not count, and sweeps that do; `number` is the chain's own."""
    prior, key = sampler.prior.stiffness, jax.random.fold_in(key, number)

    def sweep(k, state):
        component, stiffness, sums = state
        by_component, by_weights = jax.random.split(jax.random.fold_in(key, k))
        swept = sampler.sweep(component, stiffness, by_component)
        probability = jax.nn.softmax(swept.log_weight.astype(sums.mean.dtype), axis=0)
        mean, variance = _moments(prior, swept.cavity)
        stiffness = stiffness.drawn(swept.component, by_weights)
        new = Sums(
            probability=probability,
            mean=jnp.sum(probability * mean, axis=0),
            squared=jnp.sum(probability * (mean**2 + variance), axis=0),
            weights=stiffness.weights,
        )
        sums = jax.tree.map(lambda old, added: old + jnp.where(k >= burn_in, added, 0), sums, new)
        return swept.component, stiffness, sums

    stiffness = eqx.tree_at(lambda prior: prior.weights, prior, chain.weights)
    first = chain.component, stiffness, chain.sums
    component, stiffness, sums = jax.lax.fori_loop(0, burn_in + sweeps, sweep, first)
    return Chain(component=component, weights=stiffness.weights, sums=sums)


@eqx.filter_jit
def _difference(chains: list[Chain]) -> Float[Array, ""]:
    """Return the mean difference of P(attached) between the first half of the chains and the second."""
    half = (len(chains) + 1) // 2
    return jnp.mean(jnp.abs(_total(chains[:half]).attached - _total(chains[half:]).attached))


def _total(chains: list[Chain]) -> Sums:
    """Return the sums over the sweeps of some chains."""
    total = chains[0].sums
    for chain in chains[1:]:
        total = total + chain.sums
    return total


def _log_weight(
    prior: AttachmentPrior, log_odds: Float[Array, " m"], beside: Float[Array, "k m"], cavity: Cavity
) -> Float[Array, "c m"]:
    """Return the log probability of each component of some particles, up to a constant for each.

    Args:
        prior: with the weights of the whole sheet as drawn last.
        log_odds: of the particles without attached neighbours.
        beside: number of their attached neighbours with all of an attachment of each component.
        cavity: what all other particles say of their s.
    """
    centre, width = prior.stiffness.mean[:, None], prior.stiffness.sd[:, None] ** 2
    mean, variance = (part.astype(width.dtype)[None] for part in cavity)
    total = variance + width
    log_likelihood = -0.5 * (mean - centre) ** 2 / total - 0.5 * jnp.log(total)
    log_above_zero = log_ndtr((mean * width + centre * variance)[1:] / jnp.sqrt(total * variance * width)[1:])
    log_odds = log_odds + prior.coupling * jnp.sum(beside, axis=0)
    return log_likelihood.at[1:].add(jnp.log(prior.share_among(beside)) + log_odds[None] + log_above_zero)


def _moments(stiffness: SpikeAndSlab, cavity: Cavity) -> tuple[Float[Array, "c n"], Float[Array, "c n"]]:
    """Return mean and variance of s for each component of each particle, from its cavity."""
    centre, precision = stiffness.mean[:, None], stiffness.sd[:, None] ** -2
    variance = 1 / (1 / cavity.variance[None] + precision)
    return variance * ((cavity.mean / cavity.variance)[None] + centre * precision), variance
