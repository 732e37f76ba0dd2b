"""Static load tests that measure the stiffness of the compiled tissue, without bed, attachments and weight.

Membrane: the vertices of the outline are clamped at homogeneously strained positions, the others come to rest, and the
mean membrane force follows from the forces on the outline.

Bending: the vertices outside a disc are clamped, a unit pressure acts on the disc, and D times the biharmonic of the
deflection is 1 (Timoshenko and Woinowsky-Krieger, Theory of Plates and Shells, 1959, chapter 4). The deflection is
solved for with the model's stiffness matrix, because stepping converges too slowly at such small forces.
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

TEST_STRAIN = 2e-3
"""Strain of the membrane tests, applied with both signs."""
PROBE_HEIGHT = 1e-8
"""Displacement for the finite difference of bending forces [m]."""
DISC_RADIUS = 0.42
"""Radius of the bending test's disc over the shorter side of the sheet."""
FIT_RADIUS = 0.8
"""Share of the disc's radius within which a quartic is fitted to the deflection, away from the clamped edge."""
MIN_FIT_VERTICES = 40
"""Smallest number of vertices for that fit; a quartic has 15 coefficients."""
CLAMP_STIFFNESS = 1e4
"""Stiffness of the spring that clamps a vertex, over the membrane stiffness."""
REST_SPEED = 1e-7
"""Largest speed of any coordinate at rest in these tests [m/s]."""
SPACING_FACTORS = (1.5, 1.0, 0.75)
"""Spacings of the tested meshes over the scene's spacing."""
MAX_DEVIATION = 0.1
"""Share by which a stiffness may differ from the declared one without a message."""


@dataclass(frozen=True, kw_only=True)
class Stiffness:
    """The stiffness of a sheet at small strains."""

    spacing: float
    """Intended edge length of the mesh [m]."""
    stretch_x: float
    """Force over width and strain of a strip along x that may narrow: Young's modulus times thickness [N/m]."""
    stretch_y: float
    """The same along y [N/m]."""
    poisson: float
    """Poisson's ratio of a strip along x."""
    shear: float
    """Shear modulus times thickness [N/m]."""
    bending: float
    """Bending stiffness D [N m]; NaN on a mesh too coarse to measure it."""


QUANTITIES = {"stretch_x": "N/m", "stretch_y": "N/m", "poisson": "1", "shear": "N/m", "bending": "N m"}
"""Measured fields of `Stiffness`, and their units."""


def typed(tissue: TissueConfig) -> Stiffness:
    """Return the stiffness of an isotropic plate of the scene's material."""
    stretch, nu = tissue.young * tissue.thickness, tissue.poisson
    return Stiffness(
        spacing=tissue.spacing,
        stretch_x=stretch,
        stretch_y=stretch,
        poisson=nu,
        shear=stretch / (2 * (1 + nu)),
        bending=stretch * tissue.thickness**2 / (12 * (1 - nu**2)),
    )


def far_from_declared(scene: Scene, found: tuple[Stiffness, ...]) -> list[str]:
    """Return a sentence for each quantity, on the scene's own mesh, that is farther than 10 % from the declared one."""
    own = next(item for item in found if item.spacing == scene.tissue.spacing)
    declared = scene.declared
    expected = typed(
        replace(
            scene.tissue,
            young=declared.membrane_stiffness / declared.thickness,
            thickness=declared.thickness,
            poisson=declared.poisson,
        )
    )
    ratios = {name: getattr(own, name) / getattr(expected, name) for name in QUANTITIES if getattr(expected, name) > 0}
    return [
        f"{name.replace('_', ' ')} is {ratio:.3g} times what [declared] says."
        for name, ratio in ratios.items()
        if abs(ratio - 1) > MAX_DEVIATION  # false where the ratio is NaN
    ]


def load_tests(scene: Scene, *, log: Callable[[str], None] = lambda _: None) -> tuple[Stiffness, ...]:
    """Return the stiffness of the scene's sheet on a coarser mesh, its own and a finer one; one too coarse is left out.

    Args:
        scene: its tissue counts, and those disturbances of the material that begin at 0.
        log: called with a message before each mesh.
    """
    results = []
    for factor in SPACING_FACTORS:
        spacing = factor * scene.tissue.spacing
        if factor > 1 and spacing > min(scene.tissue.size) / 4:
            continue
        log(f"spacing {1e3 * spacing:.2f} mm")
        results.append(measured_stiffness(replace(scene, tissue=replace(scene.tissue, spacing=spacing))))
    return tuple(results)


def measured_stiffness(scene: Scene) -> Stiffness:
    """Return the stiffness of the scene's sheet on its own mesh."""
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
    """Return a simulation of the sheet alone, without weight, at rest."""
    material = tuple(item for item in scene.disturbances if isinstance(item, MATERIAL) and item.start == 0)
    alone = replace(
        scene, attachments=(), bed=BedConfig(present=False), disturbances=(*material, Gravity(magnitude=0.0))
    )
    return Simulation(alone, drawn=False)


def hold(simulation: Simulation, vertices: Bool[np.ndarray, " n"], displacement: Float[np.ndarray, "n 3"]) -> None:
    """Clamp vertices with stiff springs at a displacement from their rest positions [m]."""
    tissue, springs = simulation.scene.tissue, simulation.anchors.attachments
    springs.stiffness = np.where(vertices, CLAMP_STIFFNESS * tissue.young * tissue.thickness, 0.0)
    springs.anchor = displacement
    simulation.anchors.write()


def _membrane_forces(scene: Scene, strain: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """Return the mean membrane forces xx, yy, xy [N/m] per engineering strain xx, yy, xy."""
    simulation = floating(scene)
    sheet = simulation.tissue.sheet
    place = np.column_stack([sheet.vertices, np.zeros(len(sheet.vertices))])
    xx, yy, xy = strain
    gradient = np.array([[xx, xy / 2, 0], [xy / 2, yy, 0], [0, 0, 0]])
    outline, area = sheet.outline(), sheet.vertex_areas().sum()
    total = np.zeros((3, 3))
    for sign in (1, -1):
        hold(simulation, outline, sign * TEST_STRAIN * place @ gradient)
        simulation.settle(speed=REST_SPEED)
        springs = simulation.anchors.attachments
        pull = springs.stiffness[:, None] * (springs.anchor - simulation.anchors.displacement)
        total += sign * place.T @ pull / (2 * TEST_STRAIN * area)
    return np.array([total[0, 0], total[1, 1], (total[0, 1] + total[1, 0]) / 2])


def _bending(scene: Scene) -> float:
    """Return D [N m], from the fourth derivatives of the deflection: the clamped edge does not affect them."""
    simulation = floating(scene)
    sheet, radius = simulation.tissue.sheet, DISC_RADIUS * min(scene.tissue.size)
    x, y = sheet.vertices.T / radius
    free = np.flatnonzero(np.hypot(x, y) < 1)
    fitted = np.hypot(x, y)[free] < FIT_RADIUS
    if fitted.sum() < MIN_FIT_VERTICES:
        return math.nan
    deflection = np.linalg.solve(upward_stiffness(simulation, free), sheet.vertex_areas()[free])
    powers = [(i, j) for i in range(5) for j in range(5 - i)]
    quartic = np.column_stack([x[free][fitted] ** i * y[free][fitted] ** j for i, j in powers])
    coefficient = dict(zip(powers, np.linalg.lstsq(quartic, deflection[fitted])[0], strict=True))
    biharmonic = (24 * coefficient[4, 0] + 24 * coefficient[0, 4] + 8 * coefficient[2, 2]) / radius**4
    return float(1 / biharmonic)


def upward_stiffness(simulation: Simulation, vertices: Int[np.ndarray, " m"]) -> Float[np.ndarray, "m m"]:
    """Return the stiffness matrix of the flat sheet for the heights of these vertices, the others clamped [N/m]."""
    model, data, tissue = simulation.model, simulation.data, simulation.tissue
    heights, forces = tissue.qpos_address[vertices, 2], model.jnt_dofadr[tissue.joints[vertices, 2]]
    columns = []
    for height in heights:
        data.qpos[tissue.qpos_address] = 0.0
        data.qpos[height] = PROBE_HEIGHT
        for compute in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_flex, mujoco.mj_passive):
            compute(model, data)
        columns.append(-data.qfrc_spring[forces] / PROBE_HEIGHT)
    return np.column_stack(columns)
