"""All disturbances by name, and how the command line writes them.

The names are those of the estimator's effects: what a scene calls `gravity` is found as `gravity`.
"""

from collections.abc import Iterable
from dataclasses import fields, replace
from difflib import get_close_matches

from jiggle_mj.scenes import anchor_disturbances as anchor
from jiggle_mj.scenes import image_disturbances as image
from jiggle_mj.scenes import report_disturbances as report
from jiggle_mj.scenes import sheet_disturbances as sheet
from jiggle_mj.scenes import world_disturbances as world
from jiggle_mj.scenes.disturbance import Disturbance
from jiggle_mj.scenes.scene import Scene

from jiggle_mj.errors import SceneError

DISTURBANCES: dict[str, type[Disturbance]] = {
    "gravity": world.Gravity,
    "bed": world.Bed,
    "friction": world.Friction,
    "viscous_drag": world.ViscousDrag,
    "material_damping": sheet.MaterialDamping,
    "tissue_creep": sheet.TissueCreep,
    "inclusion": sheet.Inclusion,
    "heterogeneity": sheet.Heterogeneity,
    "anisotropy": sheet.Anisotropy,
    "poisson": sheet.Poisson,
    "stretch": sheet.Stretch,
    "bending": sheet.Bending,
    "pre_strain": sheet.PreStrain,
    "strain_stiffening": sheet.StrainStiffening,
    "tissue_yield": sheet.TissueYield,
    "point_pull": anchor.PointPull,
    "adhesion": anchor.Adhesion,
    "anchor_shift": anchor.AnchorShift,
    "anchor_creep": anchor.AnchorCreep,
    "anchor_yield": anchor.AnchorYield,
    "anchor_break": anchor.AnchorBreak,
    "substrate": anchor.Substrate,
    "grasp_slip": anchor.GraspSlip,
    "inertia": report.Inertia,
    "tool_bias": report.ToolBias,
    "tool_scale": report.ToolScale,
    "tool_turn": report.ToolTurn,
    "tool_latency": report.ToolLatency,
    "camera_bias": report.CameraBias,
    "camera_drift": report.CameraDrift,
    "depth_scale": report.DepthScale,
    "image_latency": report.ImageLatency,
    "frame_drop": report.FrameDrop,
    "frame_repeat": report.FrameRepeat,
    "point_slip": report.PointSlip,
    "image_noise": image.ImageNoise,
    "blur": image.Blur,
    "specular": image.Specular,
    "haze": image.Haze,
    "tool_occlusion": image.ToolOcclusion,
    "dark_patches": image.DarkPatches,
    "exposure": image.Exposure,
}


MATERIAL = (sheet.Inclusion, sheet.Heterogeneity, sheet.Anisotropy, sheet.Poisson, sheet.Stretch, sheet.Bending)
"""Those that make the sheet another elastic sheet."""


def named(name: object) -> type[Disturbance]:
    """The disturbance of that name.

    Raises:
        SceneError: there is none; the message lists those there are.
    """
    if name is None:
        raise SceneError('a disturbance lacks its name; write name = "gravity", say.')
    if not isinstance(name, str) or name not in DISTURBANCES:
        near = get_close_matches(str(name), DISTURBANCES, n=1)
        hint = f"; did you mean {near[0]}?" if near else ";"
        raise SceneError(f"no disturbance named {name!r}{hint} There are {', '.join(DISTURBANCES)}.")
    return DISTURBANCES[name]


def name_of(disturbance: Disturbance) -> str:
    """What scene files call it."""
    return next(name for name, cls in DISTURBANCES.items() if type(disturbance) is cls)


def described(disturbance: Disturbance) -> str:
    """Name, magnitude, and what else differs from the defaults: gravity=1 [start=3, tilt_deg=20]."""
    others = [f for f in fields(disturbance) if f.name != "magnitude" and getattr(disturbance, f.name) != f.default]
    more = ", ".join(f"{f.name}={_plain(getattr(disturbance, f.name))}" for f in others)
    return f"{name_of(disturbance)}={disturbance.magnitude:g}" + (f" [{more}]" if more else "")


def _plain(value: object) -> str:
    return str(list(value)) if isinstance(value, tuple) else f"{value:g}"


def disturbed(scene: Scene, texts: Iterable[str]) -> Scene:
    """A scene with more disturbances, each written as NAME or NAME=MAGNITUDE.

    Raises:
        SceneError: an unknown name, or a magnitude that is no number or out of its range.
    """
    return replace(scene, disturbances=(*scene.disturbances, *map(_read, texts)))


def _read(text: str) -> Disturbance:
    name, equals, magnitude = text.partition("=")
    base, dot, _ = name.partition(".")
    if dot and base in DISTURBANCES:
        raise SceneError(f"{text!r}: only the magnitude can be given here; other keys of {base} go into a scene file.")
    cls = named(name)
    try:
        return cls(**{"magnitude": float(magnitude)} if equals else {})
    except ValueError:
        raise SceneError(f"{text!r}: the magnitude must be a number, as in {name}=2.") from None
    except SceneError as error:
        raise SceneError(str(error).replace("disturbances.magnitude", name, 1)) from None
