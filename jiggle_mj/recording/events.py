"""Cuts and sutures as messages: the intended change, not whether it succeeded."""

from typing import Any

import numpy as np

from ..actions import Cut, Suture
from ..argument_checks import quoted
from ..errors import RecordingError
from ..toml_kinds import number, positive, text
from .json_values import entry, parse_object
from .topics import EVENT

MAX_CORNERS = 10_000
"""Most corners of a cut's or a suture's middle line."""

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
    value = parse_object(data, EVENT)
    kind = entry(value, "kind", text, EVENT)
    path, width = np.array(entry(value, "path", _corners, EVENT)), entry(value, "width", positive, EVENT)
    if kind == "cut":
        return Cut(path=path, width=width)
    if kind == "suture":
        return Suture(path=path, width=width, stiffness=entry(value, "stiffness", positive, EVENT))
    raise RecordingError(f"{EVENT} has kind = {quoted(kind)}; it must be 'cut' or 'suture'.")


def _corners(value: Any) -> list[list[float]]:
    """Return the corners of a region's middle line."""
    kind = f"a list of 1 to {MAX_CORNERS} points [x, y] in m"
    if not isinstance(value, list) or not 0 < len(value) <= MAX_CORNERS:
        raise TypeError(kind)
    if any(not isinstance(corner, list) or len(corner) != 2 for corner in value):
        raise TypeError(kind)
    return [[number(coordinate) for coordinate in corner] for corner in value]
