"""The panel of closing the loop: effects that a scene holds and nobody declares, a row each.

A sheet that is attached along an arc is lifted at four corners and one edge, and lowered. Particles are seen with
noise, and neighbours share half of its variance. Effects that would belong to the rest shape if they were there from
the start begin after the still frames.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from jiggle_mj.options import Sensing
from jiggle_mj.scenes import Scene, load_scene
from jiggle_mj.scenes.disturbances.anchors import (
    Adhesion,
    AnchorBreak,
    AnchorCreep,
    AnchorShift,
    AnchorYield,
    GraspSlip,
    PointPull,
    Substrate,
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

from .coarse_layouts import LAYOUTS, on_coarse_sheet

AFTER_STILL_FRAMES = 2.2
"""Start of effects that would otherwise be in the rest shape: after the still frames, before the first grasp [s]."""
UNSETTLED = Inertia(magnitude=0.02)
"""Frames that are taken while the sheet still moves: no sheet at rest shows that a report is late."""
UNSETTLED_SPEED = 0.03
"""Speed of the tool in such rows [m/s]."""
COARSE_SPACING = 6.5e-3
"""Edge length of the reference's mesh in rows from particles [m]: fewer particles than in the shipped scenes."""
SHIPPED_SPACING = 4.5e-3
"""Edge length of the mesh in the shipped scenes [m], for rows from images.

A sheet that is seen is no coarser than the estimator's mesh; otherwise its grip ends further inside the jaws.
"""
POINT_SD = 1.5e-4 * 2**0.5
"""Standard deviation of a coordinate from all noise together [m]."""
SMOOTH_LENGTH = 0.012
"""Distance over which neighbours share noise [m]."""
N_POINTS = 300
"""Points that are seen of the sheet, about as many as the particles of the coarse mesh."""
JAW_RADIUS = 8e-3
"""Radius of the jaws [m]."""
BED_FRICTION = 0.1
"""Coefficient of friction of the bed."""
COARSE_STIFFNESS = 2.0
"""Stiffness of an attachment on the coarse mesh [N/m]: with fewer particles each holds more."""
COARSE_EXTRA_WIDTH = 0.002
"""Width by which an attachment is wider on the coarse mesh [m], so that it holds enough particles."""


@dataclass(frozen=True, kw_only=True)
class PanelRow:
    """One line of the table."""

    disturbances: tuple[Disturbance, ...] = ()
    """Disturbances that the scene holds."""
    effects: tuple[str, ...] = ()
    """Names of the disturbances in the library of effects; none where the library lacks them."""
    layout: str = "arc"
    """Name of the shipped scene whose attachments the row has."""
    coarse_layout: str | None = None
    """Name of a layout on the coarse sheet, in place of that; see `coarse_layouts`."""
    sensing: Sensing = "particles"
    spacing: float = COARSE_SPACING
    """Edge length of the reference's mesh [m], but on the coarse sheet; particles are its vertices, and points do not
    depend on it."""
    smooth_share: float = 0.5
    """Share of the noise's variance that neighbours share."""
    sizes: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    """True values of the first parameters of its effects, where they are defined."""


def _inside(effect: str, *disturbances: Disturbance, size: tuple[float, ...] = ()) -> PanelRow:
    """Return a row of one effect that the library has."""
    return PanelRow(effects=(effect,), disturbances=disturbances, sizes={effect: size} if size else {})


TILT, AZIMUTH = np.radians(25), np.radians(30)
"""Tilt of the gravity from the vertical, and its direction around the vertical [rad]."""
TILTED = (np.sin(TILT) * np.cos(AZIMUTH), np.sin(TILT) * np.sin(AZIMUTH), 1 - np.cos(TILT))
"""Change of the direction of gravity by that tilt, the true value of its parameters."""
TOOL_TURN = np.radians(4)
"""Rotation of the tool's displacements [rad]."""
SHIFT = 0.003 * np.array([1.0, 0.3, 0.0]) / np.hypot(1.0, 0.3)
"""Displacement of the anchors [m]."""

TETHERING = 5e3
"""Stiffness of a hold that is spread over the sheet [N/m^3]."""
NEVER_OFF = 0.1
"""Distance at which a film comes off that never does in these lifts [m]."""

INSIDE: dict[str, PanelRow] = {
    "gravity x 0.3": _inside("gravity", Gravity(magnitude=0.3, start=AFTER_STILL_FRAMES), size=(0.0, 0.0, 0.7)),
    "gravity leaning": _inside(
        "gravity", Gravity(magnitude=1.0, tilt_deg=25, azimuth_deg=30, start=AFTER_STILL_FRAMES), size=TILTED
    ),
    "bed lower": _inside("bed", Bed(magnitude=-0.003, start=AFTER_STILL_FRAMES), size=(-0.003, 0.0, 0.0)),
    # no size: contacts creep, and hold 0.25 to 0.53 of their load along the bed when a frame is taken
    "friction": _inside("friction", Friction(magnitude=1.0)),
    "viscous drag": _inside("viscous_drag", ViscousDrag(magnitude=2.0), UNSETTLED),
    "material damping": _inside("material_damping", MaterialDamping(magnitude=0.5), UNSETTLED, size=(0.5,)),
    "tissue creep": _inside("tissue_creep", TissueCreep(magnitude=0.3), size=(0.3,)),
    "inclusion": _inside("inclusion", Inclusion(magnitude=8, centre=(-0.02, -0.02), radius=0.015)),
    "heterogeneity": _inside("heterogeneity", Heterogeneity(magnitude=0.8)),
    "anisotropy": _inside("anisotropy", Anisotropy(magnitude=3.0), size=(3.0,)),
    "poisson": _inside("poisson", Poisson(magnitude=0.1), size=(-0.35,)),
    "stretch": _inside("stretch", Stretch(magnitude=2.5), size=(np.log(2.5),)),
    "bending": _inside("bending", Bending(magnitude=15), size=(np.log(15),)),
    "pre-strain": _inside("pre_strain", PreStrain(magnitude=0.03, start=AFTER_STILL_FRAMES), size=(0.03, 0.03, 0.0)),
    "stiffening": _inside("strain_stiffening", StrainStiffening(magnitude=400), size=(400.0,)),
    "point pull": _inside("point_pull", PointPull(magnitude=3.0, at=(0.02, 0.02), start=AFTER_STILL_FRAMES)),
    "anchor shift": _inside(
        "anchor_shift",
        AnchorShift(magnitude=0.003, direction=(1.0, 0.3, 0.0), start=AFTER_STILL_FRAMES),
        size=tuple(SHIFT),
    ),
    "anchor creep": _inside("anchor_creep", AnchorCreep(magnitude=0.5), size=(0.5,)),
    "anchors yield": _inside("anchor_yield", AnchorYield(magnitude=0.0015)),
    "tissue yields": _inside("tissue_yield", TissueYield(magnitude=0.1)),
    "grasp slips": _inside("grasp_slip", GraspSlip(magnitude=0.006)),
    "substrate": _inside("substrate", Substrate(magnitude=5.0)),
    "tethering": _inside(
        "tethering", Adhesion(magnitude=TETHERING * NEVER_OFF**2 / 2, reach=NEVER_OFF), size=(TETHERING,)
    ),
    "tool scale": _inside("tool_scale", ToolScale(magnitude=1.08), size=(-np.log(1.08),)),
    "tool turn": _inside("tool_turn", ToolTurn(magnitude=4.0), size=(0.0, -TOOL_TURN, 0.0)),
    "tool latency": _inside("tool_latency", ToolLatency(magnitude=0.2), UNSETTLED, size=(0.2,)),
    "image latency": _inside("image_latency", ImageLatency(magnitude=0.2), UNSETTLED, size=(0.2,)),
    "camera bias": _inside("camera_bias", CameraBias(magnitude=0.003, pitch_deg=1.0, start=AFTER_STILL_FRAMES)),
    "camera drift": _inside("camera_drift", CameraDrift(magnitude=0.0003, roll_deg=0.05, start=AFTER_STILL_FRAMES)),
    "depth scale": _inside("depth_scale", DepthScale(magnitude=1.03, start=AFTER_STILL_FRAMES), size=(np.log(1.03),)),
    "point slip": _inside("point_slip", PointSlip(magnitude=0.0002)),
}
"""Rows of one effect of the library each."""


def _together(*names: str) -> PanelRow:
    rows = [INSIDE[name] for name in names]
    return PanelRow(
        effects=tuple(effect for row in rows for effect in row.effects),
        disturbances=tuple(sorted((d for row in rows for d in row.disturbances), key=lambda d: d.start)),
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
"""Rows of two effects at once."""
IMAGES: dict[str, PanelRow] = {
    f"{name}, images": replace(INSIDE[name], sensing="stereo", spacing=SHIPPED_SPACING)
    for name in ("gravity leaning", "stretch", "bed lower", "point pull", "tool scale", "image latency")
}
"""Rows of one effect each, seen by a stereo pair."""
OUTSIDE: dict[str, PanelRow] = {
    "anchors break": PanelRow(disturbances=(AnchorBreak(magnitude=0.01),)),
}
"""Rows of an effect that the library does not have."""
NOTHING: dict[str, PanelRow] = {
    "nothing": PanelRow(),
    "nothing, white noise": PanelRow(smooth_share=0.0),
    "nothing, shared noise": PanelRow(smooth_share=0.8),
    "nothing, finer reference": PanelRow(sensing="points", spacing=3.25e-3),
    "nothing, images": PanelRow(sensing="stereo", spacing=SHIPPED_SPACING),
    "nothing, U shape": PanelRow(layout="u_shape"),
    "nothing, arc and line": PanelRow(layout="arc_line"),
    "nothing, disc": PanelRow(layout="large_attach"),
}
"""Rows without an undeclared effect: whatever is named there is a false alarm."""
OF_ANCHORS = {"anchor_shift", "anchor_creep", "anchor_yield", "substrate"}
"""Effects that a sheet without attachments cannot have."""
ON_LAYOUTS: dict[str, PanelRow] = {
    f"{name}, {layout}": replace(row, coarse_layout=layout)
    for layout, attachments in LAYOUTS.items()
    for name, row in {**INSIDE, "nothing": PanelRow()}.items()
    if attachments or not OF_ANCHORS & set(row.effects)
}
"""Rows of one effect, and one of nothing, on each layout of the coarse sheet."""
GROUPS = {
    "inside": INSIDE,
    "together": TOGETHER,
    "images": IMAGES,
    "outside": OUTSIDE,
    "nothing": NOTHING,
    "layouts": ON_LAYOUTS,
}
ROWS = {name: row for rows in GROUPS.values() for name, row in rows.items()}
USUAL_GROUPS = tuple(group for group in GROUPS if group != "layouts")
"""Groups that are run if none are chosen: the layouts have more rows than all others together."""


def rows_of(groups: Iterable[str]) -> tuple[str, ...]:
    """Return the names of all rows of some groups."""
    return tuple(row for group in groups for row in GROUPS[group])


def scene_with(name: str, seed: int) -> Scene:
    """Return a shipped scene on a coarser sheet, with more grasps, shared noise, and the disturbances of a row.

    Args:
        name: of the row.
        seed: of mesh and noise.
    """
    row = ROWS[name]
    arc, attachments = load_scene("arc"), load_scene(row.layout).attachments
    if row.spacing > SHIPPED_SPACING:
        attachments = tuple(_coarser(attachment) for attachment in attachments)
    speed = UNSETTLED_SPEED if UNSETTLED in row.disturbances else arc.tweezer.speed
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
        point_sd=POINT_SD * (1 - row.smooth_share) ** 0.5,
        smooth_sd=POINT_SD * row.smooth_share**0.5,
        smooth_length=SMOOTH_LENGTH,
        n_points=N_POINTS,
    )
    scene = replace(
        arc,
        name=f"undeclared, {name}",
        seed=seed,
        secret=True,
        tissue=replace(arc.tissue, spacing=row.spacing, mesh="unstructured", seed=seed),
        bed=replace(arc.bed, friction=BED_FRICTION),
        attachments=attachments,
        tweezer=replace(arc.tweezer, radius=JAW_RADIUS, speed=speed),
        programme=pulls,
        sensing=noise,
        disturbances=row.disturbances,
    )
    return scene if row.coarse_layout is None else on_coarse_sheet(scene, row.coarse_layout, seed)


def _coarser(attachment: Attachment) -> Attachment:
    """Return the attachment for a mesh with particles further apart: wider and stiffer."""
    width = 2 * attachment.half_width + COARSE_EXTRA_WIDTH
    return replace(attachment, stiffness=COARSE_STIFFNESS, width=width)
