"""Our policy: the pull, here or elsewhere, that is expected to teach most for each step, as far as it is safe.

Each plan looks a few steps ahead from where the jaws are, in several directions, and at lifts from other places. While
a grasp lasts, a place keeps its worth until it would be the best: what is learned mostly lowers it, so only the best
are looked at again [lazy greedy: Minoux 1978, doi:10.1007/BFb0006528]. Letting go and grasping again costs `REGRASP`
steps.

Safe is a step after which, in the scenarios of the belief, neither the mean boundary energy nor the force on any
attachment passes its limit, less a margin, with more than the allowed chance: their square root and it are taken as
normal over the scenarios. What the energy was predicted to be where the tip is now is held against what the scenarios
make of where the particles are seen: by as much as it was too low, pulls from here are reckoned with more. Particles
in the jaws and their neighbours, on which no force can be seen, are taken to be free: inside the sheet no place is
grasped that is not known to be, and the first is on its edge.
"""

from itertools import product
from statistics import NormalDist

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
from ..physics.mesh import SheetMesh, far_apart
from .outcomes import outcomes
from .policy import STEP, Policy, in_mm
from .pull_predictor import CandidatePull, Outcome, PullPredictor
from .tool_kinematics import ToolKinematics
from .workspace import Workspace

AHEAD = (0.5, 1, 3)
"""Steps that a pull is followed for, where the jaws are; each direction is worth what the best of them teaches."""
LIFTS = (1, 3, 6)
"""Steps of the lifts that other places are judged by."""
REGRASP = 3
"""Steps that lowering, letting go and grasping again cost."""
PLACES = 12
"""Of grasps, spread over the sheet."""
TRIED = 3
"""Pulls, best first, that are looked at for a safe one."""
EXPECTED, JUDGED = 2, 16
"""Scenarios that a gain is the mean of, and that a step's safety is judged by."""
LIKELY = 9
"""Pulls, best in one scenario, that are looked at in all of them."""
ENOUGH = 0.004
"""A gain for which no step is worth taking [nat per particle]."""
MARGIN = 0.75
"""Share of the limits that a plan keeps to: it does not know by how much its model errs. A step that all scenarios put
below the limit has exceeded it by 0.3."""
SHORTER = (1.0, 0.5)
"""Shares of a step that are tried, where the whole is not safe."""
DECIDED = 0.05
"""P(attached) or P(free) of a particle about which enough is known."""
KNOWN, SUSPECTED = 0.02, 0.2
"""P(attached) up to which a place may be grasped, inside the sheet and on its edge."""
TRIFLE = 0.1
"""Share of the limit on the energy below which a prediction is not held against what is seen."""
LOST = 5e-3
"""Slip from which the tissue is no longer in the jaws [m]."""
UP = np.array([[0.0, 0.0, 1.0]])
ALONG = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], dtype=float)
SLANTED = 0.5**0.5 * (ALONG + UP)
DIRECTIONS = np.concatenate([UP, ALONG, SLANTED])
"""Up, along the sheet, and between."""
PULLS = np.kron(DIRECTIONS, STEP * np.array(AHEAD)[:, None])
"""Where the tip may be pulled from where it is [m]: every direction as far as `AHEAD` says, one after the other."""


class InformationPolicy(Policy):
    """Plans for one sheet."""

    def __init__(
        self,
        limits: Limits,
        *,
        radius: float,
        seed: int,
        tweezer: ToolKinematics | None = None,
        regrasps: bool = True,
        enough: float = ENOUGH,
        about: Bool[np.ndarray, " n"] | None = None,
    ) -> None:
        """Say what is allowed.

        Args:
            limits: on the attachments, and on where the tip may go.
            radius: of the jaws [m].
            seed: draws the scenarios.
            tweezer: kept clear of the bed; if None, nothing but the tip is known of the tool.
            regrasps: whether to let go and grasp elsewhere; if not, the jaws are closed by somebody else.
            enough: a gain for which no step is worth taking [nat per particle].
            about: particles whose attachments are asked about; all if None.
        """
        super().__init__()
        self.regrasps, self._enough, self._about = regrasps, enough, about
        self._limits, self._radius, self._tweezer, self._key = limits, radius, tweezer, jax.random.key(seed)
        self._energy, self._force = MARGIN * limits.energy, MARGIN * limits.force
        self._worth: dict[int, float] = {}
        self._place: int | None = None
        self._missed: set[int] = set()
        self._leaving = self._over = ""

    def leave(self, why: str) -> None:
        """Plan no more than what it takes to let go."""
        self._over = why

    def refused(self, error: ActionError) -> bool:
        """See `Policy.refused`: where the jaws have missed the tissue, they are not closed again."""
        if self._place is None:
            return super().refused(error)
        self._missed.add(self._place)
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
            if estimator.slip > LOST:
                self._leaving = f"the tissue has slipped out of the jaws by {1e3 * estimator.slip:.0f} mm"
                return Release(), self._leaving
            if self._leaving:
                return Release(), self._leaving
            enough = self._enough * len(estimator.sheet.rest)
            found = None if self._over else self._best_pull(estimator, predictor)
            if self._over:
                self._leaving = self._over
            elif found is not None:
                to, rate = found
                elsewhere = self._best_place(estimator, predictor, above=rate) if self.regrasps else None
                if rate >= enough and elsewhere is None:
                    return Move(to=to), f"{rate:.0f} nat a step"
                self._leaving = "another place teaches more" if elsewhere is not None else "little is left to learn"
            elif self._reached(estimator, tool.position + STEP * DIRECTIONS).any():
                self._leaving = "no pull from here is safe"
            else:
                self._leaving = f"the tip at {in_mm(tool.position)} is out of reach, or the tool touches the bed"
            if not self.regrasps:
                return self._leaving
            if np.linalg.norm(tool.position - hold.tip) < STEP / 10:
                return Release(), self._leaving
            return Move(to=hold.tip), self._leaving

    def _grasp(self, estimator: Estimator, predictor: PullPredictor) -> tuple[Action, str] | str:
        self._leaving = ""
        if self._over:
            return self._over
        probability = np.asarray(predictor.mixture.attached)
        unsure = np.asarray(predictor.about) & (np.minimum(probability, 1 - probability) > DECIDED)
        if not unsure.any():
            return f"enough is known: every P(attached) is below {DECIDED:g} or above {1 - DECIDED:g}"
        enough, self._worth = self._enough * len(unsure), dict.fromkeys(self._worth, np.inf)
        place = self._best_place(estimator, predictor, above=enough)
        if not self._worth:
            return "no place of the sheet is within the tool's reach"
        if place is None:
            return f"no safe pull teaches {enough:.2g} nat a step; {int(unsure.sum())} of {len(unsure)} are not decided"
        self._place = place
        return Grasp(point=estimator.positions[place], radius=self._radius), f"{self._worth[place]:.0f} nat a step"

    def _best_pull(
        self, estimator: Estimator, predictor: PullPredictor
    ) -> tuple[Float[np.ndarray, " 3"], float] | None:
        """Where the tip goes next, and what each step that way is expected to teach [nat]; None if nothing is safe."""
        hold, tool = estimator.hold, estimator.tool
        assert hold is not None and tool is not None
        few, many = self._drawn(predictor)
        start = estimator.positions

        def candidates(tips: Float[np.ndarray, "k 3"]) -> CandidatePull:
            return self._candidates(estimator, hold.held, start, hold.closed_at + (tips - hold.tip)[:, None])

        more = underrated(predictor, candidates(tool.position[None]), many, least=TRIFLE * self._limits.energy)

        ends, ahead = tool.position + PULLS, np.tile(AHEAD, len(DIRECTIONS))
        reached = self._reached(estimator, ends)

        def rates(which: Int[np.ndarray, " k"], s: Float[Array, "_few n"]) -> Float[np.ndarray, " k"]:
            gain = self._allowed_gain(outcomes(predictor, candidates(ends[which]), s), more=more).mean(axis=1)
            return np.where(reached[which], gain / np.maximum(ahead[which], 1), 0.0)

        first = rates(np.arange(len(ends)), few[:1])
        likely = np.argsort(-first)[:LIKELY]
        rate = np.zeros(len(ends))
        rate[likely] = (first[likely] + (EXPECTED - 1) * rates(likely, few[1:])) / EXPECTED
        best = [i for i in np.argsort(-rate)[:TRIED] if rate[i] > 0]
        for share, i in product(SHORTER, best):
            tip = tool.position + share * STEP * min(ahead[i], 1) * DIRECTIONS[i // len(AHEAD)]
            if self._safe(predictor, candidates(tip[None]), many, more=more):
                return tip, float(rate[i])
        return None

    def _best_place(self, estimator: Estimator, predictor: PullPredictor, *, above: float) -> int | None:
        """The particle from which a lift teaches most for each step; None if that is not more than `above`."""
        rest = estimator.sheet.rest
        if not self._worth:
            self._edge = SheetMesh(rest, estimator.sheet.faces).border
            places = far_apart(rest, PLACES)
            self._worth = dict.fromkeys(places[self._reached(estimator, rest[places])].tolist(), np.inf)
        probability = np.asarray(predictor.mixture.attached)
        few, many = self._drawn(predictor)
        here = None if estimator.hold is None else estimator.hold.tip
        fresh: set[int] = set()
        while max(self._worth.values(), default=0.0) > above:
            best = max(self._worth, key=lambda place: self._worth[place])
            held = np.linalg.norm(rest - rest[best], axis=1) <= self._radius
            if best in fresh:
                if self._safe(
                    predictor, self._candidates(estimator, held, rest, rest[None] + STEP * DIRECTIONS[:1, None]), many
                ):
                    return best
                self._worth[best] = 0.0
                continue
            fresh.add(best)
            at_hand = here is not None and np.linalg.norm(rest[best] - here) < self._radius
            suspect = probability[estimator.force_unknown(held)].max() > (SUSPECTED if self._edge[best] else KNOWN)
            barred = at_hand or suspect or best in self._missed
            self._worth[best] = 0.0 if barred else self._lifted(estimator, predictor, held, few)
        return None

    def _lifted(
        self, estimator: Estimator, predictor: PullPredictor, held: Bool[np.ndarray, " n"], few: Float[Array, "_few n"]
    ) -> float:
        """What each step of a lift is expected to teach [nat], letting go and grasping counted.

        In each scenario the lift ends where it would no longer be allowed.
        """
        rest, heights = estimator.sheet.rest, STEP * np.array(LIFTS)
        found = outcomes(
            predictor, self._candidates(estimator, held, rest, rest[None] + heights[:, None, None] * DIRECTIONS[0]), few
        )
        best = np.maximum.accumulate(self._allowed_gain(found), axis=0)
        return float((best.mean(axis=1) / (REGRASP + np.array(LIFTS))).max())

    def _reached(self, estimator: Estimator, tips: Float[np.ndarray, "k 3"]) -> Bool[np.ndarray, " k"]:
        assert estimator.tool is not None
        return Workspace.around(estimator, self._limits, self._tweezer).reached(tips, estimator.tool)

    def _candidates(
        self,
        estimator: Estimator,
        held: Bool[np.ndarray, " n"],
        start: Float[np.ndarray, "n 3"],
        to: Float[np.ndarray, "k n 3"],
    ) -> CandidatePull:
        """One grip taken to several places."""
        parts = start, held, estimator.force_unknown(held)
        start, held, force_unknown = (np.broadcast_to(part, (len(to), *part.shape)) for part in parts)
        return CandidatePull(
            start=jnp.asarray(start),
            held=jnp.asarray(held),
            force_unknown=jnp.asarray(force_unknown),
            to=jnp.asarray(to),
        )

    def _allowed_gain(self, found: Outcome, *, more: float = 1.0) -> Float[np.ndarray, "k scenarios"]:
        """Gains, 0 where a limit would be passed or nothing finite is predicted; energies count `more` times."""
        allowed = (more * found.energy <= self._energy) & (found.force <= self._force)
        return np.where(allowed, np.nan_to_num(found.gain), 0.0)

    def _safe(
        self, predictor: PullPredictor, candidate: CandidatePull, many: Float[Array, "_many n"], *, more: float = 1.0
    ) -> bool:
        """Whether the chance to pass a limit is small enough, by what one tug does in all scenarios."""
        found, far = (
            outcomes(predictor, candidate, many, informative=False),
            NormalDist().inv_cdf(1 - self._limits.chance),
        )
        for values, limit in ((jnp.sqrt(more * found.energy), self._energy**0.5), (found.force, self._force)):
            if not float(jnp.mean(values) + far * jnp.std(values)) <= limit:
                return False
        return True

    def _drawn(self, predictor: PullPredictor) -> tuple[Float[Array, "few n"], Float[Array, "many n"]]:
        self._key, one, other = jax.random.split(self._key, 3)
        unknown = jnp.asarray(self._limits.unknown)
        return _scenarios(predictor, one, EXPECTED, unknown), _scenarios(predictor, other, JUDGED, unknown)


def underrated(
    predictor: PullPredictor, candidate: CandidatePull, s: Float[Array, "scenarios n"], *, least: float
) -> float:
    """How many times the predicted energy what is seen amounts to, over scenarios in the median; at least 1.

    Args:
        predictor: what is predicted from.
        candidate: to where the tip is, from where the particles are seen.
        s: the scenarios.
        least: less than this is not predicted [J].
    """
    squared = jnp.sum((candidate.start[0] - predictor.balance.energy.rest) ** 2, axis=1)
    b = predictor.balance.reference * s / (1 - s)
    seen = 0.5 * jnp.median(b @ squared) / len(squared)
    predicted = jnp.median(outcomes(predictor, candidate, s, informative=False).energy)
    return max(1.0, float(seen / jnp.maximum(predicted, least)))


@eqx.filter_jit
def _scenarios(
    predictor: PullPredictor, key: PRNGKeyArray, count: int, unknown: Float[Array, ""]
) -> Float[Array, "count n"]:
    return predictor.scenarios(key, count, unknown=unknown)
