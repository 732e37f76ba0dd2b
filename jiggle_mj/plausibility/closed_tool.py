"""How the tool moves while its jaws are closed, beside what it holds."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..observation import Observation, ToolState

NS = 1e-9
"""Seconds in a nanosecond [s]."""


@dataclass(kw_only=True)
class ClosedTool:
    """The tool while the jaws are closed."""

    grasps: set[int] = field(default_factory=set)
    frames: int = 0
    motion: float = 0.0
    path: float = 0.0
    speed: float | None = None
    gap: float | None = None
    held: float | None = None
    largest_gap_ns: int | None = None
    by_points: bool = False
    closings: list[ToolState] = field(default_factory=list)
    _last: Observation | None = None

    def begins(self, observation: Observation) -> bool:
        """Return whether the jaws close in this frame."""
        tool = observation.tool
        return tool.closed and (self._last is None or not self._last.tool.closed or self._last.tool.grasp != tool.grasp)

    def add(self, observation: Observation, held: Float[np.ndarray, " 3"], at_closing: Float[np.ndarray, " 3"]) -> None:
        """Take one frame.

        Args:
            observation: the frame.
            held: displacement of the held points since the jaws closed [m], NaN if unknown.
            at_closing: where they were then [m].
        """
        tool, last = observation.tool, self._last
        if not tool.closed:
            self._last = observation
            return
        if self.begins(observation):
            self.closings.append(tool)
        elif last is not None:
            step, lasted = float(np.linalg.norm(tool.position - last.tool.position)), observation.time - last.time
            self.path += step
            self.largest_gap_ns = max(self.largest_gap_ns or 0, lasted)
            if lasted > 0:
                self.speed = max(self.speed or 0.0, step / (lasted * NS))
        closing = self.closings[-1]
        moved = tool.position - closing.position
        self.motion = max(self.motion, float(np.linalg.norm(moved)))
        if np.isfinite(held).all():
            self.held = max(self.held or 0.0, float(np.linalg.norm(held)))
            from_tip = at_closing - closing.position
            rotated = moved + (_rotation(tool) * _rotation(closing).inv()).apply(from_tip) - from_tip
            # A tool whose offset from the held points is not rigid is judged by its displacement alone.
            gap = min(float(np.linalg.norm(held - each)) for each in (moved, rotated))
            self.gap = max(self.gap or 0.0, gap)
        self.grasps.add(tool.grasp)
        self.frames += 1
        self.by_points |= tool.by_points
        self._last = observation


def _rotation(tool: ToolState) -> Rotation:
    return Rotation.from_quat(tool.quat_wxyz, scalar_first=True)
