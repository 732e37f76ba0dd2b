"""The compiled MuJoCo model of a scene: sheet, bed, attachments, tweezer, cameras and lights, through MjSpec.

Every vertex is a body with three slide joints, so an attachment is the joints' own spring: zero rest length, exactly
the typed N/m, and editable while running. A weld is a `connect` equality with the world. Each vertex also has a
`connect` with the tweezer, inactive until it is grasped. The discrete integrator needs MuJoCo 4 (see the `Computation`
chapter of its manual); Euler is unstable with stiff grasps and `implicit` refuses shells.
"""

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float, Int

from ..scene.attachments import owners, vertex_stiffness
from ..scene.disturbance import TissueDisturbance
from ..scene.scene import Scene, TextureConfig
from .cameras import add_cameras
from .mesh import Triangulation, build_sheet
from .texture import bed_texture, tissue_texture

TIMESTEP = 0.02
"""[s]. Above the contact's time constant of 20 ms contact softens; below it equilibria change by 0.01 mm."""
GRASP_SOLREF = (-2e4, -400.0)
"""Stiffness [1/s^2] and damping [1/s] of the grip's constraint in MuJoCo's direct form, which no timestep clamps."""
CONTACT_SOLREF, CONTACT_SOLIMP = (-2e3, -100.0), (0.99, 0.999, 1e-4, 0.5, 2.0)
"""Of the bed: a vertex weighs 16 mg, so MuJoCo's default lets a pull of 1 mN sink it by millimetres."""
STRETCH_AND_BEND = 3
"""MuJoCo's `elastic2d="both"`."""
PLAIN = TextureConfig(resolution=64, contrast=0.0)
"""Stands in where nothing is drawn."""
TWEEZER = Path(__file__).parent.parent / "tweezer.xml"
PARKED = (0.0, 0.0, 0.5)
"""Where the tweezer waits, out of sight [m]."""


@dataclass(frozen=True, kw_only=True)
class TissueModel:
    """The compiled model and the addresses in it; arrays are over the sheet's n vertices."""

    model: mujoco.MjModel
    sheet: Triangulation
    owner: Int[np.ndarray, " n"]
    """Which of the scene's attachments holds each vertex; -1 where it is free."""
    stiffness: Float[np.ndarray, " n"]
    """Of the attachments [N/m]; infinity is a weld."""
    joints: Int[np.ndarray, "n 3"]
    """Joint ids; MuJoCo's qpos and dof addresses follow from them."""
    grips: Int[np.ndarray, " n"]
    """Equality ids of the grasp."""
    welds: dict[int, int]
    """Equality id of each welded vertex."""
    jaws: tuple[int, int]
    """Joint ids of the tweezer."""

    @property
    def qpos_address(self) -> Int[np.ndarray, "n 3"]:
        """Where each vertex's coordinates lie in qpos."""
        return self.model.jnt_qposadr[self.joints]


def build_tissue(scene: Scene, *, drawn: bool = True) -> TissueModel:
    """Compile a scene; without `drawn` the textures, which cost a second, are left plain.

    Raises:
        SceneError: attachments that hold no vertex or contradict each other.
        MeshError: the sheet cannot be triangulated.
    """
    tissue = scene.tissue
    sheet = build_sheet(size=tissue.size, spacing=tissue.spacing, kind=tissue.mesh, seed=tissue.seed)
    owner = owners(scene.attachments, sheet.vertices)
    stiffness = vertex_stiffness(scene.attachments, owner)
    spec = mujoco.MjSpec()
    spec.modelname = scene.name
    _set_options(spec, scene)
    _add_looks(spec, scene, drawn=drawn)
    if scene.bed.present:
        _add_bed(spec, scene)
    _add_sheet(spec, scene, sheet, stiffness)
    tool = mujoco.MjSpec.from_file(str(TWEEZER))
    spec.attach(tool, prefix="tweezer/", frame=spec.worldbody.add_frame(pos=PARKED))
    _add_equalities(spec, stiffness)
    add_cameras(spec, scene.camera)
    for disturbance in scene.disturbances:
        if isinstance(disturbance, TissueDisturbance):
            disturbance.prepare(spec)
    model = spec.compile()
    names = [f"v{i}" for i in range(len(stiffness))]
    bodies = np.array([model.body(name).id for name in names])
    compiled = TissueModel(
        model=model,
        sheet=sheet,
        owner=owner,
        stiffness=stiffness,
        joints=model.body_jntadr[bodies][:, None] + np.arange(3),
        grips=np.array([model.equality(f"grip{i}").id for i in range(len(stiffness))]),
        welds={int(i): model.equality(f"weld{i}").id for i in np.flatnonzero(np.isinf(stiffness))},
        jaws=(model.joint("tweezer/left_jaw").id, model.joint("tweezer/right_jaw").id),
    )
    return compiled


def _set_options(spec: mujoco.MjSpec, scene: Scene) -> None:
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    spec.option.solver = mujoco.mjtSolver.mjSOL_CG
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.timestep = TIMESTEP
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    spec.option.iterations = 200
    spec.option.tolerance = 1e-7
    spec.visual.quality.shadowsize = 0
    spec.visual.quality.offsamples = 0
    spec.visual.global_.offwidth = scene.camera.width
    spec.visual.global_.offheight = scene.camera.height
    spec.stat.extent = 0.2
    spec.visual.map.znear = 0.05
    spec.visual.map.zfar = 10 * max(scene.camera.distance, 0.2) / 0.2
    for colour in ("ambient", "diffuse", "specular"):
        setattr(spec.visual.headlight, colour, [scene.lights.ambient if colour == "ambient" else 0.0] * 3)


def _add_looks(spec: mujoco.MjSpec, scene: Scene, *, drawn: bool) -> None:
    texture = scene.texture if drawn else PLAIN
    looks = {"tissue": tissue_texture, "bed": bed_texture}
    for name, draw in looks.items():
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
        material.texrepeat = [1, 1] if name == "tissue" else [2, 2]
    spec.worldbody.add_light(
        pos=[0.03, -0.05, 0.25], dir=[-0.1, 0.2, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        diffuse=[scene.lights.lamp] * 3, ambient=[0, 0, 0], specular=[0, 0, 0], castshadow=False,
    )  # fmt: skip


def _add_bed(spec: mujoco.MjSpec, scene: Scene) -> None:
    half = 1.5 * max(scene.tissue.size)
    spec.worldbody.add_geom(
        name="bed", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[half, half, 0.01], material="bed",
        friction=[scene.bed.friction, 0.005, 1e-4], solref=CONTACT_SOLREF, solimp=CONTACT_SOLIMP,
    )  # fmt: skip


def _add_sheet(spec: mujoco.MjSpec, scene: Scene, sheet: Triangulation, stiffness: Float[np.ndarray, " n"]) -> None:
    tissue = scene.tissue
    masses = tissue.density * tissue.thickness * sheet.vertex_areas()
    for i, ((x, y), mass, k) in enumerate(zip(sheet.vertices, masses, stiffness, strict=True)):
        body = spec.worldbody.add_body(
            name=f"v{i}", pos=[x, y, tissue.radius], mass=mass, inertia=[mass * 1e-6] * 3, explicitinertial=True
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
    flex.friction, flex.condim = [scene.bed.friction, 0.005, 1e-4], 3
    flex.solref, flex.solimp = CONTACT_SOLREF, CONTACT_SOLIMP


def _add_equalities(spec: mujoco.MjSpec, stiffness: Float[np.ndarray, " n"]) -> None:
    connect = {"type": mujoco.mjtEq.mjEQ_CONNECT, "objtype": mujoco.mjtObj.mjOBJ_BODY}
    solver = {"solimp": [0.99, 0.999, 1e-4, 0.5, 2], "solref": GRASP_SOLREF}
    for i, k in enumerate(stiffness):
        spec.add_equality(name=f"grip{i}", name1=f"v{i}", name2="tweezer/base", active=False, **connect, **solver)
        if np.isinf(k):
            spec.add_equality(name=f"weld{i}", name1=f"v{i}", active=True, **connect, **solver)
