"""Which particles are attached: samples of the states with all stiffnesses integrated out.

Given the state of every particle (free, or on which rung of the ladder), the bounded stiffnesses s are Gaussian, and
the probability of a state is a closed form. A sweep draws the state of each particle in turn, given those of all
others, and then the shares of the rungs [collapsed Gibbs sampling for a spike and a slab: George & McCulloch 1997,
Statistica Sinica 7:339]. Unlike expectation propagation it finds its way where several particles may carry one load,
and has no fixed point to miss. To keep the form closed, the prior's normals are not cut off to [0, 1], but for the
particle that is looked at a rung counts by the part of its s that would lie above 0. A model that errs may ask for less
than nothing, which the widest rung would explain best.

Between two particles that change their state nothing that the others depend on changes, so the next few are looked at
together, and a sweep costs a rank-one update for each change; a few of them wait to be carried out together.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.special import log_ndtr
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from ..physics.block_tridiagonal import lower_inverse
from .attachment_prior import AttachmentPrior


class PosteriorSamples(eqx.Module):
    """Averages over the sweeps."""

    weight: Float[Array, "c n"]
    """Probability of each state of each particle: free first, then the rungs."""
    mean: Float[Array, " n"]
    """Of s."""
    variance: Float[Array, " n"]
    weights: Float[Array, " _components"]
    """See `SpikeAndSlab.weights`."""
    agree: Bool[Array, ""]
    """Whether the first half of the sweeps says the same of P(attached) as the second."""


class Sampler(eqx.Module):
    """The posterior to draw from."""

    prior: AttachmentPrior
    precision: Float[Array, "n n"]
    """Of the evidence about s."""
    shift: Float[Array, " n"]

    def run(
        self,
        state: Int[Array, " n"],
        key: PRNGKeyArray,
        *,
        burn_in: int,
        rounds: int | Int[Array, ""],
        doublings: int | Int[Array, ""] = 1,
    ) -> PosteriorSamples:
        """Average rounds of `ROUND` sweeps from a state, leaving out the first `burn_in`.

        After `rounds` of them come as many again; and then as many as all so far again, until both halves agree, with
        `doublings` at most.
        """
        rounds = jnp.asarray(rounds)

        def sweep(k, carried):
            state, moments, stiffness, sums = carried
            one, other = jax.random.split(jax.random.fold_in(key, k))
            state, moments, weight = self._sweep(state, moments, stiffness.share, one)
            stiffness, mean = stiffness.drawn(state, other), moments.mean
            squared = jnp.diagonal(moments.covariance) + mean**2
            sums = jax.tree.map(
                jnp.add, sums, Sums(weight=weight, mean=mean, squared=squared, weights=stiffness.weights)
            )
            return state, moments, stiffness, sums

        def round(k, carried):
            state, *others = carried
            first = state, self._moments(state), *others
            state, _, *others = jax.lax.fori_loop(k * ROUND, (k + 1) * ROUND, sweep, first)
            return state, *others

        def again(carried):
            state, stiffness, sums, done, part, _ = carried
            count = jnp.where(part == 0, burn_in, rounds * 2 ** jnp.maximum(part - 2, 0))
            state, stiffness, new = jax.lax.fori_loop(done, done + count, round, (state, stiffness, nothing))
            apart = jnp.mean(jnp.abs(sums.attached - new.attached))
            sums = jax.tree.map(lambda sum, one: jnp.where(part == 0, 0.0, sum + one), sums, new)
            return state, stiffness, sums, done + count, part + 1, (part > 1) & (apart < AGREE)

        def unsettled(carried):
            part, agree = carried[4:]
            return (part < 2 + doublings) & ~agree

        stiffness = self.prior.stiffness
        nothing = Sums.none(len(stiffness.mean), len(state))
        first = state, stiffness, nothing, jnp.asarray(0), jnp.asarray(0), jnp.asarray(False)
        _, _, sums, _, _, agree = jax.lax.while_loop(unsettled, again, first)
        sweeps = jnp.sum(sums.weight[:, 0])
        mean = sums.mean / sweeps
        return PosteriorSamples(
            weight=sums.weight / jnp.sum(sums.weight, axis=0)[None],
            mean=mean,
            variance=sums.squared / sweeps - mean**2,
            weights=sums.weights / sweeps,
            agree=agree,
        )

    def mode(self, state: Int[Array, " n"], key: PRNGKeyArray) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
        """States of which none is likelier by itself, and the mean of s given them; near those that it begins with.

        Iterated conditional modes [Besag 1986, JRSS B 48:259], the shares of the rungs as they are believed.
        """
        share = self.prior.stiffness.share

        def sweep(carried):
            before, moments, count, _ = carried
            state, moments, _ = self._sweep(before, moments, share, jax.random.fold_in(key, count), warm=False)
            return state, moments, count + 1, jnp.any(state != before)

        def changing(carried):
            return carried[-1] & (carried[2] < ROUND)

        first = state, self._moments(state), jnp.asarray(0), jnp.asarray(True)
        state, *_ = jax.lax.while_loop(changing, sweep, first)
        return state, self._moments(state).mean

    def _moments(self, state: Int[Array, " n"]) -> "Moments":
        precision, shift = self._normals
        inverse = lower_inverse(jnp.linalg.cholesky(self.precision + jnp.diag(precision[state])))
        covariance = inverse.T @ inverse
        return Moments(mean=covariance @ (self.shift + shift[state]), covariance=covariance)

    @property
    def _normals(self) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
        """The prior's normals in information form."""
        return self.prior.stiffness.sd**-2, self.prior.stiffness.mean * self.prior.stiffness.sd**-2

    def _sweep(
        self,
        state: Int[Array, " n"],
        moments: "Moments",
        share: Float[Array, " _components"],
        key: PRNGKeyArray,
        *,
        warm: bool = True,
    ) -> tuple[Int[Array, " n"], "Moments", Float[Array, "c n"]]:
        """Every particle once, in a random order; with the probabilities that the states were drawn from.

        Not `warm`, each takes its likeliest state.
        """
        n, centre, width = len(state), self.prior.stiffness.mean[:, None], self.prior.stiffness.sd[:, None] ** 2
        precision, shift = self._normals
        by_order, by_noise = jax.random.split(key)
        order, noise = jnp.argsort(jax.random.permutation(by_order, n)), jax.random.gumbel(by_noise, (len(width), n))
        noise = noise if warm else jnp.zeros_like(noise)
        order = jnp.append(order, jnp.full(AHEAD, n))

        def change(carried):
            state, mean, own, pending, weight, at = carried
            some = jax.lax.dynamic_slice(order, (at,), (AHEAD,))
            here, now = jnp.minimum(some, n - 1), state[jnp.minimum(some, n - 1)]
            apart = 1 / jnp.maximum(1 / own[here] - precision[now], FAINT)[None]
            told = apart * (mean[here] / own[here] - shift[now])[None]
            spread = apart + width
            above = log_ndtr(((told * width + centre * apart) / jnp.sqrt(spread * apart * width))[1:])
            attached = jnp.append(jnp.where(state > 0, 1.0, 0.0), 0.0)
            beside = jnp.sum(attached[self.prior.neighbours[here]], axis=1)
            odds = self.prior.log_odds[here] + self.prior.coupling * beside
            seen = -0.5 * (told - centre) ** 2 / spread - 0.5 * jnp.log(spread)
            log_weight = seen.at[1:].add(jnp.log(share)[:, None] + odds[None] + above)
            drawn = jnp.argmax(log_weight + noise[:, here], axis=0)
            changes = (drawn != now) & (some < n)
            last = jnp.where(jnp.any(changes), jnp.argmax(changes), AHEAD - 1)
            done = jnp.where(jnp.arange(AHEAD) <= last, some, n)
            weight = weight.at[:, done].set(jax.nn.softmax(log_weight, axis=0), mode="drop")
            i = here[last]
            new = jnp.where(changes[last], drawn[last], state[i])
            stiffer, further = precision[new] - precision[state[i]], shift[new] - shift[state[i]]
            column = pending.column(i)
            factor = 1 / (1 + stiffer * column[i])
            mean = mean + factor * (further - stiffer * mean[i]) * column
            own = own - factor * stiffer * column**2
            pending = pending.and_less(factor * stiffer, column, changes[last])
            return state.at[i].set(new), mean, own, pending, weight, at + last + 1

        def batch(carried):
            state, moments, weight, at = carried
            first = state, moments.mean, jnp.diagonal(moments.covariance), Pending.none(moments.covariance), weight, at
            some = lambda carried: (carried[-1] < n) & (carried[3].count < PENDING)  # noqa: E731
            state, mean, _, pending, weight, at = jax.lax.while_loop(some, change, first)
            return state, Moments(mean=mean, covariance=pending.done()), weight, at

        first = state, moments, jnp.zeros((len(width), n)), jnp.asarray(0)
        return jax.lax.while_loop(lambda carried: carried[-1] < n, batch, first)[:3]


class Sums(eqx.Module):
    """Over sweeps, of what `PosteriorSamples` averages."""

    weight: Float[Array, "c n"]
    mean: Float[Array, " n"]
    squared: Float[Array, " n"]
    weights: Float[Array, " _components"]

    @classmethod
    def none(cls, c: int, n: int) -> "Sums":
        """Over no sweep, of n particles in c states."""
        return cls(weight=jnp.zeros((c, n)), mean=jnp.zeros(n), squared=jnp.zeros(n), weights=jnp.zeros(c - 1))

    @property
    def attached(self) -> Float[Array, " n"]:
        """Share of the sweeps in which each particle is attached, 1 over none."""
        return 1 - self.weight[0] / jnp.maximum(jnp.sum(self.weight, axis=0), 1)


class Moments(eqx.Module):
    """Of s, given the states."""

    mean: Float[Array, " n"]
    covariance: Float[Array, "n n"]


class Pending(eqx.Module):
    """A covariance, and rank-one updates of it to be carried out together.

    One at a time, each would cost the time to read and write all of it.
    """

    covariance: Float[Array, "n n"]
    columns: Float[Array, "_k n"]
    factors: Float[Array, " _k"]
    count: Int[Array, ""]

    @classmethod
    def none(cls, covariance: Float[Array, "n n"]) -> "Pending":
        """Nothing to update."""
        columns = jnp.zeros((PENDING, len(covariance)))
        return cls(covariance=covariance, columns=columns, factors=jnp.zeros(PENDING), count=jnp.asarray(0))

    def column(self, i: Int[Array, ""]) -> Float[Array, " n"]:
        """The i-th, up to date."""
        return self.covariance[i] - (self.factors * self.columns[:, i]) @ self.columns

    def and_less(self, factor: Float[Array, ""], column: Float[Array, " n"], is_any: Bool[Array, ""]) -> "Pending":
        """After taking factor * column column^T away; without any the factor is 0, and the next takes its place."""
        return Pending(
            covariance=self.covariance,
            columns=self.columns.at[self.count].set(column),
            factors=self.factors.at[self.count].set(factor),
            count=self.count + is_any.astype(self.count.dtype),
        )

    def done(self) -> Float[Array, "n n"]:
        """The covariance, up to date."""
        return self.covariance - (self.factors[:, None] * self.columns).T @ self.columns


AHEAD = 16
"""Particles that are looked at together for the next change."""
PENDING = 32
"""Updates that wait for one another."""
ROUND = 10
"""Sweeps after which the covariance is computed anew, free of what its updates were rounded by."""
FAINT = 1e-8
"""Least precision of what the evidence says of a particle."""
AGREE = 0.02
"""Mean difference of P(attached) between the two halves that counts as none."""
