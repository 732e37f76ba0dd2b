"""What is ranked in simulation-based calibration: functions of all attachments, and their posteriors.

Each quantity has a posterior by joint draws, and, where the belief states one, by what it reports: the mixture of a
particle's marginal, and the normal distribution of a sum.
"""

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.stats import truncnorm

from jiggle_mj.estimate import Belief
from jiggle_mj.estimator import EstimatorConfig
from jiggle_mj.estimator.belief.attachment_belief import AttachmentBelief
from jiggle_mj.estimator.physics.energy import SheetEnergy
from jiggle_mj.estimator.physics.environment import Grip
from jiggle_mj.estimator.physics.equilibrium import equilibrium
from jiggle_mj.estimator.physics.mesh import SheetMesh
from jiggle_mj.estimator.physics.surrogate import surrogate
from jiggle_mj.observation import Declaration

from ..metrics.rank_statistics import Ranked, ranked, ranked_by_normal, ranked_by_probability

PATCH_SHARE = 0.25
"""Radius of the patch in the middle over the longer side of the sheet."""
PULL_SHARE = 0.2
"""Height of the pull that is predicted, over the longer side of the sheet: enough that what is attached is loaded."""
PULL_RADIUS = 0.15
"""Radius of its grip, over the same."""
PULL_TOLERANCE = 1e-5
"""Residual force of a predicted equilibrium [N]; a particle weighs 2e-4."""
MAX_PULL_STEPS = 200
"""Most steps of the search for it."""
PREDICTED = "mean height of a predicted pull"
"""Name of the quantity that needs an equilibrium for each draw."""

Scalar = Callable[[Float[np.ndarray, " n"]], float]
"""Function of the bounded stiffness of all particles."""


@dataclass(frozen=True, kw_only=True)
class Quantities:
    """The quantities of one sheet."""

    places: dict[str, int]
    """Particles whose own b is ranked, by where they are."""
    patch: Bool[np.ndarray, " n"]
    """Particles of the patch in the middle."""
    k: float
    """Membrane stiffness, b_ref [N/m]."""
    largest: float
    """Bounded stiffness from which on stiffer attachments count as this one, so that a sum is finite."""
    predict: Callable[[Float[np.ndarray, "m n"]], Float[np.ndarray, " m"]]
    """Mean height of the sheet in a pull at the corner opposite to the one that was lifted [m], for each of some s."""

    @classmethod
    def build(cls, mesh: SheetMesh, declaration: Declaration) -> "Quantities":
        """Return the quantities of a flat sheet whose first corner (-, -) is lifted."""
        flat = mesh.rest[:, :2] - mesh.rest[:, :2].mean(axis=0)
        half = np.abs(flat).max(axis=0)
        at = {"middle": (0, 0), "beside the grip": (-0.6, -0.6), "edge": (0.9, 0), "far corner": (0.9, 0.9)}
        nearest = {name: int(np.argmin(np.sum((flat - half * place) ** 2, axis=1))) for name, place in at.items()}
        side = 2 * half.max()
        return cls(
            places=nearest,
            patch=np.linalg.norm(flat, axis=1) <= PATCH_SHARE * side,
            k=declaration.membrane_stiffness,
            largest=EstimatorConfig().belief.open_above,
            predict=_prediction(mesh, declaration, float(side)),
        )

    def b(self, s: Float[np.ndarray, "*m"]) -> Float[np.ndarray, "*m"]:
        """Return the stiffness that counts in a sum [N/m]."""
        s = np.clip(s, 0, self.largest)
        return self.k * s / (1 - s)

    def by_draws(
        self, truth: Float[np.ndarray, " n"], draws: Float[np.ndarray, "m n"], rng: np.random.Generator
    ) -> dict[str, Ranked]:
        """Return the rank of each quantity of the true s among draws of s."""
        functions: dict[str, Scalar] = {
            **{f"b, {place}": lambda s, i=i: float(self.b(s)[i]) for place, i in self.places.items()},
            "number attached": lambda s: float(np.sum(s > 0)),
            "sum of b": lambda s: float(self.b(s).sum()),
            "sum of b over a patch": lambda s: float(self.b(s)[self.patch].sum()),
        }
        found = {name: ranked(f(truth), np.array([f(s) for s in draws]), rng) for name, f in functions.items()}
        heights = self.predict(np.vstack([truth[None], draws]))
        return found | {PREDICTED: ranked(float(heights[0]), heights[1:], rng)}

    def by_belief(
        self, truth: Float[np.ndarray, " n"], attachments: AttachmentBelief, belief: Belief, rng: np.random.Generator
    ) -> dict[str, Ranked]:
        """Return the rank of each quantity by what the belief states of it: marginals of b, and normal sums."""
        mixture, s = attachments.mixture(), np.clip(belief.mean, 0, self.largest)
        transfer = np.diagonal(belief.covariance) - np.asarray(attachments.gaussian().variance)
        weight, mean = (np.asarray(part) for part in (mixture.weight, mixture.mean))
        sd = np.sqrt(np.asarray(mixture.sd) ** 2 + np.maximum(transfer, 0))
        b, db_ds = self.b(s), self.k / (1 - s) ** 2
        own_sd = db_ds * np.sqrt(np.diagonal(belief.covariance))
        found = {}
        for place, i in self.places.items():
            low, high = -mean[1:, i] / sd[1:, i], (1 - mean[1:, i]) / sd[1:, i]
            below = truncnorm.cdf(truth[i], low, high, loc=mean[1:, i], scale=sd[1:, i]) @ weight[1:, i]
            free = float(weight[0, i])
            found[f"b, {place}"] = ranked_by_probability(
                float(self.b(truth)[i]),
                float(below) + free * (truth[i] > 0),
                free * (truth[i] == 0),
                mean=float(b[i]),
                sd=float(own_sd[i]),
                u=rng.random(),
            )
        for name, chosen in {"sum of b": np.ones(len(s), bool), "sum of b over a patch": self.patch}.items():
            total, spread = float(b[chosen].sum()), belief.deviation_of_sum(b, chosen)
            found[name] = ranked_by_normal(float(self.b(truth)[chosen].sum()), mean=total, sd=spread)
        return found


def _prediction(mesh: SheetMesh, declaration: Declaration, side: float) -> Callable:
    """Return the function `Quantities.predict`."""
    corner = mesh.rest[np.argmax(mesh.rest[:, :2].sum(axis=1))]
    energy = surrogate(mesh, declaration)
    stiff = EstimatorConfig().grip_stiffness * declaration.membrane_stiffness
    grip = Grip.build(jnp.asarray(mesh.rest), jnp.asarray(corner), radius=PULL_RADIUS * side, stiffness=stiff)
    grip = eqx.tree_at(lambda g: g.tip, grip, jnp.asarray(corner + np.array([0.0, 0.0, PULL_SHARE * side])))
    gripped = SheetEnergy.build(mesh.rest, (*energy.terms, grip), energy.layout)
    k = declaration.membrane_stiffness

    @eqx.filter_jit
    def heights(gripped: SheetEnergy, s: Float[Array, "m n"]) -> Float[Array, " m"]:
        def height(one):
            found = equilibrium(
                gripped, k * one / (1 - one), gripped.rest, force_tolerance=PULL_TOLERANCE, max_steps=MAX_PULL_STEPS
            )
            return jnp.mean(found.x[:, 2])

        return jax.lax.map(height, s)

    largest = EstimatorConfig().belief.open_above
    return lambda s: np.asarray(heights(gripped, jnp.asarray(np.minimum(s, largest))))
