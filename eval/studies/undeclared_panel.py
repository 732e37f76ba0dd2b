"""The panel of closing the loop: what a scene holds and nobody declares, a row each.

A sheet that is attached along an arc is lifted at four corners and one edge, and let down; particles are seen with
noise half of which neighbours share. What would belong to the rest shape if it were there from the start begins after
the still frames.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from jiggle_mj.options import Sensing
from jiggle_mj.scenes import Scene, load_scene
from jiggle_mj.scenes.disturbances.anchors import (
    AnchorBreak,
    AnchorCreep,
    AnchorShift,
    AnchorYield,
    GraspSlip,
    PointPull,
)
from jiggle_mj.scenes.disturbances.reports import (
    CameraBias,
    CameraDrift,
    DepthScale,
    ImageLatency,
    Inertia,
    PointSlip,
    ToolLatency,
    ToolScale,
    ToolTurn,
)
from jiggle_mj.scenes.disturbances.sheet import (
    Anisotropy,
    Bending,
    Heterogeneity,
    Inclusion,
    MaterialDamping,
    Poisson,
    PreStrain,
    StrainStiffening,
    Stretch,
    TissueCreep,
    TissueYield,
)
from jiggle_mj.scenes.disturbances.world import Bed, Friction, Gravity, ViscousDrag
from jiggle_mj.scenes.scene.attachments import Attachment
from jiggle_mj.scenes.scene.disturbance import Disturbance

LATE = 2.2
"""When what would else be in the rest shape begins: after the still frames, before the first grasp [s]."""
MOVING, SLOW = Inertia(magnitude=0.02), 0.03
"""Frames that are taken while the tool has just stopped, and how fast it goes there [m/s]: that a report comes late
shows in no sheet at rest."""

COARSE, SHIPPED = 6.5e-3, 4.5e-3
"""Edge lengths of the reference's mesh: for particles, of which there are fewer than in the shipped scenes; and theirs.
A sheet that is seen is no coarser than the mesh that is laid over it: else its grip ends further inside the jaws."""


@dataclass(frozen=True, kw_only=True)
class PanelRow:
    """One line of the table."""

    disturbances: tuple[Disturbance, ...] = ()
    effects: tuple[str, ...] = ()
    """Their names in the library; none where it has none, or where there is nothing to name."""
    layout: str = "arc"
    """The shipped scene whose attachments it has."""
    sensing: Sensing = "particles"
    spacing: float = COARSE
    """Edge length of the reference's mesh [m]; particles are its vertices, points are as many whatever it is."""
    smooth_share: float = 0.5
    """Of the noise's variance, what neighbours share."""
    sizes: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    """True sizes of its effects, their first parameters, where they have some."""


def _inside(effect: str, *disturbances: Disturbance, size: tuple[float, ...] = ()) -> PanelRow:
    """A row of one effect that the library has."""
    return PanelRow(effects=(effect,), disturbances=disturbances, sizes={effect: size} if size else {})


LEAN, TOWARDS, TURN = np.radians(25), np.radians(30), np.radians(4)
"""Of the gravity that leans, from the vertical and round it; of the tool's way [rad]."""
LEANING = (np.sin(LEAN) * np.cos(TOWARDS), np.sin(LEAN) * np.sin(TOWARDS), 1 - np.cos(LEAN))
BITE = 0.003 * np.array([1.0, 0.3, 0.0]) / np.hypot(1.0, 0.3)
"""By which the anchors are shifted [m]."""

INSIDE: dict[str, PanelRow] = {
    "gravity x 0.3": _inside("gravity", Gravity(magnitude=0.3, start=LATE), size=(0.0, 0.0, 0.7)),
    "gravity leaning": _inside(
        "gravity", Gravity(magnitude=1.0, tilt_deg=25, azimuth_deg=30, start=LATE), size=LEANING
    ),
    "bed lower": _inside("bed", Bed(magnitude=-0.003, start=LATE), size=(-0.003, 0.0, 0.0)),
    # no size: contacts creep, and carry 0.25 to 0.53 of their load along the bed by the time a frame is taken
    "friction": _inside("friction", Friction(magnitude=1.0)),
    "viscous drag": _inside("viscous_drag", ViscousDrag(magnitude=2.0), MOVING),
    "material damping": _inside("material_damping", MaterialDamping(magnitude=0.5), MOVING, size=(0.5,)),
    "tissue creep": _inside("tissue_creep", TissueCreep(magnitude=0.3), size=(0.3,)),
    "inclusion": _inside("inclusion", Inclusion(magnitude=8, centre=(-0.02, -0.02), radius=0.015)),
    "heterogeneity": _inside("heterogeneity", Heterogeneity(magnitude=0.8)),
    "anisotropy": _inside("anisotropy", Anisotropy(magnitude=3.0), size=(3.0,)),
    "poisson": _inside("poisson", Poisson(magnitude=0.1), size=(-0.35,)),
    "stretch": _inside("stretch", Stretch(magnitude=2.5), size=(np.log(2.5),)),
    "bending": _inside("bending", Bending(magnitude=15), size=(np.log(15),)),
    "pre-strain": _inside("pre_strain", PreStrain(magnitude=0.03, start=LATE), size=(0.03, 0.03, 0.0)),
    "stiffening": _inside("strain_stiffening", StrainStiffening(magnitude=400), size=(400.0,)),
    "point pull": _inside("point_pull", PointPull(magnitude=3.0, at=(0.02, 0.02), start=LATE)),
    "anchor shift": _inside(
        "anchor_shift", AnchorShift(magnitude=0.003, direction=(1.0, 0.3, 0.0), start=LATE), size=tuple(BITE)
    ),
    "anchor creep": _inside("anchor_creep", AnchorCreep(magnitude=0.5), size=(0.5,)),
    "tool scale": _inside("tool_scale", ToolScale(magnitude=1.08), size=(-np.log(1.08),)),
    "tool turn": _inside("tool_turn", ToolTurn(magnitude=4.0), size=(0.0, -TURN, 0.0)),
    "tool latency": _inside("tool_latency", ToolLatency(magnitude=0.2), MOVING, size=(0.2,)),
    "image latency": _inside("image_latency", ImageLatency(magnitude=0.2), MOVING, size=(0.2,)),
    "camera bias": _inside("camera_bias", CameraBias(magnitude=0.003, pitch_deg=1.0, start=LATE)),
    "camera drift": _inside("camera_drift", CameraDrift(magnitude=0.0003, roll_deg=0.05, start=LATE)),
    "depth scale": _inside("depth_scale", DepthScale(magnitude=1.03, start=LATE), size=(np.log(1.03),)),
    "point slip": _inside("point_slip", PointSlip(magnitude=0.0002)),
}
"""One effect of the library each."""


def _together(*names: str) -> PanelRow:
    rows = [INSIDE[name] for name in names]
    return PanelRow(
        effects=tuple(effect for row in rows for effect in row.effects),
        disturbances=tuple(sorted((one for row in rows for one in row.disturbances), key=lambda one: one.start)),
        sizes={name: size for row in rows for name, size in row.sizes.items()},
    )


TOGETHER: dict[str, PanelRow] = {
    " and ".join(names): _together(*names)
    for names in (
        ("gravity x 0.3", "tool scale"),
        ("bed lower", "camera bias"),
        ("stretch", "image latency"),
        ("anisotropy", "depth scale"),
        ("point pull", "tool turn"),
        ("bending", "tissue creep"),
    )
}
"""Two effects at once."""
IMAGES: dict[str, PanelRow] = {
    f"{name}, images": replace(INSIDE[name], sensing="stereo", spacing=SHIPPED)
    for name in ("gravity leaning", "stretch", "bed lower", "point pull", "tool scale", "image latency")
}
"""The same from a stereo pair."""
OUTSIDE: dict[str, PanelRow] = {
    "grasp slips": PanelRow(disturbances=(GraspSlip(magnitude=0.006),)),
    "tissue yields": PanelRow(disturbances=(TissueYield(magnitude=0.1),)),
    "anchors yield": PanelRow(disturbances=(AnchorYield(magnitude=0.0015),)),
    "anchors break": PanelRow(disturbances=(AnchorBreak(magnitude=0.01),)),
}
"""What the library leaves out."""
NOTHING: dict[str, PanelRow] = {
    "nothing": PanelRow(),
    "nothing, white noise": PanelRow(smooth_share=0.0),
    "nothing, shared noise": PanelRow(smooth_share=0.8),
    "nothing, finer reference": PanelRow(sensing="points", spacing=3.25e-3),
    "nothing, images": PanelRow(sensing="stereo", spacing=SHIPPED),
    "nothing, U shape": PanelRow(layout="u_shape"),
    "nothing, arc and line": PanelRow(layout="arc_line"),
    "nothing, disc": PanelRow(layout="large_attach"),
}
"""Nothing that is undeclared: what is named there is a false alarm."""
GROUPS = {"inside": INSIDE, "together": TOGETHER, "images": IMAGES, "outside": OUTSIDE, "nothing": NOTHING}
ROWS = {name: row for rows in GROUPS.values() for name, row in rows.items()}
NOISE = 1.5e-4 * 2**0.5
"""Standard deviation of a coordinate, of all noise [m]."""


def scene_with(name: str, seed: int) -> Scene:
    """A shipped scene on a coarser sheet, with more grasps, shared noise, and what the row of this name holds."""
    row = ROWS[name]
    arc, layout = load_scene("arc"), load_scene(row.layout)
    pulls = replace(
        arc.programme,
        still_frames=20,
        points=((-0.047, -0.047), (0.047, -0.047), (0.047, 0.047), (-0.047, 0.047), (0.0, -0.048)),
        height=0.035,
        increments=5,
        lowering=1,
    )
    noise = replace(
        arc.sensing,
        point_sd=NOISE * (1 - row.smooth_share) ** 0.5,
        smooth_sd=NOISE * row.smooth_share**0.5,
        smooth_length=0.012,
        n_points=300,
    )
    return replace(
        arc,
        name=f"undeclared, {name}",
        seed=seed,
        secret=True,
        tissue=replace(arc.tissue, spacing=row.spacing, mesh="unstructured", seed=seed),
        bed=replace(arc.bed, friction=0.1),
        attachments=tuple(_coarser(one) if row.spacing > SHIPPED else one for one in layout.attachments),
        tweezer=replace(arc.tweezer, radius=8e-3, speed=SLOW if MOVING in row.disturbances else arc.tweezer.speed),
        programme=pulls,
        sensing=noise,
        disturbances=row.disturbances,
    )


def _coarser(one: Attachment) -> Attachment:
    """The same attachment where particles are further apart: wider and stiffer."""
    return replace(one, stiffness=2.0, width=2 * one.half_width + 0.002)
