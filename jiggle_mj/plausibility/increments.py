"""Displacements from frame to frame that were taken for displacements from rest: only their sum follows the tool."""

from collections import defaultdict

import numpy as np
from jaxtyping import Float

from ..observation import ToolState

MIN_FRAMES = 5
"""Frames of a grasp from which sums are compared: with fewer, a point that slips does the same."""
FOLLOWS, STRAYS = 0.25, 0.5
"""Largest difference from the tool's displacement, over the tool's largest: below the first the sums follow it, above
the second the displacements do not. Points beside the jaws lag by a fifth. Limit: at a constant speed of the tool,
points that slip after one frame, or follow by a share of about 2 over the number of frames, look the same."""


class SummedMotion:
    """Displacements of tool and held points in each grasp."""

    def __init__(self) -> None:
        """Begin without a frame."""
        self._grasps: defaultdict[int, list[tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]]] = defaultdict(
            list
        )

    def add(self, tool: ToolState, held: Float[np.ndarray, " 3"]) -> None:
        """Take one frame.

        Args:
            tool: the tool.
            held: mean displacement of the held points since the jaws closed [m], NaN if unknown.
        """
        if tool.closed and not tool.by_points:
            self._grasps[tool.grasp].append((held, tool.position))

    @property
    def follows(self) -> bool:
        """Return whether in a grasp the sums of the held points' displacements follow the tool."""
        known = [
            (np.array([held for held, _ in grasp]), np.array([tip for _, tip in grasp]))
            for grasp in self._grasps.values()
        ]
        return any(follow_in_sum(held, tips - tips[0]) for held, tips in known)


def follow_in_sum(held: Float[np.ndarray, "t 3"], tool: Float[np.ndarray, "t 3"]) -> bool:
    """Return whether the sums of displacements follow the tool, and the displacements do not.

    Args:
        held: mean displacement of the held points in each frame of a grasp, from when the jaws close [m].
        tool: displacement of the tool [m].
    """
    farthest = float(np.linalg.norm(tool, axis=1).max(initial=0.0))
    if len(tool) < MIN_FRAMES or not np.isfinite(held).all() or not farthest:
        return False
    alone, summed = (float(np.linalg.norm(each - tool, axis=1).max()) for each in (held, np.cumsum(held, axis=0)))
    return alone > STRAYS * farthest and summed < FOLLOWS * farthest
