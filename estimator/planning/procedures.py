"""The paper's two procedures: detach the tissue by cutting what is attached; suture a free stretch and check it.

Both explore with our policy, cut or sew, and explore again: whether an act worked is inferred from the frames after it.
"""

from abc import abstractmethod
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float

from jiggle_mj.actions import Action, Cut, Suture
from jiggle_mj.errors import ActionError
from jiggle_mj.regions import distance_to_path

from ..belief.topology import region_of
from ..estimator import Estimator
from ..physics.mesh import SheetMesh
from .information_policy import InformationPolicy
from .policy import Policy

MAX_CYCLE_STEPS = 40
"""Largest number of exploration steps before an act, and after the last."""
MIN_GAIN_AFTER_CUT = 0.002
"""Gain below which no step is worth taking after a cut [nat per particle and step]: half the default, because
whatever is still attached counts."""
CERTAIN_LOG_BAYES_FACTOR = 20.0
"""Absolute log Bayes factor from which an act is known to have worked or failed [nat]. It is large, because errors of
the model exaggerate it."""
CUT_WIDTH = 2.4
"""Width of a cut [spacings]: the particles on its path and a ring around them, which is how well attachments are
located."""
FREE_PROBABILITY = 0.05
"""Largest P(attached) of a stretch that is known to be free. Inside a sheet that was not observed yet it is 0.11."""
N_ANGLES = 4
"""Orientations of a straight stretch that are tried, evenly over half a turn."""


class ProcedurePolicy(Policy):
    """Base of the procedures: explore, cut or sew, explore again."""

    name: str

    def __init__(self, new_policy: Callable[..., InformationPolicy]) -> None:
        """Start with exploring.

        Args:
            new_policy: makes a policy for each exploration; takes `InformationPolicy`'s `min_gain` and `about`.
        """
        super().__init__()
        self._new_policy = new_policy
        self._explore, self._steps, self.acts = new_policy(), 0, 0

    def plan(self, estimator: Estimator) -> tuple[Action, str] | str:
        """See `Policy.plan`."""
        if self._steps >= MAX_CYCLE_STEPS:
            self._explore.leave("the steps of this cycle are done")
        elif self.acts and self.is_decided(estimator):
            self._explore.leave("the result of the last act is known")
        planned = self._explore.plan(estimator)
        if not isinstance(planned, str):
            self._steps += 1
            return planned
        estimator.release()
        act = self.act(estimator)
        if isinstance(act, str):
            return f"{act}; {planned}"
        self.acts += 1
        self._explore, self._steps = self.check(estimator, act), 0
        return act, planned

    def refused(self, error: ActionError) -> bool:
        """See `Policy.refused`: a refused step of exploring may be followed by others; a refused act is the end."""
        explored = not isinstance(self.decisions[-1].action, Cut | Suture)
        return (explored and self._explore.refused(error)) or super().refused(error)

    @abstractmethod
    def act(self, estimator: Estimator) -> Cut | Suture | str:
        """Return the act for the tissue as it was explored, with open jaws; or the reason for none."""

    @abstractmethod
    def check(self, estimator: Estimator, act: Cut | Suture) -> InformationPolicy:
        """Return the policy that explores the tissue after an act."""

    def is_decided(self, estimator: Estimator) -> bool:
        """Return whether it is known if the last act worked; by default not."""
        return False


class Detach(ProcedurePolicy):
    """Procedure that cuts what is found attached, until nothing is."""

    name = "detach"

    def act(self, estimator: Estimator) -> Cut | Suture | str:
        """See `ProcedurePolicy.act`."""
        found = estimator.detection.attached
        if not found.any():
            return f"nothing is found attached{' any more' if self.acts else ''}"
        mesh = SheetMesh(estimator.sheet.rest, estimator.sheet.faces)
        return Cut(path=tour(mesh.rest[found, :2]), width=CUT_WIDTH * mesh.spacing)

    def check(self, estimator: Estimator, act: Cut | Suture) -> InformationPolicy:
        """See `ProcedurePolicy.check`: all particles are asked about again."""
        return self._new_policy(min_gain=MIN_GAIN_AFTER_CUT)


class Sew(ProcedurePolicy):
    """Procedure that sews one free stretch, and then checks whether it holds."""

    name = "suture"

    def __init__(
        self, new_policy: Callable[..., InformationPolicy], *, length: float, width: float, stiffness: float
    ) -> None:
        """Start with exploring.

        Args:
            new_policy: see `ProcedurePolicy`.
            length: of the stretch [m].
            width: of the band that is sewn [m].
            stiffness: of each sewn particle's attachment [N/m].
        """
        super().__init__(new_policy)
        self._length, self._width, self._stiffness = length, width, stiffness

    def act(self, estimator: Estimator) -> Cut | Suture | str:
        """See `ProcedurePolicy.act`."""
        if self.acts:
            factor = estimator.change_log_bayes_factor(estimator.changes[-1])
            if factor is None:
                return "no frame has shown whether the suture holds"
            return "the suture holds" if factor > 0 else "the suture does not hold"
        mesh, detection = SheetMesh(estimator.sheet.rest, estimator.sheet.faces), estimator.detection
        path = None
        if detection.probabilistic:  # otherwise no frame has been informative yet
            path = free_stretch(mesh.rest[:, :2], detection.score, mesh.border, length=self._length, width=self._width)
        if path is None:
            return f"no stretch of {1e3 * self._length:.0f} mm is known to be free"
        return Suture(path=path, width=self._width, stiffness=self._stiffness)

    def check(self, estimator: Estimator, act: Cut | Suture) -> InformationPolicy:
        """See `ProcedurePolicy.check`: what was sewn is asked about, until it is known whether it holds."""
        return self._new_policy(min_gain=0.0, about=region_of(act, estimator.sheet.rest))

    def is_decided(self, estimator: Estimator) -> bool:
        """See `ProcedurePolicy.is_decided`."""
        factor = estimator.change_log_bayes_factor(estimator.changes[-1]) if estimator.changes else None
        return factor is not None and abs(factor) >= CERTAIN_LOG_BAYES_FACTOR


def tour(points: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 2"]:
    """Return the points [m] in a greedy order: after each the nearest of the remaining ones."""
    remaining, order = list(range(1, len(points))), [0]
    while remaining:
        distance = np.linalg.norm(points[remaining] - points[order[-1]], axis=1)
        order.append(remaining.pop(int(np.argmin(distance))))
    return points[order]


def free_stretch(
    flat: Float[np.ndarray, "n 2"],
    probability: Float[np.ndarray, " n"],
    border: Bool[np.ndarray, " n"],
    *,
    length: float,
    width: float,
) -> Float[np.ndarray, "2 2"] | None:
    """Return the ends of the straight stretch inside the sheet that is most surely free [m].

    Args:
        flat: particles on the resting sheet [m].
        probability: P(attached) of each.
        border: particles on the sheet's border, where nothing is sewn.
        length: of the stretch [m].
        width: of the band that is sewn [m].

    Returns:
        None if the largest P(attached) of every stretch is `FREE_PROBABILITY` or more.
    """
    best, path = FREE_PROBABILITY, None
    for middle in flat[~border]:
        for angle in np.arange(0, np.pi, np.pi / N_ANGLES):
            along = 0.5 * length * np.array([np.cos(angle), np.sin(angle)])
            ends = np.array([middle - along, middle + along])
            sewn = distance_to_path(flat, ends) <= width / 2
            within = ~border[sewn].any() and all(np.linalg.norm(flat - end, axis=1).min() < width / 2 for end in ends)
            if within and probability[sewn].max() < best:
                best, path = float(probability[sewn].max()), ends
    return path
