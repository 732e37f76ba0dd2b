"""Cutting attachments and sewing new ones: on a region of the sheet, with a chance that it does not succeed.

The region is in tissue coordinates, that of the sheet at rest. Whether it succeeded is written into the truth alone.
"""

import numpy as np
from jaxtyping import Bool, Float

from jiggle_mj.actions import Cut, Suture
from jiggle_mj.errors import ActionError
from jiggle_mj.regions import distance_to_path

from .simulation import Simulation


def carry_out(event: Cut | Suture, simulation: Simulation, rng: np.random.Generator) -> dict[str, object]:
    """Cut or sew, if chance allows it.

    Returns:
        For the truth: what was intended, how many vertices the region holds and how many of them were attached
        before, and whether it succeeded.

    Raises:
        ActionError: a region that meets no tissue, or numbers that are none.
    """
    name = type(event).__name__
    region = _region(event, simulation.tissue.sheet.vertices, name)
    settings, anchors = simulation.scene.procedure, simulation.anchors
    attached = int((anchors.stiffness[region] > 0).sum())
    fails = settings.cut_fails if isinstance(event, Cut) else settings.suture_fails
    succeeded = bool(rng.random() >= fails)
    if succeeded and isinstance(event, Suture):
        offset = np.array(settings.suture_offset)
        anchors.sew(region, stiffness=event.stiffness, offset=offset, slack=settings.suture_slack)
    elif succeeded:
        anchors.cut(region)
    return {
        "kind": name.lower(),
        "path": np.asarray(event.path, float).tolist(),
        "width": float(event.width),
        "n_vertices": int(region.sum()),
        "n_attached": attached,
        "succeeded": succeeded,
    }


def _region(event: Cut | Suture, vertices: Float[np.ndarray, "n 2"], name: str) -> Bool[np.ndarray, " n"]:
    path = np.array(event.path, dtype=float)
    if path.ndim != 2 or path.shape[1] != 2 or not len(path) or not np.isfinite(path).all():
        raise ActionError(f"{name}.path must be one or more finite points [x, y] in m; got {event.path}.")
    if not (np.isfinite(event.width) and event.width > 0):
        raise ActionError(f"{name}.width must be above 0 m; got {event.width}.")
    if isinstance(event, Suture) and not (np.isfinite(event.stiffness) and event.stiffness > 0):
        raise ActionError(f"Suture.stiffness must be above 0 N/m; got {event.stiffness}.")
    distance = distance_to_path(vertices, path)
    if distance.min() > event.width / 2:
        raise ActionError(
            f"{name.lower()} from ({path[0, 0]:.4f}, {path[0, 1]:.4f}) m meets no tissue: the nearest vertex is "
            f"{1e3 * distance.min():.1f} mm away, half the width is {500 * event.width:.1f} mm. Move it onto the sheet "
            "or widen it."
        )
    return distance <= event.width / 2
