"""Forces on the tool as messages: kept in a recording for other programs; no estimator reads them."""

from dataclasses import dataclass

FORCE_SCHEMA: dict[str, object] = {
    "title": "jiggle_mj.Force",
    "type": "object",
    "properties": {
        "force": {"type": "array", "items": {"type": "number"}, "description": "x, y, z on the tool [N]"},
        "torque": {"type": "array", "items": {"type": "number"}, "description": "x, y, z on the tool [N m]"},
        "frame_id": {"type": "string", "description": "coordinate frame of the sensor"},
    },
    "required": ["force", "torque", "frame_id"],
}


@dataclass(frozen=True, kw_only=True)
class ToolForce:
    """A wrench that a sensor at the tool measured."""

    time: int
    """Time of the measurement [ns]."""
    force: tuple[float, float, float]
    """Force on the tool in the sensor's frame [N]."""
    torque: tuple[float, float, float]
    """Torque on the tool in the sensor's frame [N m]."""
    frame_id: str
    """Name of the sensor's frame."""


def force_json(force: ToolForce) -> dict[str, object]:
    """Return the message of a force, which follows `FORCE_SCHEMA`."""
    return {"force": list(force.force), "torque": list(force.torque), "frame_id": force.frame_id}
