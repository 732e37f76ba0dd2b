"""The sections and keys of a scene, with units, defaults and ranges. Nothing here touches MuJoCo.

Tissue coordinates are the world's x and y in metres, with the origin in the middle of the sheet and the bed at z = 0.
Angles are in degrees and their names say so.

The path of a key: `scene_file.py` reads it from TOML into the section below that has its name; `tissue/model.py` writes
it into MuJoCo's specification (its docstring lists which function writes which section).
"""

import math
from dataclasses import dataclass, field, fields
from typing import ClassVar

from jiggle_mj import limits
from jiggle_mj.argument_checks import as_flag, as_instance, as_integer, as_tuple_of
from jiggle_mj.errors import SceneError
from jiggle_mj.observation import Declaration
from jiggle_mj.options import POLICIES

from .attachments import Attachment
from .disturbance import Disturbance
from .section import Section, choice, integer, number, points, switch, vector

MAX_VERTICES = 20_000
"""Largest number of vertices of a sheet; 30 times a shipped scene's, so that a spacing in a wrong unit is refused."""


@dataclass(frozen=True, kw_only=True)
class TissueConfig(Section):
    """The sheet: a thin shell of St Venant-Kirchhoff material."""

    section: ClassVar[str] = "tissue"
    size: tuple[float, float] = vector((0.1, 0.1), length=2, unit="m", above=0, at_most=1)
    """Extent in x and y [m]."""
    thickness: float = number(1e-3, unit="m", above=0, at_most=0.02)
    young: float = number(30e3, unit="Pa", above=0, at_most=1e9)
    """Young's modulus [Pa]."""
    poisson: float = number(0.45, at_least=0, below=0.5)
    density: float = number(1000.0, unit="kg/m^3", above=0, at_most=1e5)
    """Mass per volume [kg/m^3]."""
    damping: float = number(0.01, unit="s", at_least=0, at_most=10)
    """Rayleigh damping: viscous stress over the rate of elastic stress [s]."""
    mesh: str = choice("unstructured", among=("equilateral", "unstructured"))
    spacing: float = number(4.5e-3, unit="m", above=0, at_most=0.05)
    """Intended edge length [m]."""
    seed: int = integer(0, at_least=0, at_most=2**32 - 1)
    """Seed of the unstructured mesh."""
    radius: float = number(2e-4, unit="m", above=0, at_most=5e-3)
    """Half the thickness of the sheet in contact and in images [m]."""


@dataclass(frozen=True, kw_only=True)
class BedConfig(Section):
    """The plane under the tissue."""

    section: ClassVar[str] = "bed"
    present: bool = switch(True)
    friction: float = number(0.3, at_least=0, at_most=10)
    """Coulomb coefficient between tissue and bed."""


@dataclass(frozen=True, kw_only=True)
class TweezerConfig(Section):
    """The tool that grasps the tissue."""

    section: ClassVar[str] = "tweezer"
    radius: float = number(7e-3, unit="m", above=0, at_most=0.05)
    """Vertices within this distance of the tip are held when the jaws close [m]."""
    speed: float = number(0.15, unit="m/s", at_least=1e-3, at_most=1)
    """Speed of the tip while it holds tissue [m/s]; slower, a lift of 4 cm would take more than 2000 steps."""


@dataclass(frozen=True, kw_only=True)
class ProgrammeConfig(Section):
    """The sequence of grasps and lifts, and the policy that may replace it."""

    section: ClassVar[str] = "programme"
    policy: str = choice("corners", among=POLICIES)
    """Policy of `run` without `--policy`; `corners` takes the grasps below."""
    still_frames: int = integer(20, at_least=1, at_most=1000)
    """Number of frames before the first grasp, from which noise can be learned."""
    points: tuple[tuple[float, float], ...] = points((), at_least=0)
    """Grasp points in tissue coordinates [m]; empty means the four corners."""
    inset: float = number(3e-3, unit="m", at_least=0, at_most=0.05)
    """Distance of a corner's grasp point from the two edges [m]."""
    height: float = number(0.042, unit="m", above=0, at_most=0.5)
    """Length of the lift [m]."""
    increments: int = integer(8, at_least=1, at_most=1000)
    """Number of moves of a lift, one observation each."""
    lean_deg: float = number(8.0, unit="degrees", at_least=-80, at_most=80)
    """Direction of the lift: 0 is straight up, positive leans towards the middle of the sheet."""
    lowering: int = integer(1, at_least=0, at_most=1000)
    """Number of moves back to the grasp point before the jaws open; 0 opens them at the top."""


@dataclass(frozen=True, kw_only=True)
class ProcedureConfig(Section):
    """Success and properties of cuts and sutures."""

    section: ClassVar[str] = "procedure"
    cut_fails: float = number(0.0, at_least=0, at_most=1)
    """Probability that a cut changes nothing."""
    suture_fails: float = number(0.0, at_least=0, at_most=1)
    """Probability that a suture does not hold."""
    suture_slack: float = number(0.0, unit="m", at_least=0, at_most=0.05)
    """Length up to which the thread is loose [m]."""
    suture_length: float = number(0.03, unit="m", above=0, at_most=1)
    """Length of the line that the policy `suture` sews [m]."""
    suture_width: float = number(7e-3, unit="m", above=0, at_most=1)
    """Width of the band that it sews [m]."""
    suture_stiffness: float = number(1.0, unit="N/m", above=0, at_most=1e6)
    """Stiffness of each vertex that it sews [N/m]."""
    suture_offset: tuple[float, float, float] = vector((0.0, 0.0, 0.0), length=3, unit="m")
    """Anchor of a suture minus the rest position of its vertex, world [m]."""


@dataclass(frozen=True, kw_only=True)
class LimitsConfig(Section):
    """Limits on attachment loads and on the tip, which the policies keep."""

    section: ClassVar[str] = "limits"
    energy: float = number(1e-7, unit="J", above=0, at_most=1)
    """Largest energy in the attachments, as the mean over all vertices [J]."""
    force: float = number(1e-2, unit="N", above=0, at_most=1e3)
    """Largest force on any one attachment [N]."""
    chance: float = number(0.01, above=0, below=0.5)
    """Largest probability that a planned step exceeds one of the two."""
    unknown: float = number(1.0, unit="N/m", above=0, at_most=1e6)
    """Stiffness that a plan assumes for attachments not found yet [N/m]."""
    ceiling: float = number(0.06, unit="m", above=0, at_most=1)
    """Largest height of the tip above the bed [m]."""
    beside: float = number(0.01, unit="m", above=0, at_most=1)
    """Largest horizontal distance of the tip beyond the resting sheet's extent [m]."""

    def limits(self) -> limits.Limits:
        """Return the limits in the vocabulary that the policies share."""
        return limits.Limits(**{f.name: getattr(self, f.name) for f in fields(self)})


@dataclass(frozen=True, kw_only=True)
class CameraConfig(Section):
    """The stereo pair, which looks at a point from a distance and is tilted about the world's x axis."""

    section: ClassVar[str] = "camera"
    width: int = integer(640, at_least=16, at_most=4096)
    """Image width [px]."""
    height: int = integer(480, at_least=16, at_most=4096)
    """Image height [px]."""
    baseline: float = number(5e-3, unit="m", above=0, at_most=0.5)
    """Distance between the two cameras [m]."""
    distance: float = number(0.14, unit="m", above=0, at_most=5)
    """Distance from the pair's middle to the target [m]."""
    target: tuple[float, float, float] = vector((0.0, 0.004, 0.01), length=3, unit="m")
    """Point on the pair's middle axis, world [m]."""
    tilt_deg: float = number(15.0, unit="degrees", at_least=-80, at_most=80)
    """Tilt [degrees]: 0 looks straight down, positive looks from the side of negative y."""
    fov_deg: float = number(50.0, unit="degrees", above=0, below=170)
    """Vertical field of view [degrees]."""


@dataclass(frozen=True, kw_only=True)
class LightsConfig(Section):
    """Ambient light and one lamp beside the camera; intensities in [0, 1]."""

    section: ClassVar[str] = "lights"
    ambient: float = number(0.45, at_least=0, at_most=1)
    lamp: float = number(0.55, at_least=0, at_most=1)
    specular: float = number(0.0, at_least=0, at_most=1)
    """Strength of highlights on the tissue."""


@dataclass(frozen=True, kw_only=True)
class TextureConfig(Section):
    """Appearance of tissue and bed, drawn from a seed."""

    section: ClassVar[str] = "texture"
    seed: int = integer(0, at_least=0, at_most=2**32 - 1)
    contrast: float = number(1.0, at_least=0, at_most=1.5)
    """Contrast: 1 is a membrane rich in vessels, 0 is a plain sheet."""
    resolution: int = integer(1024, at_least=64, at_most=4096)
    """Number of texture pixels along each side."""


@dataclass(frozen=True, kw_only=True)
class SensingConfig(Section):
    """Number and noise of the measurements."""

    section: ClassVar[str] = "sensing"
    point_sd: float = number(2e-4, unit="m", above=0, at_most=0.1)
    """Standard deviation of the independent noise of each coordinate of a measured point [m]."""
    smooth_sd: float = number(0.0, unit="m", at_least=0, at_most=0.1)
    """Standard deviation of additional noise that neighbouring points share, as those of a tracker do [m]."""
    smooth_length: float = number(0.01, unit="m", above=0, at_most=1)
    """Distance over the sheet at which the correlation of that noise is exp(-1/2) [m]."""
    n_points: int = integer(600, at_least=10, at_most=100000)
    """Number of tracked material points with `--sensing points`."""
    cloud_points: int = integer(3000, at_least=10, at_most=100000)
    """Number of points in each frame with `--sensing cloud`."""
    image_sd: float = number(2.0, unit="grey levels", at_least=0, at_most=100)
    """Standard deviation of the noise of each pixel [grey levels]."""
    force_sd: float = number(0.0, unit="N", at_least=0, at_most=10)
    """Standard deviation of the noise of each component of the force on the tool [N]; 0: no force is measured."""


@dataclass(frozen=True, kw_only=True)
class DeclaredConfig(Section):
    """What the estimator is given before the first frame. It may differ from the tissue."""

    section: ClassVar[str] = "declared"
    membrane_stiffness: float = number(30.0, unit="N/m", above=0)
    poisson: float = number(0.45, at_least=0, below=0.5)
    thickness: float = number(1e-3, unit="m", above=0)
    areal_density: float = number(1.0, unit="kg/m^2", above=0)
    gravity: tuple[float, float, float] = vector((0.0, 0.0, -9.81), length=3, unit="m/s^2")
    bed: bool = switch(True)

    def declaration(self) -> Declaration:
        """Return the declaration in the vocabulary that the estimator shares."""
        return Declaration(
            membrane_stiffness=self.membrane_stiffness,
            poisson=self.poisson,
            thickness=self.thickness,
            areal_density=self.areal_density,
            gravity=self.gravity,
            bed=self.bed,
        )


@dataclass(frozen=True, kw_only=True)
class Scene:
    """One scene: every section, checked. A tissue without attachments is allowed."""

    name: str
    seed: int = 0
    """Seed of the sensing noise, together with the seed of a run; two scenes with two seeds never share noise."""
    tissue: TissueConfig = field(default_factory=TissueConfig)
    bed: BedConfig = field(default_factory=BedConfig)
    attachments: tuple[Attachment, ...] = ()
    disturbances: tuple[Disturbance, ...] = ()
    """What happens without the estimator being informed; those that start together begin in this order."""
    secret: bool = False
    """Whether the truth file alone says that there are disturbances."""
    tweezer: TweezerConfig = field(default_factory=TweezerConfig)
    programme: ProgrammeConfig = field(default_factory=ProgrammeConfig)
    procedure: ProcedureConfig = field(default_factory=ProcedureConfig)
    limits: LimitsConfig = field(default_factory=LimitsConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    lights: LightsConfig = field(default_factory=LightsConfig)
    texture: TextureConfig = field(default_factory=TextureConfig)
    sensing: SensingConfig = field(default_factory=SensingConfig)
    declared: DeclaredConfig = field(default_factory=DeclaredConfig)

    def __post_init__(self) -> None:
        """Check the types, then the relations between sections."""
        as_instance(self.name, "Scene.name", str, error=SceneError)
        as_integer(self.seed, "Scene.seed", at_least=0, error=SceneError)
        as_flag(self.secret, "Scene.secret", error=SceneError)
        as_tuple_of(self.attachments, "Scene.attachments", Attachment, error=SceneError)
        as_tuple_of(self.disturbances, "Scene.disturbances", Disturbance, error=SceneError)
        for entry in fields(self):
            if isinstance(entry.type, type) and issubclass(entry.type, Section):
                as_instance(getattr(self, entry.name), f"Scene.{entry.name}", entry.type, error=SceneError)
        if self.tissue.spacing > min(self.tissue.size) / 4:
            raise SceneError(
                f"tissue.spacing = {self.tissue.spacing}: must be at most a quarter of the shorter side, "
                f"{min(self.tissue.size) / 4:g} m."
            )
        n = self.tissue.size[0] / self.tissue.spacing * self.tissue.size[1] / self.tissue.spacing / math.sqrt(0.75)
        if n > MAX_VERTICES:
            raise SceneError(
                f"tissue.spacing = {self.tissue.spacing} m on {self.tissue.size[0]:g} by {self.tissue.size[1]:g} m "
                f"makes about {n:.3g} vertices; at most {MAX_VERTICES} are allowed. Raise spacing or shrink the sheet."
            )
        for disturbance in self.disturbances:
            disturbance.check(self.tissue.size)
        half = tuple(side / 2 for side in self.tissue.size)
        for x, y in self.programme.points:
            if abs(x) > half[0] or abs(y) > half[1]:
                raise SceneError(
                    f"programme.points holds ({x:g}, {y:g}), off the tissue: |x| can be at most {half[0]:g} m, "
                    f"|y| at most {half[1]:g} m."
                )
