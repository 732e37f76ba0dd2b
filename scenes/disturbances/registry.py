"""All disturbances by name, and how the command line writes them.

The names are those of the estimator's effects: what a scene calls `gravity` is found as `gravity`.
"""

from collections.abc import Iterable
from dataclasses import fields, replace
from difflib import get_close_matches

from jiggle_mj.errors import SceneError

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


def described(disturbance: Disturbance) -> str:
    """Name, magnitude, and what else differs from the defaults: gravity=1 [start=3, tilt_deg=20]."""
    others = [f for f in fields(disturbance) if f.name != "magnitude" and getattr(disturbance, f.name) != f.default]
    more = ", ".join(f"{f.name}={_plain(getattr(disturbance, f.name))}" for f in others)
    return f"{disturbance.kind()}={disturbance.magnitude:g}" + (f" [{more}]" if more else "")


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
