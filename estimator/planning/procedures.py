"""The paper's two procedures: find what is attached and cut it until the tissue is free; sew a free stretch, and check.

Both look with our policy, act, and look again: an act is checked by what the frames after it say, not taken on trust.
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

CYCLE = 40
"""Most steps of looking before an act, and after the last."""
CHECKED = 0.002
"""A gain for which no step is worth taking once something was cut [nat per particle]."""
CERTAIN = 20.0
"""Log Bayes factor, either way, from which an act is known to have worked or failed: far, as a model that errs
exaggerates it."""
ROOM = 2.4
"""Width of a cut [spacings]: the particles on its path and a ring around them, as well as an attachment is located."""
FREE = 0.05
"""P(attached) up to which a place is known to be free. Inside a sheet of which nothing was seen it is 0.11."""


class ProcedurePolicy(Policy):
    """Look, act, look again."""

    name: str

    def __init__(self, look: Callable[..., InformationPolicy]) -> None:
        """`look` makes a fresh policy for each look at the tissue; takes `InformationPolicy`'s `enough` and `about`."""
        super().__init__()
        self._fresh = look
        self._look, self._steps, self.acts = look(), 0, 0

    def plan(self, estimator: Estimator) -> tuple[Action, str] | str:
        """See `Policy.plan`."""
        if self._steps >= CYCLE:
            self._look.leave("the steps of this cycle are done")
        elif self.acts and self.seen(estimator):
            self._look.leave("what was done is seen")
        planned = self._look.plan(estimator)
        if not isinstance(planned, str):
            self._steps += 1
            return planned
        estimator.release()
        act = self.act(estimator)
        if isinstance(act, str):
            return f"{act}; {planned}"
        self.acts += 1
        self._look, self._steps = self.check(estimator, act), 0
        return act, planned

    def refused(self, error: ActionError) -> bool:
        """See `Policy.refused`: who looks may go on; what could not be cut or sewn is the end."""
        looked = not isinstance(self.decisions[-1].action, Cut | Suture)
        return (looked and self._look.refused(error)) or super().refused(error)

    @abstractmethod
    def act(self, estimator: Estimator) -> Cut | Suture | str:
        """What to do now that the jaws are open and the tissue was looked at; or why nothing."""

    @abstractmethod
    def check(self, estimator: Estimator, act: Cut | Suture) -> InformationPolicy:
        """Who looks at the tissue after an act."""

    def seen(self, estimator: Estimator) -> bool:
        """Whether nothing more has to be seen of the last act."""
        return False


class Detach(ProcedurePolicy):
    """Cut whatever is found attached, until nothing is."""

    name = "detach"

    def act(self, estimator: Estimator) -> Cut | Suture | str:
        """See `ProcedurePolicy.act`."""
        found = estimator.detection.attached
        if not found.any():
            return f"nothing is found attached{' any more' if self.acts else ''}"
        mesh = SheetMesh(estimator.sheet.rest, estimator.sheet.faces)
        return Cut(path=tour(mesh.rest[found, :2]), width=ROOM * mesh.spacing)

    def check(self, estimator: Estimator, act: Cut | Suture) -> InformationPolicy:
        """See `ProcedurePolicy.check`: whatever is still attached counts."""
        return self._fresh(enough=CHECKED)


class Sew(ProcedurePolicy):
    """Sew one free stretch, then see whether it holds."""

    name = "suture"

    def __init__(
        self, look: Callable[..., InformationPolicy], *, length: float, width: float, stiffness: float
    ) -> None:
        """Of the stretch [m], and of each sewn particle's attachment [N/m]."""
        super().__init__(look)
        self._length, self._width, self._stiffness = length, width, stiffness

    def act(self, estimator: Estimator) -> Cut | Suture | str:
        """See `ProcedurePolicy.act`."""
        if self.acts:
            factor = estimator.change_log_bayes_factor(estimator.changes[-1])
            if factor is None:
                return "whether the suture holds could not be seen"
            return "the suture holds" if factor > 0 else "the suture does not hold"
        mesh, detection = SheetMesh(estimator.sheet.rest, estimator.sheet.faces), estimator.detection
        path = None
        if detection.probabilistic:  # else no frame has said anything yet
            path = free_stretch(mesh.rest[:, :2], detection.score, mesh.border, length=self._length, width=self._width)
        if path is None:
            return f"no stretch of {1e3 * self._length:.0f} mm is known to be free"
        return Suture(path=path, width=self._width, stiffness=self._stiffness)

    def check(self, estimator: Estimator, act: Cut | Suture) -> InformationPolicy:
        """See `ProcedurePolicy.check`: what was sewn, until it is known whether it holds."""
        return self._fresh(enough=0.0, about=region_of(act, estimator.sheet.rest))

    def seen(self, estimator: Estimator) -> bool:
        """See `ProcedurePolicy.seen`."""
        factor = estimator.change_log_bayes_factor(estimator.changes[-1]) if estimator.changes else None
        return factor is not None and abs(factor) >= CERTAIN


def tour(points: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 2"]:
    """The points in an order in which each is near the one before: always the nearest that is left."""
    left, order = list(range(1, len(points))), [0]
    while left:
        away = np.linalg.norm(points[left] - points[order[-1]], axis=1)
        order.append(left.pop(int(np.argmin(away))))
    return points[order]


def free_stretch(
    flat: Float[np.ndarray, "n 2"],
    probability: Float[np.ndarray, " n"],
    border: Bool[np.ndarray, " n"],
    *,
    length: float,
    width: float,
) -> Float[np.ndarray, "2 2"] | None:
    """The straight stretch within the sheet that is surest to be free; None where none is sure enough.

    Args:
        flat: particles on the resting sheet [m].
        probability: P(attached) of each.
        border: which are on the sheet's edge, where nothing is sewn.
        length: of the stretch [m].
        width: of the band that is sewn [m].
    """
    best, path = FREE, None
    for middle in flat[~border]:
        for angle in np.arange(0, np.pi, np.pi / 4):
            along = 0.5 * length * np.array([np.cos(angle), np.sin(angle)])
            ends = np.array([middle - along, middle + along])
            sewn = distance_to_path(flat, ends) <= width / 2
            within = ~border[sewn].any() and all(np.linalg.norm(flat - end, axis=1).min() < width / 2 for end in ends)
            if within and probability[sewn].max() < best:
                best, path = float(probability[sewn].max()), ends
    return path
