"""Belief over where the sheet is attached and how stiffly, from soft to rigid.

Each particle has a bounded stiffness s = b / (b + b_ref) in [0, 1]: 0 is free, 1 is a weld. What frames say of s adds
up in information form. Expectation propagation [Minka 2001, arXiv:1301.2294] replaces each particle's prior
(`attachment_prior`) by a Gaussian, its site, and belief propagation passes the odds between neighbours. How stiff
attachments of this tissue are is learned on the way (`SpikeAndSlab.learned`). All of it is kept from frame to frame, so
that a few sweeps a frame are enough. Where several particles may carry one load propagation loses its way; `sampled`
finds it, in seconds instead of milliseconds. float64 throughout: a float32 covariance of 600 stiffnesses loses
definiteness.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from ..physics.block_tridiagonal import lower_inverse
from .attachment_prior import AttachmentPrior
from .attachment_sampler import PosteriorSamples, Sampler
from .boundary_belief import entropy
from .spike_and_slab import Mixture


class AttachmentBelief(eqx.Module):
    """Evidence about s, and what stands in for the prior."""

    prior: AttachmentPrior
    reference: Float[Array, ""]
    """b_ref [N/m]."""
    precision: Float[Array, "n n"]
    """Of the evidence alone; singular where nothing was seen."""
    shift: Float[Array, " n"]
    site_precision: Float[Array, " n"]
    site_shift: Float[Array, " n"]
    message: Float[Array, "n d"]
    """Log odds that each neighbour adds."""

    @classmethod
    def before(cls, prior: AttachmentPrior, *, reference: float) -> "AttachmentBelief":
        """Nothing seen yet."""
        n = len(prior.neighbours)
        empty = cls(
            prior=prior,
            reference=jnp.asarray(reference, dtype=float),
            precision=jnp.zeros((n, n)),
            shift=jnp.zeros(n),
            site_precision=jnp.zeros(n),
            site_shift=jnp.zeros(n),
            message=jnp.zeros(prior.neighbours.shape),
        )
        return empty._undisturbed()

    @eqx.filter_jit
    def _undisturbed(self) -> "AttachmentBelief":
        """What neighbours tell each other where nothing was seen."""
        n = len(self.shift)
        nothing = jnp.zeros(n), jnp.full(n, UNKNOWN)
        return jax.lax.fori_loop(0, 20, lambda _, belief: belief._matched(*nothing), self)

    def bounded(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        """S of a stiffness [N/m]; 1 for infinity."""
        return jnp.where(jnp.isinf(b), 1.0, b / (b + self.reference))

    def stiffness(self, s: Float[Array, " n"]) -> Float[Array, " n"]:
        """B of a bounded stiffness [N/m], infinite from 1 on and 0 below 0."""
        s = jnp.clip(s, 0, 1)
        return jnp.where(s < 1, self.reference * s / jnp.where(s < 1, 1 - s, 1), jnp.inf)

    def add(self, precision: Float[Array, "n n"], shift: Float[Array, " n"]) -> "AttachmentBelief":
        """After independent evidence in information form; call `sweep` before asking."""
        return eqx.tree_at(
            lambda belief: (belief.precision, belief.shift), self, (self.precision + precision, self.shift + shift)
        )

    def changed(self, region: Bool[Array, " n"], probability: Float[Array, " n"]) -> "AttachmentBelief":
        """After something was done to the attachments of a region: what was seen of them says nothing of them now.

        Their old s is integrated out, so that what was seen of the others stays; see `AttachmentPrior.parted` for what
        neighbours say.

        Args:
            region: the particles.
            probability: P(attached) of each from now on; used in the region alone.
        """
        held = jnp.where(region[:, None] & region[None], self.precision + jnp.diag(self.site_precision), 0.0)
        factor = (jnp.linalg.cholesky(held + jnp.diag(jnp.where(region, 0.0, 1.0))), True)
        across = jnp.where(region[:, None] & ~region[None], self.precision, 0.0)
        told = jnp.where(region, self.shift + self.site_shift, 0.0)
        both = ~region[:, None] & ~region[None]
        prior, message = self.prior.parted(region, probability, self.message)
        return eqx.tree_at(
            lambda one: (one.prior, one.precision, one.shift, one.site_precision, one.site_shift, one.message),
            self,
            (
                prior,
                jnp.where(both, self.precision, 0.0) - across.T @ cho_solve(factor, across),
                jnp.where(region, 0.0, self.shift - across.T @ cho_solve(factor, told)),
                jnp.where(region, SITE_PRECISION[0], self.site_precision),
                jnp.where(region, 0.0, self.site_shift),
                message,
            ),
        )

    def evidence_for(self, precision: Float[Array, "n n"], shift: Float[Array, " n"]) -> Float[Array, ""]:
        """Ln p(evidence) if s is distributed as believed, up to what does not depend on the belief.

        Args:
            precision: of independent evidence about s.
            shift: its other half.
        """
        before = self.precision + jnp.diag(self.site_precision)
        told = self.shift + self.site_shift
        old, new = jnp.linalg.cholesky(before), jnp.linalg.cholesky(before + precision)
        log_ratio = jnp.sum(jnp.log(jnp.diagonal(old))) - jnp.sum(jnp.log(jnp.diagonal(new)))
        squared = (told + shift) @ cho_solve((new, True), told + shift) - told @ cho_solve((old, True), told)
        return log_ratio + 0.5 * squared

    def fixed(self, region: Bool[Array, " n"], mean: Float[Array, " n"], sd: Float[Array, " n"]) -> "AttachmentBelief":
        """With nothing but this normal said of a region's s."""
        free = self.changed(region, jnp.full(len(region), 0.5))
        return eqx.tree_at(
            lambda one: (one.site_precision, one.site_shift),
            free,
            (
                jnp.where(region, sd**-2, free.site_precision),
                jnp.where(region, mean * sd**-2, free.site_shift),
            ),
        )

    def sampled(
        self,
        key: PRNGKeyArray,
        *,
        burn_in: int,
        rounds: int | Int[Array, ""],
        doublings: int | Int[Array, ""] = 1,
    ) -> tuple["AttachmentBelief", Bool[Array, ""]]:
        """The belief that samples of the posterior give, and whether both halves of them agree (see `Sampler.run`).

        The chain begins at what is believed. The sites are those that give s the samples' mean and, as nearly as sites
        can, variance; the messages those that give the samples' P(attached).
        """
        sampler, state = self._sampler
        found = sampler.run(state, key, burn_in=burn_in, rounds=rounds, doublings=doublings)
        return self._saying(found), found.agree

    def mode(self, key: PRNGKeyArray) -> Float[Array, " n"]:
        """S of attachments that are likeliest together, near those that are likelier than not; see `Sampler.mode`."""
        sampler, begun = self._sampler
        state, mean = sampler.mode(begun, key)
        return jnp.where(state > 0, jnp.clip(mean, 0, RIGID), 0.0)

    @property
    def _sampler(self) -> tuple[Sampler, Int[Array, " n"]]:
        """What draws from the posterior, and the states that are likeliest one by one."""
        mixture, _ = self._mixture(*self._cavity(self.gaussian()))
        state = jnp.where(mixture.attached > 0.5, 1 + jnp.argmax(mixture.weight[1:], axis=0), 0)
        return Sampler(prior=self.prior, precision=self.precision, shift=self.shift), state

    def _saying(self, found: PosteriorSamples) -> "AttachmentBelief":
        """Sites and messages that give what was sampled."""

        def narrower(_, sites):
            gaussian = eqx.tree_at(lambda belief: belief.site_precision, self, sites).gaussian()
            return jnp.clip(sites + DAMPING * (1 / found.variance - 1 / gaussian.variance), *SITE_PRECISION)

        sites = jax.lax.fori_loop(0, MATCHES, narrower, jnp.clip(1 / found.variance, *SITE_PRECISION))
        shift = self.precision @ found.mean + sites * found.mean - self.shift
        belief = eqx.tree_at(
            lambda belief: (belief.site_precision, belief.site_shift, belief.prior.stiffness.weights),
            self,
            (sites, shift, found.weights),
        )
        _, factor = belief._mixture(*belief._cavity(belief.gaussian()))
        beside = self.prior.neighbours < len(self.shift)
        free = jnp.clip(found.weight[0], SURE, 1 - SURE)
        odds = jnp.log1p(-free) - jnp.log(free)
        each = (odds - factor - self.prior.log_odds) / jnp.maximum(jnp.sum(beside, axis=1), 1).astype(odds.dtype)
        return eqx.tree_at(lambda belief: belief.message, belief, jnp.where(beside, each[:, None], 0.0))

    def sweep(self, gaussian: "Gaussian") -> "AttachmentBelief":
        """One sweep of expectation and belief propagation over all particles at once, damped, given its `gaussian`."""
        return self._matched(*self._cavity(gaussian))

    def swept(self, sweeps: int) -> "AttachmentBelief":
        """After that many sweeps."""
        return jax.lax.fori_loop(0, sweeps, lambda _, one: one.sweep(one.gaussian()), self)

    def posterior(self) -> "Posterior":
        """What is believed of each particle; call `sweep` before."""
        gaussian = self.gaussian()
        mixture, _ = self._mixture(*self._cavity(gaussian))
        moved = jnp.sum(self._moved(gaussian.mean), axis=1)
        mean, sd = jnp.clip(gaussian.mean, 0, RIGID), jnp.sqrt(gaussian.variance + moved)
        return Posterior(
            mean=mean,
            sd=sd,
            stiffness=self.stiffness(mean),
            stiffness_sd=sd * self.reference / (1 - mean) ** 2,
            attached=mixture.attached,
            entropy=entropy(gaussian.factor),
        )

    def moments(self) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
        """Mean and covariance of s, with what the mesh moves between neighbours, which leaves sums alone."""
        gaussian, rows = self.gaussian(), jnp.arange(len(self.shift))
        covariance = cho_solve((gaussian.factor, True), jnp.eye(len(self.shift), dtype=self.shift.dtype))
        moved = self._moved(gaussian.mean)
        covariance = covariance.at[rows[:, None], self.prior.neighbours].add(-moved, mode="drop")
        return gaussian.mean, covariance.at[rows, rows].add(jnp.sum(moved, axis=1))

    def entropy(self) -> Float[Array, ""]:
        """Of the Gaussian over s [nat]."""
        return entropy(self.gaussian().factor)

    @eqx.filter_jit
    def interval(self) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """Ends of the 90 % interval of each b [N/m]: from 0 where 'free' keeps 5 %, up to infinity beyond `OPEN`."""
        gaussian = self.gaussian()
        mixture, _ = self._mixture(*self._cavity(gaussian))
        moved = jnp.sum(self._moved(gaussian.mean), axis=1)
        mixture = eqx.tree_at(lambda one: one.sd, mixture, jnp.sqrt(mixture.sd**2 + moved[None]))
        free = 1 - mixture.attached > TAIL
        low, high = mixture.quantile(TAIL), mixture.quantile(1 - TAIL)
        lower = jnp.where(free, 0.0, self.stiffness(low))
        return lower, jnp.where(high > OPEN, jnp.inf, self.stiffness(high))

    def mixture(self) -> Mixture:
        """Each particle's own distribution of s."""
        return self._mixture(*self._cavity(self.gaussian()))[0]

    def gaussian(self) -> "Gaussian":
        """Evidence and sites together."""
        factor = jnp.linalg.cholesky(self.precision + jnp.diag(self.site_precision))
        inverse = lower_inverse(factor)
        mean = inverse.T @ (inverse @ (self.shift + self.site_shift))
        return Gaussian(factor=factor, mean=mean, variance=jnp.sum(inverse**2, axis=0))

    @property
    def _odds(self) -> Float[Array, " n"]:
        """Log odds of being attached, by the prior and what the neighbours told."""
        return self.prior.log_odds + jnp.sum(self.message, axis=1)

    def _moved(self, s: Float[Array, " n"]) -> Float[Array, "n d"]:
        """Variance of what a mesh gives to each neighbour instead of a particle.

        An attachment between particles is shared by them, and a spring at each makes another sheet turn around it than
        the attachment itself does: what fits the frames best is not the share by virtual work, in all grasps alike. How
        much there is in all is not touched by it.
        """
        s = jnp.append(jnp.clip(s, 0, 1), 0.0)
        between = (s[:-1, None] + s[self.prior.neighbours]) / 2
        variance = (MOVED * between * (1 - between)) ** 2
        return jnp.where(self.prior.neighbours < len(self.shift), variance, 0.0)

    def _cavity(self, gaussian: "Gaussian") -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """Mean and variance of each particle's s without its own site."""
        precision = jnp.maximum(1 / gaussian.variance - self.site_precision, 1 / UNKNOWN)
        return (gaussian.mean / gaussian.variance - self.site_shift) / precision, 1 / precision

    def _mixture(self, mean: Float[Array, " n"], variance: Float[Array, " n"]) -> tuple[Mixture, Float[Array, " n"]]:
        """Each particle's own distribution, and the log Bayes factor of its being attached, neighbours left out."""
        return self.prior.stiffness.posterior(mean, variance, self._odds)

    def _matched(self, mean: Float[Array, " n"], variance: Float[Array, " n"]) -> "AttachmentBelief":
        """Sites that give each particle its own distribution's moments; messages passed and shares learned, once.

        Each neighbour is told of the odds by all but what it told itself.
        """
        mixture, factor = self._mixture(mean, variance)
        own_mean, own_variance = mixture.moments()
        precision = jnp.clip(1 / own_variance - 1 / variance, *SITE_PRECISION)
        shift = own_mean * (precision + 1 / variance) - mean / variance
        told = (self._odds + factor)[:, None] - self.message
        sent = jnp.log1p(jax.nn.sigmoid(told) * jnp.expm1(self.prior.coupling))
        sent = jnp.concatenate([sent, jnp.zeros((1, sent.shape[1]), sent.dtype)])
        message = sent[self.prior.neighbours, self.prior.back]

        def damped(old: Array, new: Array) -> Array:
            return (1 - DAMPING) * old + DAMPING * new

        return eqx.tree_at(
            lambda belief: (belief.site_precision, belief.site_shift, belief.message, belief.prior.stiffness),
            self,
            (
                damped(self.site_precision, precision),
                damped(self.site_shift, shift),
                damped(self.message, message),
                self.prior.stiffness.learned(mixture, factor),
            ),
        )


class Gaussian(eqx.Module):
    """The Gaussian over all s."""

    factor: Float[Array, "n n"]
    """Lower Cholesky factor of its precision."""
    mean: Float[Array, " n"]
    variance: Float[Array, " n"]


class Posterior(eqx.Module):
    """What a belief says of each particle."""

    mean: Float[Array, " n"]
    """Of s, in [0, RIGID]."""
    sd: Float[Array, " n"]
    """Of s."""
    stiffness: Float[Array, " n"]
    """b at the mean [N/m]."""
    stiffness_sd: Float[Array, " n"]
    """Of b, as far as b is linear in s around the mean [N/m]."""
    attached: Float[Array, " n"]
    """P(attached)."""
    entropy: Float[Array, ""]
    """Of the Gaussian over s [nat]."""


MOVED = 0.08
"""Share of an attachment, between it and what is free or rigid, that a mesh moves along each edge: standard deviation,
from images of the shipped scenes."""
RIGID = 0.999
"""No mean lies above: 1 is infinitely stiff."""
OPEN = 0.9
"""An interval that reaches above is open-ended: nine times b_ref and a weld differ by less than the mesh gives."""
TAIL = 0.05
"""Probability left out at either end of an interval."""
UNKNOWN = 1e8
"""Variance of an s of which nothing is known."""
MATCHES = 10
"""Steps towards the sites that match a sampled variance."""
SURE = 1e-9
"""No sampled probability is stated to be nearer to 0 or 1."""
DAMPING = 0.7
"""Share of each sweep's outcome that is taken."""
SITE_PRECISION = (1e-2, 1e14)
"""Range of the sites' precision. Where free and attached are about even, a particle's own variance exceeds that of what
was measured, which only a site below 0 could say; with that the whole may lose definiteness."""
