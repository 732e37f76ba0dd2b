"""How stiff the compiled tissue is: static load tests on its own mesh, without bed, attachments and weight.

Membrane: the vertices of the outline are held on homogeneously strained places, the others find rest, and the mean
membrane force follows from the forces on the outline. Bending: what lies outside a disc is held, a unit pressure is put
on the disc, and D times the biharmonic of the deflection is 1 (Timoshenko and Woinowsky-Krieger, Theory of Plates and
Shells, 1959, chapter 4); solved with the model's stiffness matrix, as stepping comes too slowly to so weak a rest.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from .disturbances.registry import MATERIAL
from .disturbances.world import Gravity
from .scene.scene import BedConfig, Scene, TissueConfig
from .tissue.simulation import Simulation

STRAIN = 2e-3
"""Of the membrane tests, both ways."""
NUDGE = 1e-8
"""Displacement for the derivative of bending forces [m]."""
DISC = 0.42
"""Radius of the disc over the shorter side."""
FITTED, ENOUGH = 0.8, 40
"""Share of the disc's radius within which a quartic is fitted to its deflection, and to how many vertices at least."""
RIGID = 1e4
"""Stiffness of what holds a vertex, over the membrane's."""
STILL = 1e-7
"""[m/s]."""
MESHES = (1.5, 1.0, 0.75)
"""Times the scene's spacing."""
TOLERATED = 0.1
"""Share by which a stiffness may differ from the declared one without a word."""


@dataclass(frozen=True, kw_only=True)
class Stiffness:
    """Of a sheet, for small strains."""

    spacing: float
    """Of the mesh [m]."""
    stretch_x: float
    """Force over width and strain of a strip along x that may narrow: Young's modulus times thickness [N/m]."""
    stretch_y: float
    """Along y [N/m]."""
    poisson: float
    """Of a strip along x."""
    shear: float
    """Shear modulus times thickness [N/m]."""
    bending: float
    """D [N m]; NaN on a mesh too coarse to tell."""


def typed(tissue: TissueConfig) -> Stiffness:
    """What the typed material has, as an isotropic plate."""
    stretch, nu = tissue.young * tissue.thickness, tissue.poisson
    return Stiffness(
        spacing=tissue.spacing,
        stretch_x=stretch,
        stretch_y=stretch,
        poisson=nu,
        shear=stretch / (2 * (1 + nu)),
        bending=stretch * tissue.thickness**2 / (12 * (1 - nu**2)),
    )


QUANTITIES = {"stretch_x": "N/m", "stretch_y": "N/m", "poisson": "1", "shear": "N/m", "bending": "N m"}
"""What is found, and its unit."""


def far_from_declared(scene: Scene, found: tuple[Stiffness, ...]) -> list[str]:
    """In words, what on the scene's own mesh is further than `TOLERATED` from what the estimator is told."""
    own = next(one for one in found if one.spacing == scene.tissue.spacing)
    declared = scene.declared
    told = typed(
        replace(
            scene.tissue,
            young=declared.membrane_stiffness / declared.thickness,
            thickness=declared.thickness,
            poisson=declared.poisson,
        )
    )
    ratios = {name: getattr(own, name) / getattr(told, name) for name in QUANTITIES if getattr(told, name) > 0}
    return [
        f"{name.replace('_', ' ')} is {ratio:.3g} times what [declared] says."
        for name, ratio in ratios.items()
        if abs(ratio - 1) > TOLERATED  # never of NaN
    ]


def load_tests(scene: Scene, *, log: Callable[[str], None] = lambda _: None) -> tuple[Stiffness, ...]:
    """Stiffness of the scene's sheet on its own mesh, a finer one, and a coarser one unless it is too coarse.

    Args:
        scene: its tissue, with those disturbances of the material that begin at 0.
        log: told what comes next.
    """
    found = []
    for times in MESHES:
        spacing = times * scene.tissue.spacing
        if times > 1 and spacing > min(scene.tissue.size) / 4:
            continue
        log(f"spacing {1e3 * spacing:.2f} mm")
        found.append(stiffness(replace(scene, tissue=replace(scene.tissue, spacing=spacing))))
    return tuple(found)


def stiffness(scene: Scene) -> Stiffness:
    """Stiffness of the scene's sheet on its own mesh."""
    membrane = np.column_stack([_membrane_forces(scene, strain) for strain in np.eye(3)])
    compliance = np.linalg.inv(membrane)
    return Stiffness(
        spacing=scene.tissue.spacing,
        stretch_x=1 / compliance[0, 0],
        stretch_y=1 / compliance[1, 1],
        poisson=-compliance[1, 0] / compliance[0, 0],
        shear=1 / compliance[2, 2],
        bending=_bending(scene),
    )


def floating(scene: Scene) -> Simulation:
    """The sheet alone, without weight."""
    material = tuple(one for one in scene.disturbances if isinstance(one, MATERIAL) and one.start == 0)
    alone = replace(
        scene, attachments=(), bed=BedConfig(present=False), disturbances=(*material, Gravity(magnitude=0.0))
    )
    return Simulation(alone, drawn=False)


def hold(simulation: Simulation, vertices: Bool[np.ndarray, " n"], at: Float[np.ndarray, "n 3"]) -> None:
    """Keep vertices, as if by a rigid clamp, away from their places at rest by so much [m]."""
    tissue, springs = simulation.scene.tissue, simulation.anchors.attachments
    springs.stiffness = np.where(vertices, RIGID * tissue.young * tissue.thickness, 0.0)
    springs.anchor = at
    simulation.anchors.write()


def _membrane_forces(scene: Scene, strain: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """Mean membrane forces xx, yy, xy [N/m] over a strain xx, yy, xy (engineering)."""
    simulation = floating(scene)
    sheet = simulation.tissue.sheet
    place = np.column_stack([sheet.vertices, np.zeros(len(sheet.vertices))])
    xx, yy, xy = strain
    gradient = np.array([[xx, xy / 2, 0], [xy / 2, yy, 0], [0, 0, 0]])
    outline, area = sheet.outline(), sheet.vertex_areas().sum()
    total = np.zeros((3, 3))
    for sign in (1, -1):
        hold(simulation, outline, sign * STRAIN * place @ gradient)
        simulation.settle(speed=STILL)
        springs = simulation.anchors.attachments
        pull = springs.stiffness[:, None] * (springs.anchor - simulation.anchors.moved)
        total += sign * place.T @ pull / (2 * STRAIN * area)
    return np.array([total[0, 0], total[1, 1], (total[0, 1] + total[1, 0]) / 2])


def _bending(scene: Scene) -> float:
    """D [N m], from the fourth derivatives of the deflection: where a mesh clamps its edge, it cannot spoil them."""
    simulation = floating(scene)
    sheet, radius = simulation.tissue.sheet, DISC * min(scene.tissue.size)
    x, y = sheet.vertices.T / radius
    free = np.flatnonzero(np.hypot(x, y) < 1)
    fitted = np.hypot(x, y)[free] < FITTED
    if fitted.sum() < ENOUGH:
        return math.nan
    deflection = np.linalg.solve(upward_stiffness(simulation, free), sheet.vertex_areas()[free])
    powers = [(i, j) for i in range(5) for j in range(5 - i)]
    quartic = np.column_stack([x[free][fitted] ** i * y[free][fitted] ** j for i, j in powers])
    found = dict(zip(powers, np.linalg.lstsq(quartic, deflection[fitted])[0], strict=True))
    biharmonic = (24 * found[4, 0] + 24 * found[0, 4] + 8 * found[2, 2]) / radius**4
    return float(1 / biharmonic)


def upward_stiffness(simulation: Simulation, vertices: Int[np.ndarray, " m"]) -> Float[np.ndarray, "m m"]:
    """Of the flat sheet: upward elastic forces on these vertices over their heights, the others held [N/m]."""
    model, data, tissue = simulation.model, simulation.data, simulation.tissue
    heights, forces = tissue.qpos_address[vertices, 2], model.jnt_dofadr[tissue.joints[vertices, 2]]
    columns = []
    for height in heights:
        data.qpos[tissue.qpos_address] = 0.0
        data.qpos[height] = NUDGE
        for stage in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_flex, mujoco.mj_passive):
            stage(model, data)
        columns.append(-data.qfrc_spring[forces] / NUDGE)
    return np.column_stack(columns)
