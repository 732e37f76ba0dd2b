"""The paper's two procedures: find what is attached and cut it until the tissue is free; sew a free stretch, and check.

Both look with our policy, act, and look again: an act is checked by what the frames after it say, not taken on trust.
"""

from abc import abstractmethod
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float
from jiggle_mj.estimator.estimator import Estimator
from jiggle_mj.estimator.mesh import SheetMesh
from jiggle_mj.estimator.policies.information import Information
from jiggle_mj.estimator.policies.policy import Policy

from jiggle_mj.observation import Action, Cut, Suture
from jiggle_mj.regions import distance_to_path

CYCLE = 40
"""Most steps of looking before an act, and after the last."""
CHECKED = 0.002
"""A gain for which no step is worth taking once an act is to be checked [nat per particle]."""
ROOM = 2.4
"""Width of a cut [spacings]: the particles on its path and a ring around them, as well as an attachment is located."""
FREE = 0.2
"""P(attached) up to which a place is free enough to be sewn."""


class Procedure(Policy):
    """Look, act, look again."""

    name: str

    def __init__(self, look: Callable[..., Information]) -> None:
        """`look` makes a fresh policy for each time the tissue is looked at; may be told how much is `enough`."""
        super().__init__()
        self._fresh = look
        self._look, self._steps, self.acts = look(), 0, 0

    def plan(self, estimator: Estimator) -> tuple[Action, str] | str:
        """See `Policy.plan`."""
        if self._steps >= CYCLE:
            self._look.leave("the steps of this cycle are done")
        planned = self._look.plan(estimator)
        if not isinstance(planned, str):
            self._steps += 1
            return planned
        estimator.release()
        act = self.act(estimator)
        if isinstance(act, str):
            return f"{act}; {planned}"
        self.acts += 1
        self._look, self._steps = self._fresh(enough=CHECKED), 0
        return act, planned

    @abstractmethod
    def act(self, estimator: Estimator) -> Action | str:
        """What to do now that the jaws are open and the tissue was looked at; or why nothing."""


class Detach(Procedure):
    """Cut whatever is found attached, until nothing is."""

    name = "detach"

    def act(self, estimator: Estimator) -> Action | str:
        """See `Procedure.act`."""
        found = estimator.detection.attached
        if not found.any():
            return "nothing is attached any more"
        mesh = SheetMesh(estimator.sheet.rest, estimator.sheet.faces)
        return Cut(path=tour(mesh.rest[found, :2]), width=ROOM * mesh.spacing)


class Sew(Procedure):
    """Sew one free stretch, then see whether it holds."""

    name = "suture"

    def __init__(self, look: Callable[..., Information], *, length: float, width: float, stiffness: float) -> None:
        """Of the stretch [m], and of each sewn particle's attachment [N/m]."""
        super().__init__(look)
        self._length, self._width, self._stiffness = length, width, stiffness

    def act(self, estimator: Estimator) -> Action | str:
        """See `Procedure.act`."""
        if self.acts:
            factor = estimator.worked(estimator.changes[-1])
            if factor is None:
                return "whether the suture holds could not be seen"
            return "the suture holds" if factor > 0 else "the suture does not hold"
        mesh, detection = SheetMesh(estimator.sheet.rest, estimator.sheet.faces), estimator.detection
        path = free_stretch(mesh.rest[:, :2], detection.score, mesh.border, length=self._length, width=self._width)
        if path is None:
            return f"no stretch of {1e3 * self._length:.0f} mm is known to be free"
        return Suture(path=path, width=self._width, stiffness=self._stiffness)


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
