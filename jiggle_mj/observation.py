"""Observations and the user's declaration: all that the estimator sees. Actions are in `actions`.

World frame: z up, SI units, times in integer nanoseconds from 0.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from .actions import Cut, Suture
from .errors import RecordingError

IDENTITY_WXYZ = np.array([1.0, 0.0, 0.0, 0.0])
"""Quaternion wxyz of the identity rotation."""


@dataclass(frozen=True, kw_only=True)
class StereoPair:
    """One raw image from each camera, taken at the same time.

    Raises:
        RecordingError: the two sizes differ.
    """

    left: UInt8[np.ndarray, "height width 3"]
    """RGB image of the left camera."""
    right: UInt8[np.ndarray, "_height _width 3"]
    """RGB image of the right camera, of the same size."""

    def __post_init__(self) -> None:
        """Check that the two images have one size."""
        if self.left.shape != self.right.shape:
            raise RecordingError(f"stereo images differ in size: left {self.left.shape}, right {self.right.shape}.")


@dataclass(frozen=True, kw_only=True)
class MeasuredPoints:
    """Points measured on the tissue.

    Raises:
        RecordingError: the standard deviation is not finite and above 0.
    """

    positions: Float[np.ndarray, "m 3"]
    """Positions in the world frame [m]; NaN for a point that is not seen."""
    track_id: Int[np.ndarray, " m"] | None = None
    """Number of the material point, the same in every frame; None for clouds without correspondence."""
    sd: float = 2e-4
    """Standard deviation of each coordinate's noise [m]."""

    def __post_init__(self) -> None:
        """Check the noise."""
        if not (np.isfinite(self.sd) and self.sd > 0):
            raise RecordingError(f"the points' sd is {self.sd} m; it must be above 0 and finite.")


@dataclass(frozen=True, kw_only=True)
class ToolState:
    """The tweezer as the robot reports it."""

    position: Float[np.ndarray, " 3"]
    """Position of the tip in the world frame [m]."""
    quat_wxyz: Float[np.ndarray, " 4"]
    """Orientation of the tweezer in the world frame."""
    closed: bool
    """Whether the jaws hold the tissue."""
    grasp: int
    """Number of the current or last grasp, from 1; 0 before the first."""
    radius: float
    """Distance from the tip within which particles are held when the jaws close [m]."""
    held_tracks: tuple[int, ...] = ()
    """Track ids of the held points where the recording declares them; if empty, `radius` decides."""
    by_points: bool = False
    """Whether `position` is the mean of the held points, and so no independent measurement."""


@dataclass(frozen=True, kw_only=True)
class ToolReport:
    """The robot's report of the tip position between two observations."""

    time: int
    """Time on the clock of `Observation.time` [ns]."""
    position: Float[np.ndarray, " 3"]
    """Position of the tip in the world frame [m]."""


@dataclass(frozen=True, kw_only=True)
class Observation:
    """The tool, and images or measured points, at one time; where there are both, the estimator uses the images."""

    index: int
    """Position in the recording, skipped frames counted."""
    time: int
    """Time from the recording's start [ns]."""
    tool: ToolState
    """State of the tweezer."""
    reports: tuple[ToolReport, ...] = ()
    """Reports of the tool since the observation before, where it reports more often than frames come."""
    images: StereoPair | None = None
    """The stereo pair; None where the recording has points only."""
    points: MeasuredPoints | None = None
    """The measured points; None where the recording has images only."""
    events: tuple[Cut | Suture, ...] = ()
    """Intended cuts and sutures since the observation before."""

    @property
    def lost(self) -> bool:
        """Return whether the frame never came: it has neither images nor points, and the next frame has its index."""
        return self.images is None and self.points is None


@dataclass(frozen=True, kw_only=True)
class DeclaredMesh:
    """A mesh that the user declares for imported data; it may reach beyond the view."""

    vertices: Float[np.ndarray, "n 3"]
    """Rest positions in the world frame [m]."""
    faces: Int[np.ndarray, "f 3"]
    """Vertex numbers of each triangle, from 0."""
    track_id: Int[np.ndarray, " n"]
    """Track id of the measured point at each vertex; -1 where nothing is measured."""
    held: Bool[np.ndarray, " n"] | None = None
    """Which vertices the jaws hold, where the tool's radius cannot tell; if None, the radius decides."""


@dataclass(frozen=True, kw_only=True)
class Declaration:
    """The user's prior knowledge of the tissue. It is not the truth: it may be wrong.

    Positions alone give stiffness ratios only; `membrane_stiffness` converts them to N/m.
    """

    membrane_stiffness: float = 30.0
    """Young's modulus times thickness [N/m]."""
    poisson: float = 0.45
    """Poisson's ratio, in [0, 0.5)."""
    thickness: float = 1e-3
    """Thickness [m]; with the membrane stiffness it gives the bending stiffness."""
    areal_density: float = 1.0
    """Mass per area [kg/m^2]."""
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    """Gravity in the world frame [m/s^2]; zeros where the vertical is unknown. For a sheet that `hangs` in a plane near
    this direction only the magnitude counts: gravity is taken within the plane, and the first frame shows the sheet
    stretched by its weight and held by its topmost particles."""
    bed: bool = True
    """Whether the resting tissue lies on a bed that it cannot penetrate; without gravity there is no bed."""
    mesh: DeclaredMesh | None = None
    """Declared mesh; None to triangulate the first frame."""

    @property
    def hangs(self) -> bool:
        """Return whether the sheet has weight and no bed under it."""
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
