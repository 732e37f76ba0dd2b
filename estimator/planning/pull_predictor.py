"""Predict what a pull would show, and how it would load the attachments, under the current belief.

A belief stands for many possible tissues, and `scenarios` draws some of them. In each, a pull ends in the equilibrium
of the force balance. The information of an observation there is known beforehand, because it depends on where the
particles are, not on what is measured:

    1/2 ln det(I + Sigma^1/2 D^T N^-1 D Sigma^1/2)

is what a Gaussian belief would gain. Ours is not Gaussian: a particle is free or attached, and an observation that just
separates the two teaches far more than its precision says. So the observation is taken as one measurement of each
particle's s, as precise as it makes the Gaussian belief about s. The gain is the expected fall of 1/2 ln of the
variance of s, summed over the particles that are asked about.

An attachment that nobody knows of yet is in some scenarios and not in others. Its stiffness may be anything from hardly
noticeable to a weld, which would forbid every first pull. So it counts with at most a given stiffness
(`Limits.unknown`) until it is more likely than not stiffer.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from ..belief.attachment_belief import AttachmentBelief
from ..belief.gaussian_information import Gaussian, GaussianInformation
from ..belief.spike_and_slab import Mixture
from ..estimator import Estimator
from ..filters.evidence import Evidence
from ..filters.force_balance import ForceBalance

QUADRATURE_NODES = 5
"""Gauss-Hermite nodes for each normal of a mixture."""
MIN_PRECISION = 1e-6
"""Smallest precision of a measurement of s, whose scale is 1: it stands for no measurement, and keeps 1 / x finite."""
MIN_WEIGHT = 1e-300
"""Smallest weight of a mixture's normal inside a logarithm, just above the smallest float64."""


class CandidatePull(eqx.Module):
    """Tissue in the jaws, and where they take it: one pull, or many in arrays."""

    start: Float[Array, "*many n 3"]
    """Positions to search from [m]."""
    held: Bool[Array, "*many n"]
    force_unknown: Bool[Array, "*many n"]
    """See `Evidence.force_unknown`."""
    to: Float[Array, "*many n 3"]
    """Where the held particles go [m]; meaningless for the others."""

    @classmethod
    def of_grip(
        cls,
        *,
        start: Float[Array, "n 3"],
        held: Bool[Array, " n"],
        force_unknown: Bool[Array, " n"],
        to: Float[Array, "k n 3"],
    ) -> "CandidatePull":
        """Return k pulls of one grip, each to its own targets.

        Args:
            start: positions to search from [m].
            held: particles in the jaws.
            force_unknown: see `Evidence.force_unknown`.
            to: where the held particles go in each pull [m].
        """
        start, held, force_unknown = (
            jnp.broadcast_to(part, (len(to), *part.shape)) for part in (start, held, force_unknown)
        )
        return cls(start=start, held=held, force_unknown=force_unknown, to=to)


class Outcome(eqx.Module):
    """Outcome of a pull in a scenario: one, or many in arrays."""

    x: Float[Array, "*many n 3"]
    """Positions at the end [m]."""
    gain: Float[Array, "*many"]
    """Expected fall of the entropy [nat]."""
    energy: Float[Array, "*many"]
    """Mean boundary energy [J]."""
    force: Float[Array, "*many"]
    """Largest force on one attachment [N]."""


class PullPredictor(eqx.Module):
    """Predictor of pulls: the sheet's model, the belief, and the precision of an observed particle."""

    balance: ForceBalance
    belief: AttachmentBelief
    point_precision: Float[Array, "3 3"]
    """Inverse covariance of an observed particle's position, without the noise that neighbours share [1/m^2]."""
    about: Bool[Array, " n"]
    """Particles whose s is asked about."""
    mixture: Mixture
    """Marginal of each particle's s under the belief."""
    variance: Float[Array, " n"]
    """Variance of each s under the belief's Gaussian."""
    shared_noise: Float[Array, "n modes"] | None
    """See `Evidence.fields`."""
    stiffness_factor: Float[Array, ""]
    """Factor on all forces and stiffnesses, which the tool's force shows; 1 where none is measured [1]."""

    @classmethod
    def build(
        cls,
        balance: ForceBalance,
        belief: AttachmentBelief,
        point_precision: Float[Array, "3 3"],
        about: Bool[Array, " n"],
        shared_noise: Float[Array, "n modes"] | None = None,
        *,
        stiffness_factor: float = 1.0,
    ) -> "PullPredictor":
        """Return a predictor, with what does not depend on the pull computed once.

        Args:
            balance: the sheet's force balance.
            belief: about the attachments.
            point_precision: inverse covariance of an observed particle's position, without shared noise [1/m^2].
            about: particles whose s is asked about.
            shared_noise: see `Evidence.fields`.
            stiffness_factor: factor on all forces and stiffnesses [1].
        """
        mixture, gaussian = _mixture_and_gaussian(belief)
        return cls(
            balance=balance,
            belief=belief,
            point_precision=point_precision,
            about=about,
            mixture=mixture,
            variance=gaussian.variance,
            shared_noise=shared_noise,
            stiffness_factor=jnp.asarray(stiffness_factor, dtype=float),
        )

    @classmethod
    def from_estimator(cls, estimator: Estimator, about: Bool[np.ndarray, " n"] | None = None) -> "PullPredictor":
        """Return the predictor for an estimator's belief; call `Estimator.release` first once a grasp is over.

        Args:
            estimator: its filter is 'implicit', and its sheet is known.
            about: particles whose attachments are asked about; all if None.

        Raises:
            ValueError: the sheet is not known, or the filter is another.
        """
        balance, belief = estimator.balance, estimator.attachment_belief
        asked = jnp.ones(len(belief.shift), dtype=bool) if about is None else jnp.asarray(about)
        shared = estimator.shared_noise
        shared = None if shared is None else jnp.asarray(shared)
        check = estimator.force_check
        factor = 1.0 if check is None or check.stiffness_factor is None else check.stiffness_factor
        precision = jnp.asarray(estimator.point_precision)
        return cls.build(balance, belief, precision, asked, shared, stiffness_factor=factor)

    def stiffness(self, s: Float[Array, "... n"]) -> Float[Array, "... n"]:
        """Return b of bounded stiffnesses [N/m]."""
        return self.stiffness_factor * self.balance.reference * s / (1 - s)

    def scenarios(self, key: PRNGKeyArray, count: int, *, unknown: float | Array) -> Float[Array, "count n"]:
        """Draw scenarios of s: first each particle's stiffness component by itself, then all s jointly given those.

        Args:
            key: of the draws.
            count: number of scenarios.
            unknown: largest stiffness [N/m] of a particle, unless its median is above.
        """
        belief, mixture = self.belief, self.mixture
        weight = mixture.weight
        unknown = jnp.asarray(unknown)[None] / self.stiffness_factor
        largest = jnp.maximum(belief.bounded(unknown), mixture.quantile(0.5))
        prior = belief.prior.stiffness
        by_state, by_noise = jax.random.split(key)
        log_weight = jnp.log(jnp.maximum(weight, MIN_WEIGHT))[None]
        states = jax.random.categorical(by_state, log_weight, axis=1, shape=(count, weight.shape[1]))
        noise = jax.random.normal(by_noise, states.shape)

        def draw(state: Int[Array, " n"], noise: Float[Array, " n"]) -> Float[Array, " n"]:
            precision = prior.sd[state] ** -2
            given = GaussianInformation(
                precision=belief.precision + jnp.diag(precision), shift=belief.shift + prior.mean[state] * precision
            )
            s = given.sample(noise)
            return jnp.where(state > 0, jnp.clip(s, 0, largest), 0.0)

        return jax.lax.map(lambda drawn: draw(*drawn), (states, noise))

    def gain(self, precision: Float[Array, "n n"]) -> Float[Array, ""]:
        """Return the expected fall of the entropy of the s asked about, by evidence of that precision [nat]."""
        before = self.belief.information
        variance = GaussianInformation(precision=before.precision + precision, shift=before.shift).variances()
        noise = 1 / jnp.maximum(1 / variance - 1 / self.variance, MIN_PRECISION)
        return jnp.sum(jnp.where(self.about, expected_fall(self.mixture, noise), 0.0))

    def outcome(self, candidate: CandidatePull, s: Float[Array, " n"], *, informative: bool = True) -> Outcome:
        """Return the outcome of one pull in one scenario.

        It is two programs, so that what is the same with and without the gain is compiled once.

        Args:
            candidate: one pull.
            s: one scenario.
            informative: whether to compute the gain, which costs as much as the rest; if not, it is 0.
        """
        found = self.equilibrium(candidate, s)
        if not informative:
            return found
        return eqx.tree_at(lambda outcome: outcome.gain, found, self.gain_at(candidate, s, found.x))

    @eqx.filter_jit
    def equilibrium(self, candidate: CandidatePull, s: Float[Array, " n"]) -> Outcome:
        """Return where a pull ends in a scenario and how it loads the attachments, with a gain of 0."""
        balance = self.balance
        x = balance.predict(
            jnp.where(candidate.held[:, None], candidate.to, candidate.start),
            s,
            self._evidence(candidate, candidate.to),
        )
        b, squared = self.stiffness(s), jnp.sum((x - balance.energy.rest) ** 2, axis=1)
        force = jnp.max(b * jnp.sqrt(squared))
        return Outcome(x=x, gain=jnp.zeros(()), energy=0.5 * b @ squared / len(s), force=force)

    @eqx.filter_jit
    def gain_at(self, candidate: CandidatePull, s: Float[Array, " n"], x: Float[Array, "n 3"]) -> Float[Array, ""]:
        """Return the gain by observing the equilibrium x of a pull in a scenario [nat]."""
        frame = self.balance.linearise(x, s, self._evidence(candidate, x))
        return self.gain(self.balance.information(frame, self.balance.fit(frame)).precision)

    def _evidence(self, candidate: CandidatePull, y: Float[Array, "n 3"]) -> Evidence:
        """Return the evidence of a frame in which all particles are observed at y."""
        precision, fields = jnp.broadcast_to(self.point_precision[None], (len(y), 3, 3)), self.shared_noise
        if fields is not None:
            shared = jnp.where(candidate.held, 0.0, jnp.sum(fields**2, axis=1))[:, None, None]
            precision = jnp.linalg.inv(jnp.linalg.inv(precision) + shared * jnp.eye(3)[None])
        unknown = candidate.force_unknown
        return Evidence(y=y, precision=precision, held=candidate.held, force_unknown=unknown, fields=fields)


@eqx.filter_jit
def _mixture_and_gaussian(belief: AttachmentBelief) -> tuple[Mixture, Gaussian]:
    return belief.mixture(), belief.gaussian()


def expected_fall(mixture: Mixture, noise: Float[Array, " n"]) -> Float[Array, " n"]:
    """Return the expected fall of 1/2 ln of each variable's variance by one noisy measurement of it [nat].

    The normals of the mixture are not truncated to [0, 1]. Each is integrated over by Gauss-Hermite quadrature.

    Args:
        mixture: of normals, for each variable.
        noise: variance of the measurement of each variable.
    """
    weight, mean, variance = mixture.weight, mixture.mean, mixture.sd**2
    node, node_weight = (jnp.asarray(part) for part in np.polynomial.hermite_e.hermegauss(QUADRATURE_NODES))
    total = variance + noise[None]
    log_weight = jnp.log(jnp.maximum(weight, MIN_WEIGHT)) - 0.5 * jnp.log(total)

    def after(measured: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return 1/2 ln of the posterior variance for a measured value."""
        posterior = jax.nn.softmax(log_weight - 0.5 * (measured[None] - mean) ** 2 / total, axis=0)
        posterior_mean = mean + variance / total * (measured[None] - mean)
        return 0.5 * jnp.log(_variance(posterior, posterior_mean, variance * noise[None] / total))

    measured = mean[None] + jnp.sqrt(total)[None] * node[:, None, None]
    expected = jnp.einsum(
        "q,cn,qcn->n", node_weight / jnp.sum(node_weight), weight, jax.vmap(jax.vmap(after))(measured)
    )
    return 0.5 * jnp.log(_variance(weight, mean, variance)) - expected


def _variance(
    weight: Float[Array, "c n"], mean: Float[Array, "c n"], variance: Float[Array, "c n"]
) -> Float[Array, " n"]:
    """Return the variance of a mixture of c normals, for each of n variables."""
    mixture_mean = jnp.sum(weight * mean, axis=0)
    return jnp.sum(weight * (variance + (mean - mixture_mean[None]) ** 2), axis=0)
