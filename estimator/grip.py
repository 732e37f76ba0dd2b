"""Which particles the tweezer holds, and where it should have taken them.

Held when the jaws close: the particles the recording names, or those within the radius of the tip. They move and turn
with the tip, give or take. The force on them is unknown, and so is that on their neighbours, since the true tissue's
points do not sit where the mesh has its own: the filter gives neither a balance of forces.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from jiggle_mj.errors import PerceptionError
from jiggle_mj.observation import ToolState


@dataclass(frozen=True, kw_only=True)
class GripHold:
    """One grasp, from closing to opening."""

    grasp: int
    held: Bool[np.ndarray, " n"]
    closed_at: Float[np.ndarray, "n 3"]
    """Positions of the particles when the jaws closed [m]."""
    tip: Float[np.ndarray, " 3"]
    """The tip when they closed [m]."""
    turn: Rotation
    """The tool's orientation when they closed."""

    @classmethod
    def close(
        cls, tool: ToolState, positions: Float[np.ndarray, "n 3"], named: Bool[np.ndarray, " n"] | None
    ) -> "GripHold":
        """Close the jaws over particles at the given positions; `named` overrules the radius.

        Raises:
            PerceptionError: nothing is within reach of the jaws.
        """
        distance = np.linalg.norm(positions - tool.position, axis=1)
        held = distance <= tool.radius if named is None else named
        if not held.any():
            raise PerceptionError(
                f"grasp {tool.grasp} is off the tissue: the tip at {np.round(tool.position, 4).tolist()} m is "
                f"{distance.min() * 1e3:.1f} mm from the nearest particle, and the jaws reach "
                f"{tool.radius * 1e3:.1f} mm (check the tool pose, the camera pose, or the radius)."
            )
        return cls(grasp=tool.grasp, held=held, closed_at=positions, tip=tool.position, turn=_orientation(tool))

    def rotated(self, tool: ToolState) -> Float[np.ndarray, "n 3"]:
        """Where the held particles would be if they had only turned with the tool, about the tip, since then [m]."""
        return self.tip + (_orientation(tool) * self.turn.inv()).apply(self.closed_at - self.tip)

    def expected(self, tool: ToolState) -> Float[np.ndarray, "n 3"]:
        """Where the held particles are if they went with the tool [m]; meaningless for the others."""
        return self.rotated(tool) + (tool.position - self.tip)


def _orientation(tool: ToolState) -> Rotation:
    return Rotation.from_quat(tool.quat_wxyz, scalar_first=True)
