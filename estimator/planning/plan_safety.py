"""Which pulls a plan allows: energies and forces in the scenarios of the belief against their limits.

A step is safe if neither the mean boundary energy nor the force on any attachment exceeds its limit, less a margin,
with more than the allowed chance. The square root of the energy, and the force, are taken as normal over the scenarios.
"""

from dataclasses import dataclass
from statistics import NormalDist

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jiggle_mj.limits import Limits

from .outcomes import outcomes
from .pull_predictor import CandidatePull, Outcome, PullPredictor


@dataclass(frozen=True, kw_only=True)
class PlanSafety:
    """Limits that a plan keeps to."""

    energy: float
    """Largest mean boundary energy [J]."""
    force: float
    """Largest force on one attachment [N]."""
    chance: float
    """Largest probability of exceeding one of the two."""

    @classmethod
    def within(cls, limits: Limits, *, limit_share: float) -> "PlanSafety":
        """Return the safety of a plan that keeps to a share of the limits."""
        return cls(energy=limit_share * limits.energy, force=limit_share * limits.force, chance=limits.chance)

    def allowed_gain(self, found: Outcome, *, energy_ratio: float = 1.0) -> Float[np.ndarray, "k scenarios"]:
        """Return the gains [nat], 0 where a limit is exceeded or the prediction is not finite.

        Args:
            found: outcomes of k pulls in each scenario.
            energy_ratio: factor of all energies; see `observed_energy_ratio`.
        """
        allowed = (energy_ratio * found.energy <= self.energy) & (found.force <= self.force)
        return np.where(allowed, np.nan_to_num(found.gain), 0.0)

    def is_safe(
        self,
        predictor: PullPredictor,
        candidate: CandidatePull,
        s: Float[Array, "scenarios n"],
        *,
        energy_ratio: float = 1.0,
    ) -> bool:
        """Return whether one pull exceeds a limit with no more than the allowed chance.

        Args:
            predictor: predicts the pull.
            candidate: one pull.
            s: scenarios that are representative of the belief.
            energy_ratio: factor of all energies; see `observed_energy_ratio`.
        """
        found = outcomes(predictor, candidate, s, informative=False)
        sds = NormalDist().inv_cdf(1 - self.chance)
        for values, limit in ((jnp.sqrt(energy_ratio * found.energy), self.energy**0.5), (found.force, self.force)):
            if not float(jnp.mean(values) + sds * jnp.std(values)) <= limit:
                return False
        return True


def observed_energy_ratio(
    predictor: PullPredictor, candidate: CandidatePull, s: Float[Array, "scenarios n"], *, min_energy: float
) -> float:
    """Return observed over predicted mean boundary energy, each the median over the scenarios; at least 1.

    A plan multiplies the predicted energies of further pulls from the same grasp by it.

    Args:
        predictor: predicts the energy.
        candidate: the pull from where the particles are observed to where the tip is now.
        s: the scenarios.
        min_energy: a smaller predicted energy counts as this [J].
    """
    squared = jnp.sum((candidate.start[0] - predictor.balance.energy.rest) ** 2, axis=1)
    observed = 0.5 * jnp.median(predictor.stiffness(s) @ squared) / len(squared)
    predicted = jnp.median(outcomes(predictor, candidate, s, informative=False).energy)
    return max(1.0, float(observed / jnp.maximum(predicted, min_energy)))
