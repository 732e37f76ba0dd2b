"""Layouts of attachments on a coarse sheet, on which rows of the panel are repeated: some 200 particles, four lifts.

An effect is to be found wherever a sheet is attached. A recording takes two seconds and closing the loop over it two
minutes on a core, so that six layouts can be tried.
"""

from dataclasses import replace

import numpy as np

from jiggle_mj.scenes import Scene
from jiggle_mj.scenes.scene.attachments import Arc, Attachment, Disc, Segment

SPACING = 8e-3
"""Edge length of the reference's mesh [m]."""
CORNER = 0.045
"""Distance of the lifted corners from the middle along each side [m]."""
THICKNESSES = (1e-3, 1.4e-3)
"""Thickness of even and of odd seeds, of one membrane stiffness [m]."""
MEMBRANE_STIFFNESS = 30.0
"""Young's modulus times thickness [N/m]."""
DENSITY = 1000.0
"""Density of the sheet [kg/m^3]."""
ROUGH_EVERY, ROUGH = 3, 0.3
"""The bed of every third seed has this coefficient of friction, which nobody declares."""
JAW_RADIUS, LIFT_HEIGHT, INCREMENTS = 9.5e-3, 0.032, 4
"""Radius of the jaws [m], height of a lift [m], and its increments."""
MESH_SEEDS = (7, 8)
"""Seeds of the reference's mesh for even and for odd seeds."""


def _bar(start: tuple[float, float], end: tuple[float, float], stiffness: float) -> Segment:
    return Segment(start=start, end=end, width=0.013, stiffness=stiffness)


def _disc(centre: tuple[float, float], radius: float, stiffness: float) -> Disc:
    return Disc(centre=centre, radius=radius, stiffness=stiffness)


LAYOUTS: dict[str, tuple[Attachment, ...]] = {
    "band on an arc": (Arc(centre=(0.0, 0.0), radius=0.025, start_deg=-110, end_deg=110, width=0.0135, stiffness=2.0),),
    "three sides": (
        _bar((-0.03, 0.03), (-0.03, -0.02), 2.0),
        _bar((-0.03, -0.02), (0.03, -0.02), 2.0),
        _bar((0.03, -0.02), (0.03, 0.03), 2.0),
    ),
    "soft disc and weld": (_disc((-0.02, 0.012), 0.014, 0.6), _disc((0.022, -0.012), 0.013, np.inf)),
    "three bars": (
        _bar((-0.036, 0.0), (-0.021, 0.0), 0.6),
        _bar((-0.005, 0.0), (0.005, 0.0), 1.5),
        _bar((0.021, 0.0), (0.036, 0.0), 4.0),
    ),
    "five stitches": tuple(
        _disc(centre, 0.008, 4.0)
        for centre in ((-0.025, -0.02), (0.02, -0.025), (0.03, 0.02), (-0.01, 0.028), (0.0, 0.0))
    ),
    "no attachment": (),
}
"""Attachments by name."""


def rough_bed(seed: int) -> bool:
    """Return whether the bed of a seed is rough, so that friction is undeclared too."""
    return seed % ROUGH_EVERY == 0


def on_coarse_sheet(scene: Scene, layout: str, seed: int) -> Scene:
    """Return a scene of the panel on the coarse sheet, with a layout's attachments.

    Args:
        scene: of the panel.
        layout: name in `LAYOUTS`.
        seed: of the scene; it decides the thickness, the mesh and the friction too.
    """
    thickness = THICKNESSES[seed % len(THICKNESSES)]
    corners = ((-CORNER, -CORNER), (CORNER, -CORNER), (CORNER, CORNER), (-CORNER, CORNER))
    return replace(
        scene,
        tissue=replace(
            scene.tissue,
            seed=MESH_SEEDS[seed % len(MESH_SEEDS)],
            spacing=SPACING,
            thickness=thickness,
            young=MEMBRANE_STIFFNESS / thickness,
        ),
        programme=replace(scene.programme, points=corners, increments=INCREMENTS, height=LIFT_HEIGHT),
        attachments=LAYOUTS[layout],
        tweezer=replace(scene.tweezer, radius=JAW_RADIUS),
        declared=replace(scene.declared, thickness=thickness, areal_density=DENSITY * thickness),
        bed=replace(scene.bed, friction=ROUGH if rough_bed(seed) else scene.bed.friction),
    )
