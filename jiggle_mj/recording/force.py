"""Forces on the tool as messages: what a sensor measured, at its own times and in its own axes."""

import math
from dataclasses import dataclass
from typing import Any

from ..argument_checks import quoted
from ..errors import RecordingError
from ..toml_kinds import positive, text, vector
from .json_values import entry, optional, parse_object
from .topics import FORCE

TOOL = "/tool/pose"
"""Name of the frame whose axes are those of the tool's pose."""
MAX_FORCE_N = 1e4
"""Largest component of a force that is read [N]: a tonne. Tissue tears at a few N."""

NO_TORQUE = (0.0, 0.0, 0.0)
"""Torque in the message of an observation's force, which has none, and where a sensor gives none."""
UNMEASURED = (math.nan, math.nan, math.nan)
"""Force where the sensor gave none."""

FORCE_SCHEMA: dict[str, object] = {
    "title": "jiggle_mj.Force",
    "type": "object",
    "properties": {
        "force": {"type": "array", "items": {"type": ["number", "null"]}, "description": "x, y, z on the tool [N]"},
        "torque": {"type": "array", "items": {"type": "number"}, "description": "x, y, z on the tool [N m]"},
        "frame_id": {"type": "string", "description": "coordinate frame of the sensor"},
        "sd": {"type": "number", "description": "standard deviation of the noise of each component of the force [N]"},
    },
    "required": ["force", "torque", "frame_id"],
}


@dataclass(frozen=True, kw_only=True)
class ToolForce:
    """A wrench that a sensor at the tool measured."""

    time: int
    """Time of the measurement [ns]."""
    force: tuple[float, float, float]
    """Force of the tissue on the tool, in the sensor's frame [N]; NaN where the sensor gave none."""
    torque: tuple[float, float, float]
    """Torque on the tool in the sensor's frame [N m]."""
    frame_id: str
    """Name of the sensor's frame; `TOOL` for the axes of the tool's pose."""
    sd: float | None = None
    """Standard deviation of the noise of each component of the force [N]; None where it is not stated."""

    @property
    def is_measured(self) -> bool:
        """Return whether the force is three finite numbers."""
        return all(map(math.isfinite, self.force))


def force_json(force: ToolForce) -> dict[str, object]:
    """Return the message of a force, which follows `FORCE_SCHEMA`."""
    stated = {} if force.sd is None else {"sd": force.sd}
    numbers = list(force.force) if force.is_measured else [None] * 3  # JSON has no NaN
    return {"force": numbers, "torque": list(force.torque), "frame_id": force.frame_id, **stated}


def parse_force(data: bytes, time: int) -> ToolForce:
    """Return the force of a message; NaN where a component is null, NaN or infinite.

    Args:
        data: the message.
        time: its time [ns].

    Raises:
        RecordingError: not JSON, a field missing or of the wrong kind, or a force of more than a tonne.
    """
    value = parse_object(data, FORCE, not_finite=True)
    force, torque = (entry(value, key, _vector_or_nan, FORCE) for key in ("force", "torque"))
    if any(abs(component) > MAX_FORCE_N for component in force):
        raise RecordingError(
            f"{FORCE} has force = {quoted(force)}; it is in N, and at most {MAX_FORCE_N:g} N are read (is it in mN?)."
        )
    return ToolForce(
        time=time,
        force=(force[0], force[1], force[2]),
        # A sensor of forces alone may report torques of NaN; nothing is computed from them.
        torque=NO_TORQUE if math.isnan(torque[0]) else (torque[0], torque[1], torque[2]),
        frame_id=entry(value, "frame_id", text, FORCE),
        sd=entry(value, "sd", optional(positive), FORCE, None),
    )


def _vector_or_nan(value: Any) -> list[float]:
    """Return three numbers; NaN for all of them where one is null, NaN or infinite."""
    if not isinstance(value, list):
        return vector(value)
    lost = [item is None or (isinstance(item, float) and not math.isfinite(item)) for item in value]
    finite = vector([0.0 if is_lost else item for item, is_lost in zip(value, lost, strict=True)])
    return list(UNMEASURED) if any(lost) else finite
