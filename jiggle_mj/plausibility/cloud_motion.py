"""Whether clouds without identities go along with the tool that holds the sheet.

Single points cannot be followed in them. But a sheet that is lifted stays near the tool, and the bed alone does not.
"""

from collections.abc import Iterator

import numpy as np

from ..observation import Observation
from .point_motion import nearest_distance
from .problem import RecordingProblem, metres, warning

LEFT_SHARE = 0.5
"""Share of the tool's motion by which its distance from the cloud must grow to be doubted [1]."""
MIN_RADII = 2.0
"""Motion of the tool from which a grasp counts, over the radius of the grip [1]: less may stay within what it hides."""


class CloudMotion:
    """Distance of the tool from the cloud, when the jaws close and when it is farthest from there."""

    def __init__(self) -> None:
        self._first: Observation | None = None
        self._distances = list[tuple[float, float, float]]()

    def add(self, observation: Observation) -> None:
        """Look at a frame; those with identities, or with open jaws, say nothing here."""
        tool, points = observation.tool, observation.points
        if not tool.closed or points is None or points.track_id is not None or not len(points.positions):
            return
        distance = nearest_distance(points.positions, tool.position)
        if self._first is None or self._first.tool.grasp != tool.grasp:
            self._first = observation
            self._distances.append((0.0, distance, distance))
        motion = float(np.linalg.norm(tool.position - self._first.tool.position))
        most, at_first, _ = self._distances[-1]
        if motion > max(most, MIN_RADII * tool.radius):
            self._distances[-1] = motion, at_first, distance

    def problems(self) -> Iterator[RecordingProblem]:
        """Find clouds that the tool leaves in every grasp."""
        moved = [(motion, last - first) for motion, first, last in self._distances if motion > 0]
        if moved and all(gain > LEFT_SHARE * motion for motion, gain in moved):
            motion, gain = max(moved)
            yield warning(
                "cloud-still",
                f"the tool moves by up to {metres(motion)} while it holds, and goes {metres(gain)} further from the "
                "cloud; does the cloud show the sheet, and not what lies below it, at the time of its frame?",
            )
