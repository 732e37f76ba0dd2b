"""Where to grasp next: the place from which a lift is expected to teach most for each step, as far as it is safe.

While a grasp lasts, a place keeps its last computed rate until it would be the best. New evidence mostly lowers a rate,
so only the best are computed again [lazy greedy: Minoux 1978, doi:10.1007/BFb0006528].
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..estimator import Estimator
from ..physics.mesh import SheetMesh, farthest_points
from .information_config import DIRECTIONS, InformationPolicyConfig
from .outcomes import outcomes
from .plan_safety import PlanSafety
from .pull_predictor import CandidatePull, PullPredictor
from .workspace import Workspace


class GraspPlaces:
    """Candidate grasps of one sheet, with the gain that each step of a lift from there is expected to give."""

    def __init__(self, config: InformationPolicyConfig, safety: PlanSafety, *, radius: float) -> None:
        """Start without places; the first search chooses them.

        Args:
            config: the policy's numbers.
            safety: limits that a lift keeps to.
            radius: of the jaws [m].
        """
        self._config, self._safety, self._radius = config, safety, radius
        self._border: Bool[np.ndarray, " n"] = np.zeros(0, dtype=bool)
        self.rates: dict[int, float] = {}
        """Gain per step [nat] by particle; infinite where it is not computed yet."""
        self.missed: set[int] = set()
        """Particles where the jaws closed and missed the tissue: they are not tried again."""

    def forget_rates(self) -> None:
        """Mark all rates as not computed, as a grasp has ended."""
        self.rates = dict.fromkeys(self.rates, np.inf)

    def best(
        self,
        estimator: Estimator,
        predictor: PullPredictor,
        workspace: Workspace,
        *,
        gain_scenarios: Float[Array, "few n"],
        safety_scenarios: Float[Array, "many n"],
        min_rate: float,
    ) -> int | None:
        """Return the particle from which a safe lift has the largest rate; None if none is above `min_rate` [nat]."""
        rest = estimator.sheet.rest
        if not self.rates:
            self._choose_places(estimator, workspace)
        probability = np.asarray(predictor.mixture.attached)
        current_tip = None if estimator.hold is None else estimator.hold.tip
        computed: set[int] = set()
        while max(self.rates.values(), default=0.0) > min_rate:
            place = max(self.rates, key=lambda particle: self.rates[particle])
            held = np.linalg.norm(rest - rest[place], axis=1) <= self._radius
            if place in computed:
                first_step = self._lift(estimator, held, np.array([self._config.step]))
                if self._safety.is_safe(predictor, first_step, safety_scenarios):
                    return place
                self.rates[place] = 0.0
                continue
            computed.add(place)
            held_already = current_tip is not None and np.linalg.norm(rest[place] - current_tip) < self._radius
            graspable = self._config.graspable_border if self._border[place] else self._config.graspable_inside
            suspect = probability[estimator.force_unknown(held)].max() > graspable
            excluded = held_already or suspect or place in self.missed
            self.rates[place] = 0.0 if excluded else self._lift_rate(estimator, predictor, held, gain_scenarios)
        return None

    def _choose_places(self, estimator: Estimator, workspace: Workspace) -> None:
        """Spread places over the sheet, and keep those that the tool reaches."""
        rest = estimator.sheet.rest
        self._border = SheetMesh(rest, estimator.sheet.faces).border
        places = farthest_points(rest, self._config.n_places)
        assert estimator.tool is not None
        self.rates = dict.fromkeys(places[workspace.reached(rest[places], estimator.tool)].tolist(), np.inf)

    def _lift_rate(
        self,
        estimator: Estimator,
        predictor: PullPredictor,
        held: Bool[np.ndarray, " n"],
        scenarios: Float[Array, "_few n"],
    ) -> float:
        """Return the expected gain of a lift per step [nat], the steps of letting go and grasping included.

        In each scenario the lift ends where the next height is not allowed any more.
        """
        heights = np.array(self._config.lift_heights)
        found = outcomes(predictor, self._lift(estimator, held, self._config.step * heights), scenarios)
        best = np.maximum.accumulate(self._safety.allowed_gain(found), axis=0)
        return float((best.mean(axis=1) / (self._config.regrasp_steps + heights)).max())

    def _lift(
        self, estimator: Estimator, held: Bool[np.ndarray, " n"], heights: Float[np.ndarray, " k"]
    ) -> CandidatePull:
        """Return the lifts of what is held to some heights [m] from the resting sheet."""
        rest = estimator.sheet.rest
        return CandidatePull.of_grip(
            start=jnp.asarray(rest),
            held=jnp.asarray(held),
            force_unknown=jnp.asarray(estimator.force_unknown(held)),
            to=jnp.asarray(rest[None] + heights[:, None, None] * DIRECTIONS[0]),
        )
