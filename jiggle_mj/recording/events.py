"""Cuts and sutures as messages: the intended change, not whether it succeeded."""

import json

import numpy as np

from ..actions import Cut, Suture
from ..errors import RecordingError

EVENT_SCHEMA: dict[str, object] = {
    "title": "jiggle_mj.Topology",
    "type": "object",
    "properties": {
        "kind": {"enum": ["cut", "suture"]},
        "path": {
            "type": "array",
            "description": "corners [x, y] of the region's middle line on the resting sheet [m]",
        },
        "width": {"type": "number", "description": "of the region, across the path and around its ends [m]"},
        "stiffness": {
            "type": "number",
            "description": "of each sewn particle's attachment [N/m]; sutures only",
        },
    },
    "required": ["kind", "path", "width"],
}


def event_json(event: Cut | Suture) -> dict[str, object]:
    """Return the message of an event, which follows `EVENT_SCHEMA`."""
    region: dict[str, object] = {"path": np.asarray(event.path, float).tolist(), "width": float(event.width)}
    if isinstance(event, Suture):
        return region | {"kind": "suture", "stiffness": float(event.stiffness)}
    return region | {"kind": "cut"}


def parse_event(data: bytes) -> Cut | Suture:
    """Return the event of a message.

    Raises:
        RecordingError: not JSON, or a field missing or of the wrong kind.
    """
    try:
        value = json.loads(data)
        path, width = np.array(value["path"], dtype=float), float(value["width"])
        if path.ndim != 2 or path.shape[1] != 2 or value["kind"] not in ("cut", "suture"):
            raise ValueError("path must be a list of [x, y], kind 'cut' or 'suture'")
        if value["kind"] == "cut":
            return Cut(path=path, width=width)
        return Suture(path=path, width=width, stiffness=float(value["stiffness"]))
    except (KeyError, TypeError, ValueError) as failure:
        raise RecordingError(
            f"/event/topology must be JSON {{kind, path, width, stiffness}}; got {data[:80]!r} ({failure!r})."
        ) from failure
