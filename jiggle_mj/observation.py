"""What crosses from the tissue to the estimator; actions, which go the other way, are in `actions`.

An `Observation` is all that the estimator ever sees. World frame: z up, SI units, times in integer nanoseconds from 0.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from .actions import Cut, Suture
from .errors import RecordingError

UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])
"""The quaternion wxyz of no rotation."""


@dataclass(frozen=True, kw_only=True)
class StereoPair:
    """One raw image from each camera, taken at the same time.

    Raises:
        RecordingError: the two sizes differ.
    """

    left: UInt8[np.ndarray, "height width 3"]
    """RGB."""
    right: UInt8[np.ndarray, "_height _width 3"]
    """RGB, of the left one's size."""

    def __post_init__(self) -> None:
        """Check that the two images have one size."""
        if self.left.shape != self.right.shape:
            raise RecordingError(f"stereo images differ in size: left {self.left.shape}, right {self.right.shape}.")


@dataclass(frozen=True, kw_only=True)
class MeasuredPoints:
    """Points measured on the tissue.

    Raises:
        RecordingError: a standard deviation that is none.
    """

    positions: Float[np.ndarray, "m 3"]
    """World [m]; NaN rows are points that were not seen."""
    track_id: Int[np.ndarray, " m"] | None = None
    """The same number means the same material point in every frame; None for clouds without correspondence."""
    sd: float = 2e-4
    """Stated standard deviation of each coordinate [m]."""

    def __post_init__(self) -> None:
        """Check the noise."""
        if not (np.isfinite(self.sd) and self.sd > 0):
            raise RecordingError(f"the points' sd is {self.sd} m; it must be above 0 and finite.")


@dataclass(frozen=True, kw_only=True)
class ToolState:
    """The tweezer as the robot reports it."""

    position: Float[np.ndarray, " 3"]
    """Tip, world [m]."""
    quat_wxyz: Float[np.ndarray, " 4"]
    """Orientation, world."""
    closed: bool
    """Whether the jaws hold the tissue."""
    grasp: int
    """Number of the current or last grasp, counted from 1; 0 before the first."""
    radius: float
    """Particles within this distance of the tip when the jaws close are held [m]."""
    held_tracks: tuple[int, ...] = ()
    """Track ids known to be held, for recordings that declare them; empty means 'by radius'."""
    by_points: bool = False
    """Whether the position is where the held points were seen, so that it says nothing of its own."""


@dataclass(frozen=True, kw_only=True)
class ToolReport:
    """Where the robot said that the tip was, between two observations."""

    time: int
    """As `Observation.time` [ns]."""
    position: Float[np.ndarray, " 3"]
    """World [m]."""


@dataclass(frozen=True, kw_only=True)
class Observation:
    """One moment: the tool, and images or measured points; where there are both, the estimator uses the images."""

    index: int
    """Position in the recording, skipped frames counted."""
    time: int
    """Time from the recording's start [ns]."""
    tool: ToolState
    reports: tuple[ToolReport, ...] = ()
    """Of the tool since the observation before, where it reports more often than something is seen."""
    images: StereoPair | None = None
    points: MeasuredPoints | None = None
    events: tuple[Cut | Suture, ...] = ()
    """What was cut or sewn since the observation before, as intended."""

    @property
    def lost(self) -> bool:
        """Whether nothing was seen: the frame never came, and the next one has its index."""
        return self.images is None and self.points is None


@dataclass(frozen=True, kw_only=True)
class DeclaredMesh:
    """A mesh that the user declares for imported data; its vertices may reach beyond what is seen."""

    vertices: Float[np.ndarray, "n 3"]
    """Rest positions [m]."""
    faces: Int[np.ndarray, "f 3"]
    track_id: Int[np.ndarray, " n"]
    """Track id of the measured point at each vertex, -1 where nothing is measured."""
    held: Bool[np.ndarray, " n"] | None = None
    """Vertices known to be in the grip, where the tool's radius cannot say; None for 'by radius'."""


@dataclass(frozen=True, kw_only=True)
class Declaration:
    """What the user says is known of the tissue before anything is seen. Not truth: it may be wrong.

    Positions alone give stiffness ratios only; `membrane_stiffness` is what turns them into N/m.
    """

    membrane_stiffness: float = 30.0
    """Young's modulus times thickness [N/m]."""
    poisson: float = 0.45
    thickness: float = 1e-3
    """[m]; with the membrane stiffness it gives the bending stiffness."""
    areal_density: float = 1.0
    """Mass per area [kg/m^2]."""
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    """[m/s^2], world; zeros where nobody knows which way is down. A sheet that `hangs` in a plane near it hangs by it:
    then only its size counts, and it was first seen stretched by its weight, held by its topmost particles."""
    bed: bool = True
    """Whether the tissue lies on a bed at rest, which it cannot pass; without gravity there is none."""
    mesh: DeclaredMesh | None = None

    @property
    def hangs(self) -> bool:
        """Whether it has weight, and no bed under it."""
        return not self.bed and any(self.gravity)

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name in ("membrane_stiffness", "thickness", "areal_density"):
            if not getattr(self, name) > 0:
                raise ValueError(f"Declaration.{name} must be above 0; got {getattr(self, name)}.")
        if not 0 <= self.poisson < 0.5:
            raise ValueError(
                f"Declaration.poisson must be in [0, 0.5) for a shell; got {self.poisson} "
                "(use 0.49 for nearly incompressible tissue)."
            )
