"""Belief over where the sheet is attached and how stiffly, from free to rigid.

Each particle has a bounded stiffness s = b / (b + b_ref) in [0, 1]: 0 is free, 1 is a weld. Evidence about s is
Gaussian, and evidence of several frames adds up in information form (`gaussian_information`). The prior is not
Gaussian: a particle is free or attached, and attached neighbours make it likelier to be attached (`attachment_prior`).
The posterior is found in two ways:

- Expectation propagation [Minka 2001, arXiv:1301.2294] replaces each particle's prior by a Gaussian, its site. Belief
  propagation passes log odds between neighbours. Each sweep also updates the component weights of the prior
  (`SpikeAndSlab.learned`). Sites, messages and weights are kept from frame to frame, so a few sweeps a frame suffice.
- Gibbs sampling (`attachment_sampler`). Expectation propagation may fail where several particles can bear one load;
  samples find the likely ones, in ten times the time or more.

All arrays are float64: a float32 covariance of 600 stiffnesses loses definiteness.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from .attachment_prior import AttachmentPrior
from .attachment_sampler import Chain, PosteriorSamples, Sampler
from .config import BeliefConfig
from .expectation_propagation import (
    MIN_SITE_PRECISION,
    NO_EVIDENCE_VARIANCE,
    cavity,
    matching_sites,
    messages_with_probability,
    passed_messages,
    sites_with_variance,
)
from .gaussian_information import Gaussian, GaussianInformation
from .marginals import MAX_MEAN, Posterior
from .spike_and_slab import Mixture

PRIOR_SWEEPS = 20
"""Sweeps before any evidence, after which the messages of the prior alone have settled: 1 - damping to this power is
below 1e-10."""


class AttachmentBelief(eqx.Module):
    """Belief over s: Gaussian evidence, the prior, and the sites and messages that stand for the prior."""

    prior: AttachmentPrior
    """Which particles are attached, and how stiffly, before any evidence."""
    reference: Float[Array, ""]
    """Stiffness b_ref at which s is 1/2 [N/m]."""
    precision: Float[Array, "n n"]
    """Precision of the evidence alone; singular where a particle was not seen."""
    shift: Float[Array, " n"]
    """Precision times mean of the evidence alone."""
    site_precision: Float[Array, " n"]
    """Precision of each particle's site."""
    site_shift: Float[Array, " n"]
    """Precision times mean of each particle's site."""
    message: Float[Array, "n d"]
    """Log odds of being attached that each neighbour adds."""
    chain_component: Int[Array, "chains n"]
    """Component of each particle in each chain of the sampler, as sampled last; 0 before."""
    chain_weights: Float[Array, "chains _components"]
    """Component weights of each chain; 0 before any samples."""
    config: BeliefConfig = eqx.field(static=True, default_factory=BeliefConfig)
    """Settings of the sweeps, the samples and the intervals."""

    @classmethod
    def before(
        cls, prior: AttachmentPrior, *, reference: float, config: BeliefConfig | None = None
    ) -> "AttachmentBelief":
        """Return the belief before any evidence; `reference` is b_ref [N/m]."""
        n, config = len(prior.neighbours), config or BeliefConfig()
        chains = config.sampler.chains
        empty = cls(
            prior=prior,
            reference=jnp.asarray(reference, dtype=float),
            precision=jnp.zeros((n, n)),
            shift=jnp.zeros(n),
            site_precision=jnp.zeros(n),
            site_shift=jnp.zeros(n),
            message=jnp.zeros(prior.neighbours.shape),
            chain_component=jnp.zeros((chains, n), int),
            chain_weights=jnp.zeros((chains, len(prior.stiffness.weights))),
            config=config,
        )
        return empty._settled_without_evidence()

    @eqx.filter_jit
    def _settled_without_evidence(self) -> "AttachmentBelief":
        n = len(self.shift)
        no_evidence = jnp.zeros(n), jnp.full(n, NO_EVIDENCE_VARIANCE)
        return jax.lax.fori_loop(0, PRIOR_SWEEPS, lambda _, belief: belief._match_moments(*no_evidence), self)

    def bounded(self, b: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return the bounded stiffness s of a stiffness [N/m]; 1 for infinity."""
        return jnp.where(jnp.isinf(b), 1.0, b / (b + self.reference))

    def stiffness(self, s: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return the stiffness of a bounded stiffness [N/m], infinite from 1 on and 0 below 0."""
        s = jnp.clip(s, 0, 1)
        return jnp.where(s < 1, self.reference * s / jnp.where(s < 1, 1 - s, 1), jnp.inf)

    def add(self, precision: Float[Array, "n n"], shift: Float[Array, " n"]) -> "AttachmentBelief":
        """Add independent evidence in information form; call `sweep` before reading the result."""
        return eqx.tree_at(
            lambda belief: (belief.precision, belief.shift), self, (self.precision + precision, self.shift + shift)
        )

    @property
    def information(self) -> GaussianInformation:
        """Return the Gaussian over s: evidence and sites together."""
        return GaussianInformation(
            precision=self.precision + jnp.diag(self.site_precision), shift=self.shift + self.site_shift
        )

    def gaussian(self) -> Gaussian:
        """Return the Gaussian over s with its factor, means and variances."""
        return self.information.gaussian()

    def changed(self, region: Bool[Array, " n"], probability: Float[Array, " n"]) -> "AttachmentBelief":
        """Return the belief after a cut or suture, with what was known of a region's attachments forgotten.

        The old s of the region is integrated out, so that the evidence about all other particles stays. See
        `AttachmentPrior.isolated` for the messages of neighbours.

        Args:
            region: the particles.
            probability: P(attached) of each from now on; used in the region alone.
        """
        others = GaussianInformation(
            precision=self.precision + jnp.diag(jnp.where(region, self.site_precision, 0.0)),
            shift=self.shift + jnp.where(region, self.site_shift, 0.0),
        ).without(region)
        prior, message = self.prior.isolated(region, probability, self.message)
        return eqx.tree_at(
            lambda belief: (
                belief.prior,
                belief.precision,
                belief.shift,
                belief.site_precision,
                belief.site_shift,
                belief.message,
            ),
            self,
            (
                prior,
                others.precision,
                others.shift,
                jnp.where(region, MIN_SITE_PRECISION, self.site_precision),
                jnp.where(region, 0.0, self.site_shift),
                message,
            ),
        )

    def evidence_for(self, precision: Float[Array, "n n"], shift: Float[Array, " n"]) -> Float[Array, ""]:
        """Return ln p(evidence) under this belief [nat], up to a constant that does not depend on the belief.

        Args:
            precision: that of independent evidence about s.
            shift: precision times mean of that evidence.
        """
        return jnp.asarray(self.information.log_evidence(GaussianInformation(precision=precision, shift=shift)))

    def fixed(self, region: Bool[Array, " n"], mean: Float[Array, " n"], sd: Float[Array, " n"]) -> "AttachmentBelief":
        """Return the belief in which a region's s has this normal distribution and nothing else is known of it."""
        free = self.changed(region, jnp.full(len(region), 0.5))
        return eqx.tree_at(
            lambda belief: (belief.site_precision, belief.site_shift),
            free,
            (
                jnp.where(region, sd**-2, free.site_precision),
                jnp.where(region, mean * sd**-2, free.site_shift),
            ),
        )

    def sampled(
        self, key: PRNGKeyArray, *, burn_in: int, first_burn_in: int, sweeps: int, doublings: int = 1
    ) -> tuple["AttachmentBelief", bool]:
        """Return the belief that matches samples of the posterior, and whether the samples agree.

        The chains continue where they ended last, or begin at the likeliest component of each particle. Sites match
        the sampled mean and, as nearly as their range allows, the sampled variance of s; messages match the sampled
        P(attached). Not for use in compiled functions.

        Args:
            key: see `Sampler.run`.
            burn_in: sweeps of each chain that do not count, where it continues.
            first_burn_in: the same where it begins.
            sweeps: see `Sampler.run`.
            doublings: see there.
        """
        sampler, chains, drawn = _chains(self)
        burn_in = burn_in if drawn else first_burn_in
        chains, agree = sampler.run(chains, key, burn_in=burn_in, sweeps=sweeps, doublings=doublings)
        return _matching(self, chains), agree

    def mode(self, key: PRNGKeyArray) -> Float[Array, " n"]:
        """Return s at a local mode of the joint posterior, near the likeliest component of each particle.

        See `Sampler.mode`; s is 0 where a particle is free.
        """
        component, mean = self._sampler().mode(self._likeliest(), key)
        return jnp.where(component > 0, jnp.clip(mean, 0, MAX_MEAN), 0.0)

    def _sampler(self) -> Sampler:
        return Sampler.build(self.prior, self.precision, self.shift, self.config.sampler)

    def _likeliest(self) -> Int[Array, " n"]:
        """Return the likeliest component of each particle by itself."""
        mixture = self.mixture()
        return jnp.where(mixture.attached > 0.5, 1 + jnp.argmax(mixture.weight[1:], axis=0), 0)

    def _match_samples(self, samples: PosteriorSamples) -> "AttachmentBelief":
        """Return the belief whose sites and messages give the sampled moments and probabilities."""
        sites = sites_with_variance(self.precision, samples.variance)
        shift = self.precision @ samples.mean + sites * samples.mean - self.shift
        belief = eqx.tree_at(
            lambda belief: (belief.site_precision, belief.site_shift, belief.prior.stiffness.weights),
            self,
            (sites, shift, samples.weights),
        )
        share = belief.prior.share_beside(samples.probability)
        belief = eqx.tree_at(lambda belief: belief.prior.share, belief, share)
        _, log_bayes_factor = belief._mixture(*belief.cavity_of(belief.gaussian()))
        message = messages_with_probability(self.prior, samples.probability[0], log_bayes_factor)
        return eqx.tree_at(lambda belief: belief.message, belief, message)

    def sweep(self, gaussian: Gaussian) -> "AttachmentBelief":
        """Run one damped sweep of expectation and belief propagation over all particles, given `gaussian()`."""
        return self._match_moments(*self.cavity_of(gaussian))

    def swept(self, sweeps: int) -> "AttachmentBelief":
        """Run several sweeps."""
        return jax.lax.fori_loop(0, sweeps, lambda _, belief: belief.sweep(belief.gaussian()), self)

    def updated(self, precision: Float[Array, "n n"], shift: Float[Array, " n"]) -> tuple["AttachmentBelief", Gaussian]:
        """Return the belief after a frame's evidence and one sweep, and the Gaussian over s before the sweep."""
        belief = self.add(precision, shift)
        gaussian = belief.gaussian()
        return belief.sweep(gaussian), gaussian

    def posterior(self) -> Posterior:
        """Return the marginal posterior of each particle; call `sweep` before."""
        gaussian = self.gaussian()
        mixture, _ = self._mixture(*self.cavity_of(gaussian))
        mean = jnp.clip(gaussian.mean, 0, MAX_MEAN)
        sd = jnp.sqrt(gaussian.variance + self._mesh_variance(gaussian.mean))
        return Posterior(
            mean=mean,
            sd=sd,
            stiffness=self.stiffness(mean),
            stiffness_sd=sd * self.reference / (1 - mean) ** 2,
            attached=mixture.attached,
            entropy=gaussian.entropy(),
        )

    @eqx.filter_jit
    def moments(self) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
        """Return mean and covariance of s, with what the mesh adds to it.

        The transfer between neighbours leaves sums of s as they are, and the common error leaves their ratios.
        """
        gaussian, rows = self.gaussian(), jnp.arange(len(self.shift))
        transfer, common = self._transfer_variance(gaussian.mean), self._common_sd(gaussian.mean)
        covariance = gaussian.covariance().at[rows[:, None], self.prior.neighbours].add(-transfer, mode="drop")
        covariance = covariance.at[rows, rows].add(jnp.sum(transfer, axis=1))
        return gaussian.mean, covariance + common[:, None] * common[None]

    def entropy(self) -> Float[Array, ""]:
        """Return the differential entropy of the Gaussian over s [nat]."""
        return self.information.entropy()

    @eqx.filter_jit
    def interval(self) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """Return the ends of the credible interval of each b [N/m].

        The lower end is 0 where P(free) exceeds `BeliefConfig.tail`; the upper end is infinite above
        `BeliefConfig.open_above`.
        """
        tail, gaussian = self.config.tail, self.gaussian()
        mixture, _ = self._mixture(*self.cavity_of(gaussian))
        added = self._mesh_variance(gaussian.mean)
        mixture = eqx.tree_at(lambda parts: parts.sd, mixture, jnp.sqrt(mixture.sd**2 + added[None]))
        may_be_free = 1 - mixture.attached > tail
        low, high = mixture.quantile(tail), mixture.quantile(1 - tail)
        lower = jnp.where(may_be_free, 0.0, self.stiffness(low))
        return lower, jnp.where(high > self.config.open_above, jnp.inf, self.stiffness(high))

    def mixture(self) -> Mixture:
        """Return the posterior of each particle's s as a mixture of truncated normals."""
        return self._mixture(*self.cavity_of(self.gaussian()))[0]

    @property
    def _log_odds(self) -> Float[Array, " n"]:
        """Return the log odds of being attached by the prior and the messages of the neighbours."""
        return self.prior.log_odds + jnp.sum(self.message, axis=1)

    def _mesh_variance(self, s: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return the variance of each s that the mesh adds to it."""
        return jnp.sum(self._transfer_variance(s), axis=1) + self._common_sd(s) ** 2

    def _common_sd(self, s: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return the standard deviation of each s by what all b have in common, as ds = s (1 - s) d ln b."""
        s = jnp.clip(s, 0, 1)
        return self.config.common_error * s * (1 - s)

    def _transfer_variance(self, s: Float[Array, " n"]) -> Float[Array, "n d"]:
        """Return the variance of what the mesh assigns to each neighbour instead of to the particle.

        Neighbouring particles share an attachment that lies between them. The share by virtual work keeps its force and
        its place, but springs at the particles resist a turn of the sheet more than the attachment does. So the
        particles in the middle of a narrow band come out stiffer than that share, and those at its edges softer, in all
        grasps alike: a part of the difference between neighbours belongs to the softer one. The sum of s is not
        affected.

        Where a rigid attachment ends between two particles its rim is a hinge, and a particle just outside of it may
        move like a free one though the nearest part is rigid. There it is either free or rigid.
        """
        s = jnp.append(jnp.clip(s, 0, 1), 0.0)
        own, other, config = s[:-1, None], s[self.prior.neighbours], self.config
        part = config.edge_transfer + (config.rim_transfer - config.edge_transfer) * jnp.maximum(own, other) ** 2
        variance = (part * (own - other)) ** 2
        return jnp.where(self.prior.neighbours < len(self.shift), variance, 0.0)

    def cavity_of(self, gaussian: Gaussian) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """Return mean and variance of each particle's s without its own site."""
        return cavity(gaussian, self.site_precision, self.site_shift)

    def _mixture(self, mean: Float[Array, " n"], variance: Float[Array, " n"]) -> tuple[Mixture, Float[Array, " n"]]:
        """Return each particle's posterior from its cavity, and the log Bayes factor of attached without messages."""
        return self.prior.stiffness.posterior(mean, variance, self._log_odds, self.prior.share)

    def _match_moments(self, mean: Float[Array, " n"], variance: Float[Array, " n"]) -> "AttachmentBelief":
        """Run one sweep from the cavities: match moments, pass messages, and update the component weights."""
        mixture, log_bayes_factor = self._mixture(mean, variance)
        precision, shift = matching_sites(mixture, mean, variance)
        message = passed_messages(self.prior, self._log_odds + log_bayes_factor, self.message)
        damping = self.config.damping
        share = self.prior.share_beside(mixture.weight)

        def damped(old: Array, new: Array) -> Array:
            return (1 - damping) * old + damping * new

        return eqx.tree_at(
            lambda belief: (
                belief.site_precision,
                belief.site_shift,
                belief.message,
                belief.prior.share,
                belief.prior.stiffness,
            ),
            self,
            (
                damped(self.site_precision, precision),
                damped(self.site_shift, shift),
                damped(self.message, message),
                damped(self.prior.share, share),
                self.prior.stiffness.learned(mixture, log_bayes_factor, rate=self.config.learning_rate),
            ),
        )


@eqx.filter_jit
def _chains(belief: AttachmentBelief) -> tuple[Sampler, list[Chain], Bool[Array, ""]]:
    """Return the sampler of a belief, its chains to run, and whether these were sampled before."""
    sampler, drawn, chains = belief._sampler(), jnp.any(belief.chain_weights > 0), belief.chain_component
    component = jax.lax.cond(drawn, lambda: chains, lambda: jnp.broadcast_to(belief._likeliest(), chains.shape))
    weights = jnp.where(drawn, belief.chain_weights, belief.prior.stiffness.weights[None])
    return sampler, [sampler.start(*start) for start in zip(component, weights, strict=True)], drawn


@eqx.filter_jit
def _matching(belief: AttachmentBelief, chains: list[Chain]) -> AttachmentBelief:
    """Return the belief that matches the samples of chains, and keeps where they are."""
    return eqx.tree_at(
        lambda belief: (belief.chain_component, belief.chain_weights),
        belief._match_samples(PosteriorSamples.of(chains)),
        (jnp.stack([chain.component for chain in chains]), jnp.stack([chain.weights for chain in chains])),
    )
