"""All disturbances by name, and the text form that the command line and reports use.

A disturbance has the name of the estimator's effect for it: the effect `gravity` explains the disturbance `gravity`.
"""

from collections.abc import Iterable
from dataclasses import fields, replace

from jiggle_mj.argument_checks import as_instance, quoted
from jiggle_mj.errors import SceneError
from jiggle_mj.likely_name import did_you_mean

from ..scene.disturbance import Disturbance
from ..scene.scene import Scene
from . import anchors as anchor
from . import images as image
from . import reports as report
from . import sheet as sheet
from . import world as world

DISTURBANCES: dict[str, type[Disturbance]] = {
    cls.kind(): cls
    for cls in (
        world.Gravity,
        world.Bed,
        world.Friction,
        world.ViscousDrag,
        sheet.MaterialDamping,
        sheet.TissueCreep,
        sheet.Inclusion,
        sheet.Heterogeneity,
        sheet.Anisotropy,
        sheet.Poisson,
        sheet.Stretch,
        sheet.Bending,
        sheet.PreStrain,
        sheet.StrainStiffening,
        sheet.TissueYield,
        anchor.PointPull,
        anchor.Adhesion,
        anchor.AnchorShift,
        anchor.AnchorCreep,
        anchor.AnchorYield,
        anchor.AnchorBreak,
        anchor.Substrate,
        anchor.GraspSlip,
        report.Inertia,
        report.ToolBias,
        report.ToolScale,
        report.ToolTurn,
        report.ToolLatency,
        report.CameraBias,
        report.CameraDrift,
        report.DepthScale,
        report.ImageLatency,
        report.FrameDrop,
        report.FrameRepeat,
        report.PointSlip,
        image.ImageNoise,
        image.Blur,
        image.Specular,
        image.Haze,
        image.ToolOcclusion,
        image.DarkPatches,
        image.Exposure,
    )
}
"""Class of each disturbance by its name, in the order of docs/DISTURBANCES.md."""
MATERIAL = (sheet.Inclusion, sheet.Heterogeneity, sheet.Anisotropy, sheet.Poisson, sheet.Stretch, sheet.Bending)
"""Disturbances that change the elastic constants of the sheet; the load tests measure them."""


def disturbance_class(name: object) -> type[Disturbance]:
    """Return the class of the disturbance with this name.

    Raises:
        SceneError: there is none; the message lists all names.
    """
    if name is None:
        raise SceneError('a disturbance lacks its name; write for example name = "gravity".')
    if not isinstance(name, str) or name not in DISTURBANCES:
        hint = did_you_mean(name, DISTURBANCES)
        raise SceneError(f"no disturbance named {quoted(name)}{hint} There are {', '.join(DISTURBANCES)}.")
    return DISTURBANCES[name]


def describe(disturbance: Disturbance) -> str:
    """Return name, magnitude, and all other keys that differ from their defaults: gravity=1 [start=3, tilt_deg=20]."""
    changed = [f for f in fields(disturbance) if f.name != "magnitude" and getattr(disturbance, f.name) != f.default]
    more = ", ".join(f"{f.name}={_plain(getattr(disturbance, f.name))}" for f in changed)
    return f"{disturbance.kind()}={disturbance.magnitude:g}" + (f" [{more}]" if more else "")


def _plain(value: object) -> str:
    return str(list(value)) if isinstance(value, tuple) else f"{value:g}"


def disturbed(scene: Scene, texts: Iterable[str]) -> Scene:
    """Return a scene with more disturbances, each written as NAME or NAME=MAGNITUDE.

    Raises:
        SceneError: a name is unknown, or a magnitude is not a number or out of its range.
    """
    as_instance(scene, "scene", Scene, hint="load_scene(NAME) reads one.", error=SceneError)
    if isinstance(texts, str) or not isinstance(texts, Iterable):
        raise SceneError(f"disturbances must be a list of NAME or NAME=MAGNITUDE; got {texts!r}.")
    return replace(scene, disturbances=(*scene.disturbances, *map(_read, texts)))


def _read(text: str) -> Disturbance:
    as_instance(text, "a disturbance", str, error=SceneError)
    name, equals, magnitude = text.partition("=")
    base, dot, _ = name.partition(".")
    if dot and base in DISTURBANCES:
        raise SceneError(f"{text!r}: only the magnitude can be given here; other keys of {base} go into a scene file.")
    cls = disturbance_class(name)
    try:
        return cls(**{"magnitude": float(magnitude)} if equals else {})
    except ValueError:
        raise SceneError(f"{text!r}: the magnitude must be a number, as in {name}=2.") from None
    except SceneError as error:
        raise SceneError(str(error).replace("disturbances.magnitude", name, 1)) from None
