"""Our policy: the pull, here or elsewhere, that is expected to teach most for each step, as far as it is safe.

Each plan predicts pulls of a few steps from where the jaws are, in several directions, and lifts from other places. A
lift from elsewhere counts with the steps of letting go and grasping again.

The energy that was predicted for where the tip is now is compared with what the scenarios give for where the particles
are observed. Further pulls from here count with that ratio where the prediction was too low. Particles in the jaws and
their neighbours, on which no force can be observed, are taken to be free. Therefore no place inside the sheet is
grasped that is not known to be free, and the first grasp is on the border.
"""

from dataclasses import replace
from itertools import product

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from jiggle_mj.actions import Action, Grasp, Move, Release
from jiggle_mj.errors import ActionError
from jiggle_mj.limits import Limits

from ..blas import one_thread
from ..estimator import Estimator
from .grasp_places import GraspPlaces
from .information_config import DIRECTIONS, InformationPolicyConfig
from .outcomes import outcomes
from .plan_safety import PlanSafety, observed_energy_ratio
from .policy import Policy, in_mm
from .pull_predictor import CandidatePull, PullPredictor
from .tool_kinematics import ToolKinematics
from .workspace import Workspace

ARRIVED = 0.1
"""Share of a step within which the tip counts as back where the jaws closed."""


class InformationPolicy(Policy):
    """Policy that maximises the expected gain of information per step on one sheet."""

    def __init__(
        self,
        limits: Limits,
        *,
        radius: float,
        seed: int,
        tweezer: ToolKinematics | None = None,
        regrasps: bool = True,
        min_gain: float | None = None,
        about: Bool[np.ndarray, " n"] | None = None,
        config: InformationPolicyConfig | None = None,
    ) -> None:
        """Set what is allowed and what is asked.

        Args:
            limits: on the attachments, and on where the tip may go.
            radius: of the jaws [m].
            seed: of the scenarios.
            tweezer: kept clear of the bed; if None, nothing but the tip is known of the tool.
            regrasps: whether to let go and grasp elsewhere; if not, somebody else closes the jaws.
            min_gain: replaces the config's [nat per particle and step].
            about: particles whose attachments are asked about; all if None.
            config: the policy's numbers; the defaults if None.
        """
        super().__init__()
        config = config or InformationPolicyConfig()
        self._config = config if min_gain is None else replace(config, min_gain=min_gain)
        self.regrasps, self._about, self._limits, self._tweezer = regrasps, about, limits, tweezer
        self._radius, self._key = radius, jax.random.key(seed)
        self._safety = PlanSafety.within(limits, limit_share=config.limit_share)
        self._places = GraspPlaces(config, self._safety, radius=radius)
        self._place: int | None = None
        self._leaving = self._over = ""

    def leave(self, why: str) -> None:
        """Plan no more than what it takes to let go.

        Args:
            why: what the policy then says.
        """
        self._over = why

    def refused(self, error: ActionError) -> bool:
        """See `Policy.refused`: where the jaws have missed the tissue, they are not closed again."""
        if self._place is None:
            return super().refused(error)
        self._places.missed.add(self._place)
        return True

    def plan(self, estimator: Estimator) -> tuple[Action, str] | str:
        """See `Policy.plan`."""
        self._place = None
        estimator.begin()
        with jax.enable_x64(True), one_thread():
            hold, tool = estimator.hold, estimator.tool
            predictor = PullPredictor.from_estimator(estimator, self._about)
            if tool is None or not tool.closed:
                return self._grasp(estimator, predictor) if self.regrasps else self._leaving or "nothing is grasped"
            if hold is None:
                return Release(), "no frame has shown what the jaws hold"
            if estimator.slip > self._config.max_slip:
                self._leaving = f"the tissue has slipped out of the jaws by {1e3 * estimator.slip:.0f} mm"
            if self._leaving:
                return Release(), self._leaving
            pull = None if self._over else self.best_pull(estimator, predictor)
            if self._over:
                self._leaving = self._over
            elif pull is not None:
                to, rate = pull
                elsewhere = self._best_place(estimator, predictor, min_rate=rate) if self.regrasps else None
                if rate >= self._config.min_gain * len(estimator.sheet.rest) and elsewhere is None:
                    return Move(to=to), f"{rate:.0f} nat a step"
                self._leaving = "another place teaches more" if elsewhere is not None else "little is left to learn"
            elif self._reached(estimator, tool.position + self._config.step * DIRECTIONS).any():
                self._leaving = "no pull from here is safe"
            else:
                self._leaving = f"the tip at {in_mm(tool.position)} is out of reach, or the tool touches the bed"
            if not self.regrasps:
                return self._leaving
            if np.linalg.norm(tool.position - hold.tip) < ARRIVED * self._config.step:
                return Release(), self._leaving
            return Move(to=hold.tip), self._leaving

    def best_pull(self, estimator: Estimator, predictor: PullPredictor) -> tuple[Float[np.ndarray, " 3"], float] | None:
        """Return where the tip goes next [m], and the expected gain of each step of that pull [nat].

        Args:
            estimator: with tissue in the jaws.
            predictor: predicts the pulls.

        Returns:
            None if no pull is safe.
        """
        config, hold, tool = self._config, estimator.hold, estimator.tool
        assert hold is not None and tool is not None
        gain_scenarios, safety_scenarios = self._draw_scenarios(predictor)
        start, force_unknown = jnp.asarray(estimator.positions), jnp.asarray(estimator.force_unknown(hold.held))

        def candidates(tips: Float[np.ndarray, "k 3"]) -> CandidatePull:
            to = jnp.asarray(hold.closed_at + (tips - hold.tip)[:, None])
            return CandidatePull.of_grip(start=start, held=jnp.asarray(hold.held), force_unknown=force_unknown, to=to)

        energy_ratio = observed_energy_ratio(
            predictor,
            candidates(tool.position[None]),
            safety_scenarios,
            min_energy=config.min_checked_energy * self._limits.energy,
        )

        ends, lengths = tool.position + config.pulls, np.tile(config.pull_lengths, len(DIRECTIONS))
        reached = self._reached(estimator, ends)

        def rates(which: Int[np.ndarray, " k"], s: Float[Array, "_few n"]) -> Float[np.ndarray, " k"]:
            found = outcomes(predictor, candidates(ends[which]), s)
            gain = self._safety.allowed_gain(found, energy_ratio=energy_ratio).mean(axis=1)
            return np.where(reached[which], gain / np.maximum(lengths[which], 1), 0.0)

        n = config.n_gain_scenarios
        first = rates(np.arange(len(ends)), gain_scenarios[:1])
        refined = np.argsort(-first)[: config.n_refined_pulls]
        rate = np.zeros(len(ends))
        rate[refined] = (first[refined] + (n - 1) * rates(refined, gain_scenarios[1:])) / n
        best = [i for i in np.argsort(-rate)[: config.n_safety_checks] if rate[i] > 0]
        for share, i in product(config.step_shares, best):
            direction = DIRECTIONS[i // len(config.pull_lengths)]
            tip = tool.position + share * config.step * min(lengths[i], 1) * direction
            if self._safety.is_safe(predictor, candidates(tip[None]), safety_scenarios, energy_ratio=energy_ratio):
                return tip, float(rate[i])
        return None

    def _grasp(self, estimator: Estimator, predictor: PullPredictor) -> tuple[Action, str] | str:
        """Plan with open jaws."""
        self._leaving = ""
        if self._over:
            return self._over
        probability, decided = np.asarray(predictor.mixture.attached), self._config.decided_probability
        undecided = np.asarray(predictor.about) & (np.minimum(probability, 1 - probability) > decided)
        if not undecided.any():
            return f"enough is known: every P(attached) is below {decided:g} or above {1 - decided:g}"
        min_rate = self._config.min_gain * len(undecided)
        self._places.forget_rates()
        place = self._best_place(estimator, predictor, min_rate=min_rate)
        if not self._places.rates:
            return "no place of the sheet is within the tool's reach"
        if place is None:
            count = f"{int(undecided.sum())} of {len(undecided)} are not decided"
            return f"no safe pull teaches {min_rate:.2g} nat a step; {count}"
        self._place = place
        grasp = Grasp(point=estimator.positions[place], radius=self._radius)
        return grasp, f"{self._places.rates[place]:.0f} nat a step"

    def _best_place(self, estimator: Estimator, predictor: PullPredictor, *, min_rate: float) -> int | None:
        gain_scenarios, safety_scenarios = self._draw_scenarios(predictor)
        return self._places.best(
            estimator,
            predictor,
            self._workspace(estimator),
            gain_scenarios=gain_scenarios,
            safety_scenarios=safety_scenarios,
            min_rate=min_rate,
        )

    def _workspace(self, estimator: Estimator) -> Workspace:
        return Workspace.around(estimator, self._limits, self._tweezer)

    def _reached(self, estimator: Estimator, tips: Float[np.ndarray, "k 3"]) -> Bool[np.ndarray, " k"]:
        assert estimator.tool is not None
        return self._workspace(estimator).reached(tips, estimator.tool)

    def _draw_scenarios(self, predictor: PullPredictor) -> tuple[Float[Array, "few n"], Float[Array, "many n"]]:
        """Draw the scenarios that gains are the mean of, and those that decide whether a pull is safe."""
        self._key, gain_key, safety_key = jax.random.split(self._key, 3)
        unknown = jnp.asarray(self._limits.unknown)
        return (
            _scenarios(predictor, gain_key, self._config.n_gain_scenarios, unknown),
            _scenarios(predictor, safety_key, self._config.n_safety_scenarios, unknown),
        )


@eqx.filter_jit
def _scenarios(
    predictor: PullPredictor, key: PRNGKeyArray, count: int, unknown: Float[Array, ""]
) -> Float[Array, "count n"]:
    return predictor.scenarios(key, count, unknown=unknown)
