"""All disturbances by name, and how the command line writes them.

The names are those of the estimator's effects: what a scene calls `gravity` is found as `gravity`.
"""

from collections.abc import Iterable
from dataclasses import replace

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


MATERIAL = (sheet.Inclusion, sheet.Heterogeneity, sheet.Anisotropy, sheet.Stretch, sheet.Bending)
"""Those that make the sheet another elastic sheet."""


def named(name: object) -> type[Disturbance]:
    """The disturbance of that name.

    Raises:
        SceneError: there is none; the message lists those there are.
    """
    if not isinstance(name, str) or name not in DISTURBANCES:
        raise SceneError(f"no disturbance named {name!r}; there are {', '.join(DISTURBANCES)}.")
    return DISTURBANCES[name]


def disturbed(scene: Scene, texts: Iterable[str]) -> Scene:
    """A scene with more disturbances, each written as NAME or NAME=MAGNITUDE.

    Raises:
        SceneError: an unknown name, or a magnitude that is no number or out of its range.
    """
    return replace(scene, disturbances=(*scene.disturbances, *map(_read, texts)))


def _read(text: str) -> Disturbance:
    name, equals, magnitude = text.partition("=")
    cls = named(name)
    try:
        return cls(**{"magnitude": float(magnitude)} if equals else {})
    except ValueError:
        raise SceneError(f"{text!r}: the magnitude must be a number, as in {name}=2.") from None
    except SceneError as error:
        raise SceneError(str(error).replace("disturbances.magnitude", name, 1)) from None
