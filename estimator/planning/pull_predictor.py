"""What a pull would show and what it would ask of the attachments, as far as the belief can tell.

A belief is many tissues that could be: `scenarios` draws some of them. In each a pull ends in the equilibrium of the
balance of forces, and what a look at it would add to the belief is known beforehand, as it depends on where the
particles are, not on what is read off them:

    1/2 ln det(I + Sigma^1/2 D^T N^-1 D Sigma^1/2)

is what a Gaussian belief would gain. Ours is not Gaussian: a particle is free or attached, and a look that just tells
the two apart teaches far more than its precision says. So the look is taken as one measurement of each particle's s, as
precise as it makes what is known of it, and the gain is the expected fall of 1/2 ln of that s's variance, summed over
the particles that are asked about.

An attachment that nobody knows of yet is in some scenarios and not in others: a risk as well as a hope. How stiff it
may be, from hardly felt to a weld, would forbid every first pull; so it counts with at most a stiffness that somebody
types, until it is likelier stiffer than not.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from ..belief.attachment_belief import AttachmentBelief, Gaussian
from ..belief.spike_and_slab import Mixture
from ..estimator import Estimator
from ..filters.evidence import Evidence
from ..filters.force_balance import ForceBalance
from ..physics.block_tridiagonal import lower_inverse


class CandidatePull(eqx.Module):
    """Tissue in the jaws, and where these take it; one, or many in arrays."""

    start: Float[Array, "*many n 3"]
    """Positions to search from [m]."""
    held: Bool[Array, "*many n"]
    force_unknown: Bool[Array, "*many n"]
    """See `Evidence.force_unknown`."""
    to: Float[Array, "*many n 3"]
    """Where the held particles go [m]; meaningless for the others."""


class Outcome(eqx.Module):
    """Of a tug in one scenario; one, or many in arrays."""

    x: Float[Array, "*many n 3"]
    """[m]."""
    gain: Float[Array, "*many"]
    """What entropy is expected to fall by [nat]."""
    energy: Float[Array, "*many"]
    """Mean boundary energy [J]."""
    force: Float[Array, "*many"]
    """Largest on one attachment [N]."""


class PullPredictor(eqx.Module):
    """What is predicted from: the sheet's model, the belief, and how well a particle is seen."""

    balance: ForceBalance
    belief: AttachmentBelief
    precision: Float[Array, "3 3"]
    """Inverse covariance of a seen particle [1/m^2]."""
    about: Bool[Array, " n"]
    """Particles whose s is worth knowing."""
    mixture: Mixture
    """The belief's, of each particle's s."""
    known: Float[Array, " n"]
    """Variance that the belief's Gaussian leaves of each s."""

    @classmethod
    def build(
        cls,
        balance: ForceBalance,
        belief: AttachmentBelief,
        precision: Float[Array, "3 3"],
        about: Bool[Array, " n"],
    ) -> "PullPredictor":
        """With what does not depend on the pull worked out once."""
        mixture, gaussian = _believed(belief)
        return cls(
            balance=balance,
            belief=belief,
            precision=precision,
            about=about,
            mixture=mixture,
            known=gaussian.variance,
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
        return cls.build(balance, belief, jnp.asarray(estimator.point_precision), asked)

    def scenarios(self, key: PRNGKeyArray, count: int, *, unknown: float | Array) -> Float[Array, "count n"]:
        """Draws of s: free, or on which rung, for each particle by itself, then all s together given that.

        None is stiffer than `unknown` [N/m], unless it is as likely above as below more.
        """
        belief, mixture = self.belief, self.mixture
        weight = mixture.weight
        most = jnp.maximum(belief.bounded(jnp.asarray(unknown)[None]), mixture.quantile(0.5))
        prior = belief.prior.stiffness
        by_state, by_noise = jax.random.split(key)
        log_weight = jnp.log(jnp.maximum(weight, 1e-300))[None]
        states = jax.random.categorical(by_state, log_weight, axis=1, shape=(count, weight.shape[1]))
        noise = jax.random.normal(by_noise, states.shape)

        def one(state: Int[Array, " n"], noise: Float[Array, " n"]) -> Float[Array, " n"]:
            precision = prior.sd[state] ** -2
            factor = jnp.linalg.cholesky(belief.precision + jnp.diag(precision))
            mean = jax.scipy.linalg.cho_solve((factor, True), belief.shift + prior.mean[state] * precision)
            s = mean + jax.scipy.linalg.solve_triangular(factor.T, noise, lower=False)
            return jnp.where(state > 0, jnp.clip(s, 0, most), 0.0)

        return jax.lax.map(lambda drawn: one(*drawn), (states, noise))

    def gain(self, precision: Float[Array, "n n"]) -> Float[Array, ""]:
        """Expected fall of the entropy of what is asked about, by evidence about s of that precision [nat]."""
        before = self.belief.precision + jnp.diag(self.belief.site_precision)
        better = jnp.sum(lower_inverse(jnp.linalg.cholesky(before + precision)) ** 2, axis=0)
        noise = 1 / jnp.maximum(1 / better - 1 / self.known, FAINT)
        return jnp.sum(jnp.where(self.about, expected_fall(self.mixture, noise), 0.0))

    def outcome(self, candidate: CandidatePull, s: Float[Array, " n"], *, informative: bool = True) -> Outcome:
        """Of a tug in a scenario; the gain costs as much as the rest, and is 0 where it is not asked for.

        Two programs, so that what is the same with and without the gain is compiled once.
        """
        found = self.ending(candidate, s)
        return eqx.tree_at(lambda one: one.gain, found, self.shown(candidate, s, found.x)) if informative else found

    @eqx.filter_jit
    def ending(self, candidate: CandidatePull, s: Float[Array, " n"]) -> Outcome:
        """Where a tug ends in a scenario and what it asks of the attachments; nothing is said of the gain."""
        balance = self.balance
        x = balance.predict(
            jnp.where(candidate.held[:, None], candidate.to, candidate.start), s, self._seen(candidate, candidate.to)
        )
        b, squared = balance.reference * s / (1 - s), jnp.sum((x - balance.energy.rest) ** 2, axis=1)
        force = jnp.max(b * jnp.sqrt(squared))
        return Outcome(x=x, gain=jnp.zeros(()), energy=0.5 * b @ squared / len(s), force=force)

    @eqx.filter_jit
    def shown(self, candidate: CandidatePull, s: Float[Array, " n"], x: Float[Array, "n 3"]) -> Float[Array, ""]:
        """Gain by a look at where a tug ends in a scenario [nat]."""
        frame = self.balance.linearise(x, s, self._seen(candidate, x))
        return self.gain(self.balance.information(frame, self.balance.fit(frame)).precision)

    def _seen(self, candidate: CandidatePull, y: Float[Array, "n 3"]) -> Evidence:
        precision = jnp.broadcast_to(self.precision[None], (len(y), 3, 3))
        return Evidence(y=y, precision=precision, held=candidate.held, force_unknown=candidate.force_unknown)


@eqx.filter_jit
def _believed(belief: AttachmentBelief) -> tuple[Mixture, Gaussian]:
    return belief.mixture(), belief.gaussian()


def expected_fall(mixture: Mixture, noise: Float[Array, " n"]) -> Float[Array, " n"]:
    """Of 1/2 ln of each variable's variance, by one measurement with noise of the given variance.

    The normals of the mixture are not cut off to [0, 1]; each is integrated over by Gauss-Hermite quadrature.
    """
    weight, mean, width = mixture.weight, mixture.mean, mixture.sd**2
    node, share = (jnp.asarray(part) for part in np.polynomial.hermite_e.hermegauss(NODES))
    total = width + noise[None]
    log_weight = jnp.log(jnp.maximum(weight, 1e-300)) - 0.5 * jnp.log(total)

    def after(read: Float[Array, " n"]) -> Float[Array, " n"]:
        """1/2 ln of the variance left when that is read."""
        told = jax.nn.softmax(log_weight - 0.5 * (read[None] - mean) ** 2 / total, axis=0)
        return 0.5 * jnp.log(_variance(told, mean + width / total * (read[None] - mean), width * noise[None] / total))

    reads = mean[None] + jnp.sqrt(total)[None] * node[:, None, None]
    left = jax.vmap(jax.vmap(after))(reads)
    expected = jnp.einsum("q,cn,qcn->n", share / jnp.sum(share), weight, left)
    return 0.5 * jnp.log(_variance(weight, mean, width)) - expected


def _variance(weight: Float[Array, "c n"], mean: Float[Array, "c n"], width: Float[Array, "c n"]) -> Float[Array, " n"]:
    middle = jnp.sum(weight * mean, axis=0)
    return jnp.sum(weight * (width + (mean - middle[None]) ** 2), axis=0)


NODES = 5
"""Of the quadrature over each normal of a mixture."""
FAINT = 1e-6
"""Least precision of a measurement."""
