"""Cuts and sutures: they remove or add attachments in a region of the sheet, and may fail at random.

The region is in tissue coordinates, those of the sheet at rest. Only the truth file says whether an event succeeded.
"""

import numpy as np
from jaxtyping import Bool, Float

from jiggle_mj.actions import Cut, Suture
from jiggle_mj.errors import ActionError
from jiggle_mj.regions import distance_to_path

from .simulation import Simulation


def apply_event(event: Cut | Suture, simulation: Simulation, rng: np.random.Generator) -> dict[str, object]:
    """Apply a cut or a suture, which fails with the probability that the scene's [procedure] states.

    Returns:
        The event for the truth file: what was intended, how many vertices the region holds, how many of them were
        attached before, and whether it succeeded.

    Raises:
        ActionError: the region meets no tissue.
    """
    name = type(event).__name__
    region = _region(event, simulation.tissue.sheet.vertices, name)
    settings, anchors = simulation.scene.procedure, simulation.anchors
    n_attached = int((anchors.stiffness[region] > 0).sum())
    failure_probability = settings.cut_fails if isinstance(event, Cut) else settings.suture_fails
    succeeded = bool(rng.random() >= failure_probability)
    if succeeded and isinstance(event, Suture):
        offset = np.array(settings.suture_offset)
        anchors.sew(region, stiffness=event.stiffness, offset=offset, slack=settings.suture_slack)
    elif succeeded:
        anchors.cut(region)
    return {
        "kind": name.lower(),
        "path": event.path.tolist(),
        "width": event.width,
        "n_vertices": int(region.sum()),
        "n_attached": n_attached,
        "succeeded": succeeded,
    }


def _region(event: Cut | Suture, vertices: Float[np.ndarray, "n 2"], name: str) -> Bool[np.ndarray, " n"]:
    """Return which vertices lie within half the event's width of its path."""
    path = event.path
    distance = distance_to_path(vertices, path)
    if distance.min() > event.width / 2:
        raise ActionError(
            f"{name.lower()} from ({path[0, 0]:.4f}, {path[0, 1]:.4f}) m meets no tissue: the nearest vertex is "
            f"{1e3 * distance.min():.1f} mm away, half the width is {500 * event.width:.1f} mm. Move it onto the sheet "
            "or widen it."
        )
    return distance <= event.width / 2
