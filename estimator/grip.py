"""Which particles the tweezer holds, and where it should have taken them.

Held are, when the jaws close, the particles that the recording names, or those within the radius of the tip. They move
and rotate with the tip up to `EstimatorConfig.grip_sd`. The force on them is unknown, and so is that on their
neighbours, since the true tissue's points do not sit where the mesh has its own. The filter uses neither balance of
forces.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from jiggle_mj.errors import PerceptionError
from jiggle_mj.observation import ToolState

from .perception.track import Track


@dataclass(frozen=True, kw_only=True)
class GripHold:
    """One grasp, from closing to opening."""

    grasp: int
    """Number of the grasp in the recording."""
    held: Bool[np.ndarray, " n"]
    """Which particles are held."""
    closed_at: Float[np.ndarray, "n 3"]
    """Positions of the particles when the jaws closed [m]."""
    observed: Bool[np.ndarray, " n"]
    """Which of these were observed; the others are those at rest."""
    tip: Float[np.ndarray, " 3"]
    """Position of the tip when the jaws closed [m]."""
    orientation: Rotation
    """Orientation of the tool when the jaws closed."""

    @classmethod
    def close(
        cls,
        tool: ToolState,
        positions: Float[np.ndarray, "n 3"],
        named: Bool[np.ndarray, " n"] | None,
        *,
        observed: Bool[np.ndarray, " n"] | None = None,
        corrected: Float[np.ndarray, "n 3"] | None = None,
    ) -> "GripHold":
        """Close the jaws over particles at the given positions [m]; `named` particles replace those in the radius.

        All positions are `observed` where nothing else is said.

        Where positions have known errors, the `corrected` ones say which are in the radius.

        Raises:
            PerceptionError: no particle is within reach of the jaws.
        """
        distance = np.linalg.norm((positions if corrected is None else corrected) - tool.position, axis=1)
        held = distance <= tool.radius if named is None else named
        if not held.any():
            raise PerceptionError(
                f"grasp {tool.grasp} is off the tissue: the tip at {np.round(tool.position, 4).tolist()} m is "
                f"{distance.min() * 1e3:.1f} mm from the nearest particle, and the jaws reach "
                f"{tool.radius * 1e3:.1f} mm (check the tool pose, the camera pose, or the radius)."
            )
        return cls(
            grasp=tool.grasp,
            held=held,
            closed_at=positions,
            observed=np.ones(len(positions), bool) if observed is None else observed,
            tip=tool.position,
            orientation=_orientation(tool),
        )

    def rotated(self, tool: ToolState) -> Float[np.ndarray, "n 3"]:
        """Return where the particles would be had they only rotated with the tool, about the tip, since closing [m]."""
        return self.tip + (_orientation(tool) * self.orientation.inv()).apply(self.closed_at - self.tip)

    def expected(self, tool: ToolState) -> Float[np.ndarray, "n 3"]:
        """Return where the held particles are if they move and rotate with the tool [m]; meaningless for others."""
        return self.rotated(tool) + (tool.position - self.tip)


@dataclass(kw_only=True)
class GripTracker:
    """The grasp at hand, over the frames of a recording."""

    hold: GripHold | None = None
    """What the jaws hold, once a frame of the grasp was used; None while they are open."""
    closing: ToolState | None = None
    """The tool when the jaws closed; None while they are open, or where that is not known."""

    def release(self) -> None:
        """Let go."""
        self.hold = self.closing = None

    def begins(self, tool: ToolState) -> bool:
        """Whether closed jaws are those of another grasp than the one at hand."""
        return self.closing is None or self.closing.grasp != tool.grasp

    def grasp(
        self,
        tool: ToolState,
        *,
        state: Float[np.ndarray, "n 3"],
        rest: Float[np.ndarray, "n 3"],
        track: Track,
        named: Bool[np.ndarray, " n"] | None,
        corrected: Float[np.ndarray, "n 3"] | None = None,
    ) -> tuple[GripHold, Float[np.ndarray, "n 3"]]:
        """Return the grasp of a frame, and the state to start from: the last, or rest where the jaws have just closed.

        If the frame in which they closed could not be used, the sheet is taken to have been at rest in it.

        Args:
            tool: in this frame.
            state: of the frame before [m].
            rest: the sheet at rest [m].
            track: what is seen of the particles in this frame.
            named: particles that the recording names as held; None where it names none.
            corrected: positions as the jaws close, without known errors [m]; None where none are known.

        Raises:
            PerceptionError: no particle is within reach of the jaws.
        """
        if self.hold is not None and self.hold.grasp == tool.grasp:
            return self.hold, state
        assert self.closing is not None
        seen = track.visible & (tool is self.closing)
        at_closing = np.where(seen[:, None], np.nan_to_num(track.positions), rest)
        if corrected is not None:
            corrected = np.where(seen[:, None], corrected, rest)
        try:
            return GripHold.close(self.closing, at_closing, named, observed=seen, corrected=corrected), rest
        except PerceptionError:
            self.closing = None  # a later frame of this grasp may know better
            raise


def _orientation(tool: ToolState) -> Rotation:
    return Rotation.from_quat(tool.quat_wxyz, scalar_first=True)
