"""Observations and the user's declaration: all that the estimator sees. Actions are in `actions`.

World frame: z up, SI units, times in integer nanoseconds from 0.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from .actions import Cut, Suture
from .argument_checks import (
    as_array,
    as_flag,
    as_instance,
    as_integer,
    as_number,
    as_tuple_of,
    quoted,
    store,
)
from .errors import ObservationError, OptionError

MATERIAL_BOUNDS = {"membrane_stiffness": ("N/m", 1e8), "thickness": ("m", 0.1), "areal_density": ("kg/m^2", 1e3)}
"""Unit and upper bound of each declared property: a millimetre of steel has 2e8 N/m, 0.1 m of tissue is no sheet, and
1000 kg/m^2 is a metre of water. Beyond them a unit is wrong."""
MAX_GRAVITY = 100.0
"""Largest declared gravity [m/s^2]: ten times that of the Earth."""
IDENTITY_WXYZ = np.array([1.0, 0.0, 0.0, 0.0])
"""Quaternion wxyz of the identity rotation."""
MAX_PARTICLES = 20_000
"""Most particles of a sheet: the belief of more, a square matrix, does not fit a few GB."""


@dataclass(frozen=True, kw_only=True)
class StereoPair:
    """One raw image from each camera, taken at the same time.

    Raises:
        ObservationError: an image is not of type uint8 and shape (height, width, 3), is empty, or the two sizes differ.
    """

    left: UInt8[np.ndarray, "height width 3"]
    """RGB image of the left camera."""
    right: UInt8[np.ndarray, "_height _width 3"]
    """RGB image of the right camera, of the same size."""

    def __post_init__(self) -> None:
        """Check that the two are RGB images of one size."""
        for side in ("left", "right"):
            where, shape = f"StereoPair.{side}", (None, None, 3)
            image = as_array(getattr(self, side), where, shape, kind="uint8", error=ObservationError)
            if not image.size:
                raise ObservationError(f"{where} is empty: {image.shape}.")
            store(self, **{side: image})
        if self.left.shape != self.right.shape:
            raise ObservationError(f"stereo images differ in size: left {self.left.shape}, right {self.right.shape}.")


@dataclass(frozen=True, kw_only=True)
class MeasuredPoints:
    """Points measured on the tissue.

    Raises:
        ObservationError: positions are no numbers of shape (m, 3), there is not one track id for each, an id of 0 or
            above repeats, or the noise is not what a noise can be.
    """

    positions: Float[np.ndarray, "m 3"]
    """Positions in the world frame [m]; NaN for a point that is not seen."""
    track_id: Int[np.ndarray, " m"] | None = None
    """Number of the material point, the same in every frame; negative for a point that is not used; None for clouds
    without correspondence."""
    sd: float = 2e-4
    """Standard deviation of each coordinate's noise [m]."""
    sd_stated: bool = True
    """Whether somebody states `sd`; False where it is the default for want of a statement."""
    smooth_sd: float = 0.0
    """Standard deviation of the part of `sd` that neighbours share [m]; 0 where none is stated."""
    smooth_length: float | None = None
    """Distance at rest over which that part correlates by exp(-1/2) [m]; needed with `smooth_sd`."""

    def __post_init__(self) -> None:
        """Check positions, identities and noise."""
        name = "MeasuredPoints"
        positions = as_array(self.positions, f"{name}.positions [m]", (None, 3), finite=False, error=ObservationError)
        store(
            self,
            positions=positions,
            sd=as_number(self.sd, f"{name}.sd", unit="m", above=0, error=ObservationError),
            smooth_sd=as_number(self.smooth_sd, f"{name}.smooth_sd", unit="m", at_least=0, error=ObservationError),
        )
        if not self.smooth_sd < self.sd:
            raise ObservationError(
                f"{name}.smooth_sd is {self.smooth_sd:g} m, and sd, of which it is a part, {self.sd:g} m; give sd with "
                "the noise of single points in it."
            )
        if self.smooth_length is not None:
            length = as_number(self.smooth_length, f"{name}.smooth_length", unit="m", above=0, error=ObservationError)
            store(self, smooth_length=length)
        elif self.smooth_sd:
            raise ObservationError(f"{name}.smooth_sd needs a smooth_length, over which neighbours share it [m].")
        if self.track_id is not None:
            store(self, track_id=_track_ids(self.track_id, f"{name}.track_id", len(positions)))


@dataclass(frozen=True, kw_only=True)
class ToolState:
    """The tweezer as the robot reports it.

    Raises:
        ObservationError: a field has the wrong type or shape, a number is not finite, the quaternion is zero, the
            radius is not above 0, or the number of the grasp is below 0.
    """

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

    def __post_init__(self) -> None:
        """Check every field."""
        error = ObservationError
        quat_wxyz = as_array(self.quat_wxyz, "ToolState.quat_wxyz", (4,), error=error)
        if not quat_wxyz.any():
            raise error("ToolState.quat_wxyz must not be zero: the identity is [1, 0, 0, 0].")
        held = self.held_tracks.tolist() if isinstance(self.held_tracks, np.ndarray) else self.held_tracks
        store(
            self,
            position=as_array(self.position, "ToolState.position [m]", (3,), error=error),
            quat_wxyz=quat_wxyz,
            closed=as_flag(self.closed, "ToolState.closed", error=error),
            grasp=as_integer(self.grasp, "ToolState.grasp", at_least=0, error=error),
            radius=as_number(self.radius, "ToolState.radius", unit="m", above=0, error=error),
            held_tracks=tuple(map(int, as_tuple_of(held, "ToolState.held_tracks", (int, np.integer), error=error))),
            by_points=as_flag(self.by_points, "ToolState.by_points", error=error),
        )


@dataclass(frozen=True, kw_only=True)
class ToolReport:
    """The robot's report of the tip position between two observations.

    Raises:
        ObservationError: the time is no integer, or the position is not three finite numbers.
    """

    time: int
    """Time on the clock of `Observation.time` [ns]."""
    position: Float[np.ndarray, " 3"]
    """Position of the tip in the world frame [m]."""

    def __post_init__(self) -> None:
        """Check time and position."""
        store(
            self,
            time=as_integer(self.time, "ToolReport.time [ns]", error=ObservationError),
            position=as_array(self.position, "ToolReport.position [m]", (3,), error=ObservationError),
        )


@dataclass(frozen=True, kw_only=True)
class MeasuredForce:
    """The force on the tool as a sensor measured it.

    Raises:
        ObservationError: the force is not three finite numbers, or the noise is not above 0.
    """

    on_tool: Float[np.ndarray, " 3"]
    """Force of the tissue on the tool in the world frame [N], with the sensor's offset and the tool's own weight."""
    sd: float | None = None
    """Standard deviation of the noise of each component [N]; None where nobody states it."""

    def __post_init__(self) -> None:
        """Check force and noise."""
        name, error = "MeasuredForce", ObservationError
        store(self, on_tool=as_array(self.on_tool, f"{name}.on_tool [N]", (3,), error=error))
        if self.sd is not None:
            store(self, sd=as_number(self.sd, f"{name}.sd", unit="N", above=0, error=error))


@dataclass(frozen=True, kw_only=True)
class Observation:
    """The tool, and images or measured points, at one time; where there are both, the estimator uses the images.

    Raises:
        ObservationError: a field is of another type than stated, or the index is below 0.
    """

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
    force: MeasuredForce | None = None
    """The force on the tool; None where none is measured."""

    def __post_init__(self) -> None:
        """Check the type of every field."""
        error = ObservationError
        as_instance(self.tool, "Observation.tool", ToolState, error=error)
        if self.images is not None:
            as_instance(self.images, "Observation.images", StereoPair, error=error)
        if self.points is not None:
            as_instance(self.points, "Observation.points", MeasuredPoints, error=error)
        if self.force is not None:
            as_instance(self.force, "Observation.force", MeasuredForce, error=error)
        store(
            self,
            index=as_integer(self.index, "Observation.index", at_least=0, error=error),
            time=as_integer(self.time, "Observation.time [ns]", error=error),
            reports=as_tuple_of(self.reports, "Observation.reports", ToolReport, error=error),
            events=as_tuple_of(self.events, "Observation.events", (Cut, Suture), error=error),
        )

    @property
    def lost(self) -> bool:
        """Return whether the frame never came: it has neither images nor points, and the next frame has its index."""
        return self.images is None and self.points is None


@dataclass(frozen=True, kw_only=True)
class DeclaredMesh:
    """A mesh that the user declares for imported data; it may reach beyond the view.

    Raises:
        ObservationError: a field has the wrong type or shape, a vertex is not finite, a triangle names a vertex that
            there is not, or a track id of 0 or above repeats.
    """

    vertices: Float[np.ndarray, "n 3"]
    """Rest positions in the world frame [m]."""
    faces: Int[np.ndarray, "f 3"]
    """Vertex numbers of each triangle, from 0."""
    track_id: Int[np.ndarray, " n"]
    """Track id of the measured point at each vertex; -1 where nothing is measured."""
    held: Bool[np.ndarray, " n"] | None = None
    """Which vertices the jaws hold, where the tool's radius cannot tell; if None, the radius decides."""

    def __post_init__(self) -> None:
        """Check shapes and vertex numbers."""
        name, error = "DeclaredMesh", ObservationError
        vertices = as_array(self.vertices, f"{name}.vertices [m]", (None, 3), error=error)
        faces = as_array(self.faces, f"{name}.faces", (None, 3), kind="whole numbers", error=error)
        outside = np.flatnonzero(((faces < 0) | (faces >= len(vertices))).any(axis=1))
        if outside.size:
            raise error(
                f"{name}.faces[{outside[0]}] is {faces[outside[0]].tolist()}; vertex numbers must lie in "
                f"0..{len(vertices) - 1}, counted from 0."
            )
        store(self, vertices=vertices, faces=faces)
        store(self, track_id=_track_ids(self.track_id, f"{name}.track_id", len(vertices)))
        if self.held is not None:
            store(self, held=as_array(self.held, f"{name}.held", (len(vertices),), kind="booleans", error=error))


@dataclass(frozen=True, kw_only=True)
class Declaration:
    """The user's prior knowledge of the tissue. It is not the truth: it may be wrong.

    Positions alone give stiffness ratios only; `membrane_stiffness` converts them to N/m.

    Raises:
        OptionError: a number is not finite or out of its range, or a field is of another type.
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
    effects: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    """Effects of docs/EFFECTS.md beside all this, by name: the values of their parameters in the effect's units. One
    that has several sites is named with that of its values: `inclusion.14`. `close-loop` finds them."""

    @property
    def hangs(self) -> bool:
        """Return whether the sheet has weight and no bed under it."""
        return not self.bed and any(self.gravity)

    def __post_init__(self) -> None:
        """Check types and ranges."""
        for name, (unit, below) in MATERIAL_BOUNDS.items():
            number = as_number(getattr(self, name), f"Declaration.{name}", unit=unit, above=0, below=below)
            store(self, **{name: number})
        poisson = as_number(self.poisson, "Declaration.poisson")
        if not 0 <= poisson < 0.5:
            raise OptionError(
                f"Declaration.poisson must be in [0, 0.5) for a shell; got {quoted(self.poisson)} "
                "(use 0.49 for nearly incompressible tissue)."
            )
        gravity = as_array(self.gravity, "Declaration.gravity [m/s^2]", (3,))
        if not math.hypot(*gravity) <= MAX_GRAVITY:
            raise OptionError(
                f"Declaration.gravity must be at most {MAX_GRAVITY:g} m/s^2 long; got {quoted(self.gravity)}: is it in "
                "mm/s^2?"
            )
        store(self, poisson=poisson, gravity=tuple(gravity.tolist()), bed=as_flag(self.bed, "Declaration.bed"))
        if self.mesh is not None:
            as_instance(self.mesh, "Declaration.mesh", DeclaredMesh)
        store(self, effects=_effects(self.effects))


def _effects(values: object) -> dict[str, tuple[float, ...]]:
    """Return the values of effects by name, as numbers."""
    where = "Declaration.effects"
    given = as_instance(values, where, Mapping, hint="Give values by the name of the effect.")
    return {str(name): tuple(as_array(each, f"{where}: {name}", (None,)).tolist()) for name, each in given.items()}


def _track_ids(value: object, where: str, count: int) -> Int[np.ndarray, " m"]:
    """Return one track id for each of `count` points; refuse an id of 0 or above that repeats."""
    ids = as_array(value, where, (count,), kind="whole numbers", error=ObservationError)
    used = np.sort(ids[ids >= 0])
    repeated = used[1:][used[1:] == used[:-1]]
    if repeated.size:
        raise ObservationError(
            f"{where} names point {repeated[0]} twice; each id of 0 or above may stand once in a frame, and -1 stands "
            "for a point that is not used."
        )
    return ids
