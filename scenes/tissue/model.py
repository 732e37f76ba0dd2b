"""The compiled MuJoCo model of a scene: sheet, bed, attachments, tweezer, cameras and lights, through MjSpec.

This is where a scene's keys become MuJoCo's fields:

    [tissue]         `_add_sheet`
    [[attachments]]  `_add_sheet` (springs), `_add_equalities` (welds); then `anchors.py`, which owns the springs
    [bed]            `_add_bed`, and the friction in `_add_sheet`
    [camera]         `cameras.add_cameras`, and the image size in `_set_options`
    [lights]         `_set_options` (ambient), `_add_appearance` (lamp)
    [texture]        `_add_appearance`
    [[disturbances]] their `prepare` before compiling, their `begin` on the running `Simulation`

Sections that MuJoCo never sees: [tweezer], [programme], [procedure] (`reference.py`, `procedure.py`), [sensing]
(`sensing/observer.py`), [limits] and [declared] (what policies and the estimator are given).

Every vertex is a body with three slide joints, so an attachment is the joints' own spring: zero rest length, exactly
the N/m of the scene, and editable while the simulation runs. A weld is a `connect` equality with the world. Each vertex
also has a `connect` with the tweezer, inactive until it is grasped. The discrete integrator needs MuJoCo 4 (see the
`Computation` chapter of its manual); Euler is unstable with stiff grasps and `implicit` refuses shells.
"""

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float, Int

from ..scene.attachments import attach
from ..scene.disturbance import TissueDisturbance
from ..scene.scene import Scene, TextureConfig
from .cameras import add_cameras
from .mesh import Triangulation, build_sheet
from .texture import bed_texture, tissue_texture

TIMESTEP = 0.02
"""Timestep [s]. Above the contact's time constant of 20 ms contact softens; below it equilibria change by 0.01 mm."""
SOLVER_ITERATIONS, SOLVER_TOLERANCE = 200, 1e-7
"""Limits of the conjugate gradient solver."""
GRASP_SOLREF = (-2e4, -400.0)
"""Stiffness [1/s^2] and damping [1/s] of grip and welds in MuJoCo's direct form, which no timestep clamps."""
GRASP_SOLIMP = (0.99, 0.999, 1e-4, 0.5, 2.0)
"""Impedance of grip and welds."""
CONTACT_SOLREF, CONTACT_SOLIMP = (-2e3, -100.0), (0.99, 0.999, 1e-4, 0.5, 2.0)
"""Contact with the bed, in the same form. A vertex weighs 16 mg, so with MuJoCo's default a force of 1 mN sinks it by
millimetres."""
TORSIONAL_FRICTION, ROLLING_FRICTION = 0.005, 1e-4
"""MuJoCo's defaults [m]; contacts of three dimensions do not use them."""
STRETCH_AND_BEND = 3
"""MuJoCo's `elastic2d="both"`."""
SPECIFIC_INERTIA = 1e-6
"""Rotational inertia of a vertex over its mass [m^2]. MuJoCo asks for one; slide joints never use it."""
BED_HALF_SIZE, BED_GRID = 1.5, 0.01
"""Half the drawn side of the bed over the longer side of the sheet, and the spacing of its grid [m]."""
PLAIN_TEXTURE = TextureConfig(resolution=64, contrast=0.0)
"""Texture where nothing is rendered."""
TEXTURE_REPEATS = {"tissue": 1, "bed": 2}
"""Number of times that each texture is laid along each side."""
LAMP_POSITION, LAMP_DIRECTION = (0.03, -0.05, 0.25), (-0.1, 0.2, -1)
"""Position [m] and direction of the lamp beside the camera."""
EXTENT = 0.2
"""Size of the scene, in which MuJoCo measures the clipping planes [m]."""
NEAR_PLANE = 0.05
"""Distance of the near clipping plane, in extents: 1 cm."""
FAR_PLANE = 10
"""Distance of the far clipping plane over that of the camera's target, or over the extent if that is farther."""
TWEEZER = Path(__file__).parent.parent / "tweezer.xml"
"""Model of the tool."""
PARKED_POSITION = (0.0, 0.0, 0.5)
"""Position of the tweezer before its first grasp, outside the images [m]."""


@dataclass(frozen=True, kw_only=True)
class TissueModel:
    """The compiled model and the addresses in it; arrays are over the sheet's n vertices."""

    model: mujoco.MjModel
    """The compiled model."""
    sheet: Triangulation
    """The mesh at rest."""
    owner: Int[np.ndarray, " n"]
    """Index of the scene's attachment that holds each vertex; -1 where it is free."""
    stiffness: Float[np.ndarray, " n"]
    """Stiffness of the scene's attachment at each vertex [N/m]: 0 where free, infinity where welded."""
    joints: Int[np.ndarray, "n 3"]
    """Joint ids of each vertex's x, y and z; MuJoCo's qpos and dof addresses follow from them."""
    grips: Int[np.ndarray, " n"]
    """Equality id of each vertex's grip."""
    welds: dict[int, int]
    """Equality id of each welded vertex's weld."""
    jaws: tuple[int, int]
    """Joint ids of the tweezer's jaws."""

    @property
    def qpos_address(self) -> Int[np.ndarray, "n 3"]:
        """Return the indices of each vertex's coordinates in qpos."""
        return self.model.jnt_qposadr[self.joints]


def build_tissue(scene: Scene, *, drawn: bool = True) -> TissueModel:
    """Compile a scene; without `drawn` the textures stay plain, which saves a second.

    Raises:
        SceneError: an attachment holds no vertex, or two contradict each other.
        MeshError: the sheet cannot be triangulated.
    """
    tissue = scene.tissue
    sheet = build_sheet(size=tissue.size, spacing=tissue.spacing, kind=tissue.mesh, seed=tissue.seed)
    owner, stiffness = attach(scene.attachments, sheet.vertices)
    spec = mujoco.MjSpec()
    spec.modelname = scene.name
    _set_options(spec, scene)
    _add_appearance(spec, scene, drawn=drawn)
    if scene.bed.present:
        _add_bed(spec, scene)
    _add_sheet(spec, scene, sheet, stiffness)
    tool = mujoco.MjSpec.from_file(str(TWEEZER))
    spec.attach(tool, prefix="tweezer/", frame=spec.worldbody.add_frame(pos=PARKED_POSITION))
    _add_equalities(spec, stiffness)
    add_cameras(spec, scene.camera)
    for disturbance in scene.disturbances:
        if isinstance(disturbance, TissueDisturbance):
            disturbance.prepare(spec)
    model = spec.compile()
    names = [f"v{i}" for i in range(len(stiffness))]
    bodies = np.array([model.body(name).id for name in names])
    return TissueModel(
        model=model,
        sheet=sheet,
        owner=owner,
        stiffness=stiffness,
        joints=model.body_jntadr[bodies][:, None] + np.arange(3),
        grips=np.array([model.equality(f"grip{i}").id for i in range(len(stiffness))]),
        welds={int(i): model.equality(f"weld{i}").id for i in np.flatnonzero(np.isinf(stiffness))},
        jaws=(model.joint("tweezer/left_jaw").id, model.joint("tweezer/right_jaw").id),
    )


def _set_options(spec: mujoco.MjSpec, scene: Scene) -> None:
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    spec.option.solver = mujoco.mjtSolver.mjSOL_CG
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.timestep = TIMESTEP
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    spec.option.iterations = SOLVER_ITERATIONS
    spec.option.tolerance = SOLVER_TOLERANCE
    spec.visual.quality.shadowsize = 0
    spec.visual.quality.offsamples = 0
    spec.visual.global_.offwidth = scene.camera.width
    spec.visual.global_.offheight = scene.camera.height
    spec.stat.extent = EXTENT
    spec.visual.map.znear = NEAR_PLANE
    spec.visual.map.zfar = FAR_PLANE * max(scene.camera.distance, EXTENT) / EXTENT
    for colour in ("ambient", "diffuse", "specular"):
        setattr(spec.visual.headlight, colour, [scene.lights.ambient if colour == "ambient" else 0.0] * 3)


def _add_appearance(spec: mujoco.MjSpec, scene: Scene, *, drawn: bool) -> None:
    texture = scene.texture if drawn else PLAIN_TEXTURE
    for name, draw in (("tissue", tissue_texture), ("bed", bed_texture)):
        image = draw(seed=texture.seed, resolution=texture.resolution, contrast=texture.contrast)
        picture = spec.add_texture(
            name=name,
            type=mujoco.mjtTexture.mjTEXTURE_2D,
            width=texture.resolution,
            height=texture.resolution,
            nchannel=3,
        )
        picture.data = image.tobytes()
        material = spec.add_material(name=name, specular=0.0)
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
        material.texrepeat = [TEXTURE_REPEATS[name]] * 2
    spec.worldbody.add_light(
        pos=LAMP_POSITION, dir=LAMP_DIRECTION, type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        diffuse=[scene.lights.lamp] * 3, ambient=[0, 0, 0], specular=[0, 0, 0], castshadow=False,
    )  # fmt: skip


def _add_bed(spec: mujoco.MjSpec, scene: Scene) -> None:
    half = BED_HALF_SIZE * max(scene.tissue.size)
    spec.worldbody.add_geom(
        name="bed", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[half, half, BED_GRID], material="bed",
        friction=_friction(scene), solref=CONTACT_SOLREF, solimp=CONTACT_SOLIMP,
    )  # fmt: skip


def _friction(scene: Scene) -> list[float]:
    return [scene.bed.friction, TORSIONAL_FRICTION, ROLLING_FRICTION]


def _add_sheet(spec: mujoco.MjSpec, scene: Scene, sheet: Triangulation, stiffness: Float[np.ndarray, " n"]) -> None:
    tissue = scene.tissue
    masses = tissue.density * tissue.thickness * sheet.vertex_areas()
    for i, ((x, y), mass, k) in enumerate(zip(sheet.vertices, masses, stiffness, strict=True)):
        body = spec.worldbody.add_body(
            name=f"v{i}",
            pos=[x, y, tissue.radius],
            mass=mass,
            inertia=[mass * SPECIFIC_INERTIA] * 3,
            explicitinertial=True,
        )
        for axis in np.eye(3):
            body.add_joint(
                type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis, stiffness=[k if np.isfinite(k) else 0.0, 0.0, 0.0]
            )
    n = len(stiffness)
    flex = spec.add_flex(name="tissue", dim=2, radius=tissue.radius)
    flex.vertbody = [f"v{i}" for i in range(n)]
    flex.elem = sheet.faces.ravel().tolist()
    flex.texcoord = (sheet.vertices / np.array(tissue.size) + 0.5).ravel().tolist()
    flex.elemtexcoord = sheet.faces.ravel().tolist()
    flex.material = "tissue"
    flex.young, flex.poisson, flex.thickness = tissue.young, tissue.poisson, tissue.thickness
    flex.damping, flex.elastic2d = tissue.damping, STRETCH_AND_BEND
    flex.selfcollide = mujoco.mjtFlexSelf.mjFLEXSELF_NONE
    flex.friction, flex.condim = _friction(scene), 3
    flex.solref, flex.solimp = CONTACT_SOLREF, CONTACT_SOLIMP


def _add_equalities(spec: mujoco.MjSpec, stiffness: Float[np.ndarray, " n"]) -> None:
    connect = {"type": mujoco.mjtEq.mjEQ_CONNECT, "objtype": mujoco.mjtObj.mjOBJ_BODY}
    solver = {"solimp": GRASP_SOLIMP, "solref": GRASP_SOLREF}
    for i, k in enumerate(stiffness):
        spec.add_equality(name=f"grip{i}", name1=f"v{i}", name2="tweezer/base", active=False, **connect, **solver)
        if np.isinf(k):
            spec.add_equality(name=f"weld{i}", name1=f"v{i}", active=True, **connect, **solver)
