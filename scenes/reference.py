"""The reference tissue as an experiment: actions in, observations out, and the truth for whoever scores.

Each action ends when the tissue is at rest, then one observation is taken. Jaws hold every vertex within their radius
but welded ones, which slip out: two rigid constraints would share the gap between them. The observation
holds nothing of MuJoCo's state but the tool's pose and what the chosen sensing shows.
"""

import math
from pathlib import Path
from types import TracebackType
from typing import Literal, Self, get_args

import mujoco
import numpy as np
from jaxtyping import Bool, Float
from jiggle_mj.scenes import sensing as sense
from jiggle_mj.scenes.scene import Scene
from jiggle_mj.scenes.scene_file import scene_table
from jiggle_mj.scenes.simulation import AT_REST, SETTLED, check_state, settle
from jiggle_mj.scenes.stereo import StereoRenderer, stereo_camera
from jiggle_mj.scenes.tissue import TIMESTEP, build_tissue

from jiggle_mj.camera import StereoCamera
from jiggle_mj.errors import ActionError, SceneError
from jiggle_mj.observation import Action, Declaration, Grasp, Move, Observation, Release, ToolState, Wait
from jiggle_mj.truth import Truth, TruthFrame

Sensing = Literal["stereo", "points", "particles", "cloud"]
SENSING: tuple[Sensing, ...] = get_args(Sensing)
OPEN_ANGLE, CLOSED_ANGLE = 0.25, 0.0
"""Of each jaw [rad]."""
WAIT_STEPS = 5
"""Steps of a Wait before the tissue may be found at rest: still frames are a little more than 0.1 s apart."""


class Reference:
    """A tissue that can be grasped, lifted and watched.

    Raises:
        SceneError: the scene is impossible, or the seed below 0.
        RenderError: `sensing="stereo"` and no offscreen OpenGL.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        seed: int,
        sensing: Sensing,
        dump_dir: Path | None = None,
    ) -> None:
        if sensing not in SENSING:
            raise ValueError(f"sensing = {sensing!r}: must be one of {', '.join(map(repr, SENSING))}.")
        if seed < 0:
            raise SceneError(f"seed = {seed}: must be an integer of at least 0.")
        self.scene, self.sensing = scene, sensing
        self._dump_dir = dump_dir
        self._tissue = build_tissue(scene, drawn=sensing == "stereo")
        self._data = mujoco.MjData(self._tissue.model)
        mujoco.mj_forward(self._tissue.model, self._data)
        self._rng = np.random.default_rng([scene.seed, seed])
        self._tracks = {
            "particles": lambda: sense.vertex_tracks(self._tissue.sheet, rng=self._rng),
            "points": lambda: sense.material_tracks(self._tissue.sheet, n_points=scene.sensing.n_points, rng=self._rng),
            "stereo": lambda: None,
            "cloud": lambda: None,
        }[sensing]()
        self._index, self._grasp, self._radius, self._closed = -1, 0, scene.tweezer.radius, False
        self.capped: list[int] = []
        """Indices of observations taken before the tissue was at rest."""
        self._renderer = StereoRenderer(self._tissue.model, scene.camera) if sensing == "stereo" else None
        self._set_jaws(OPEN_ANGLE)
        self._anchors = self._data.flexvert_xpos.copy()
        self._settle(speed=AT_REST)
        self._data.time = 0.0
        self._rest = self._surface()
        self._frames: list[TruthFrame] = []

    @property
    def camera(self) -> StereoCamera | None:
        """Calibration of the stereo pair; None where nothing is imaged."""
        return stereo_camera(self.scene.camera) if self.sensing == "stereo" else None

    @property
    def declaration(self) -> Declaration:
        """What the scene's author tells the estimator."""
        return self.scene.declared.declaration()

    def step(self, action: Action) -> Observation:
        """Carry out an action, let the tissue settle, and observe.

        Raises:
            ActionError: a grasp off the tissue or while grasping, a release of nothing, numbers that are not finite.
            SimulationError: the tissue became unstable.
        """
        match action:
            case Grasp():
                self._close(action)
            case Release():
                self._open()
            case Move():
                self._move(_finite(action.to, name="Move.to"))
            case Wait():
                pass
        self._index += 1
        settled = self._wait() if isinstance(action, Wait) else self._settle()
        if not settled:
            self.capped.append(self._index)
        self._frames.append(self._truth_frame())
        return self._observe()

    def truth_frame(self) -> TruthFrame:
        """The truth at the last observation."""
        if not self._frames:
            raise ValueError("no observation yet: call step first.")
        return self._frames[-1]

    def truth(self) -> Truth:
        """Mesh, attachments and every frame so far."""
        return Truth(
            rest=self._rest,
            faces=self._tissue.sheet.faces,
            attached=self._tissue.stiffness > 0,
            frames=tuple(self._frames),
            scene=self.scene.name,
            details={"scene": scene_table(self.scene), "capped": list(self.capped)},
        )

    def close(self) -> None:
        """Free the renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # The tool

    @property
    def _tip(self) -> Float[np.ndarray, " 3"]:
        return self._data.mocap_pos[0].copy()

    @property
    def held(self) -> Bool[np.ndarray, " n"]:
        """Truth: which vertices the jaws hold."""
        return self._data.eq_active[self._tissue.grips].astype(bool)

    def _set_jaws(self, angle: float) -> None:
        model = self._tissue.model
        for joint in self._tissue.jaws:
            model.qpos_spring[model.jnt_qposadr[joint]] = angle
            self._data.qpos[model.jnt_qposadr[joint]] = angle

    def _close(self, action: Grasp) -> None:
        if self._closed:
            raise ActionError(f"grasp at {_text(action.point)} while grasp {self._grasp} holds: release it first.")
        point = _finite(action.point, name="Grasp.point")
        if not (math.isfinite(action.radius) and action.radius > 0):
            raise ActionError(f"Grasp.radius must be above 0 m; got {action.radius}.")
        vertices = self._surface()
        distance = np.linalg.norm(vertices - point, axis=1)
        inside = np.flatnonzero(distance <= action.radius)
        if not inside.size:
            raise ActionError(
                f"grasp at {_text(point)} m holds nothing: the nearest tissue is {1e3 * distance.min():.1f} mm away, "
                f"the radius is {1e3 * action.radius:.1f} mm. Grasp closer or widen the radius."
            )
        inside = inside[np.isfinite(self._tissue.stiffness[inside])]
        if not inside.size:
            raise ActionError(
                f"grasp at {_text(point)} m meets welded vertices only, and a weld does not yield to the jaws. "
                "Grasp elsewhere or widen the radius."
            )
        model, data = self._tissue.model, self._data
        data.mocap_pos[0] = point
        equalities = self._tissue.grips[inside]
        model.eq_data[equalities, :3] = 0.0
        model.eq_data[equalities, 3:6] = data.flexvert_xpos[inside] - point
        data.eq_active[equalities] = 1
        self._grasp, self._radius, self._closed = self._grasp + 1, float(action.radius), True
        self._set_jaws(CLOSED_ANGLE)

    def _open(self) -> None:
        if not self._closed:
            raise ActionError("release while nothing is held: grasp first.")
        self._data.eq_active[self._tissue.grips] = 0
        self._closed = False
        self._set_jaws(OPEN_ANGLE)

    def _move(self, to: Float[np.ndarray, " 3"]) -> None:
        start = self._tip
        n_steps = max(math.ceil(np.linalg.norm(to - start) / (self.scene.tweezer.speed * TIMESTEP)), 1)
        if not self._closed:
            n_steps = 1
        for k in range(1, n_steps + 1):
            self._data.mocap_pos[0] = start + (to - start) * k / n_steps
            mujoco.mj_step(self._tissue.model, self._data)
            check_state(self._tissue.model, self._data, dump_dir=self._dump_dir)

    # Time

    def _settle(self, *, speed: float = SETTLED) -> bool:
        settled = settle(self._tissue.model, self._data, speed=speed, dump_dir=self._dump_dir)
        mujoco.mj_forward(self._tissue.model, self._data)
        return settled

    def _wait(self) -> bool:
        for _ in range(WAIT_STEPS):
            mujoco.mj_step(self._tissue.model, self._data)
        return self._settle()

    # What is seen

    @property
    def _time(self) -> int:
        return round(self._data.time * 1e9)

    def _surface(self) -> Float[np.ndarray, "n 3"]:
        """The vertices on the drawn surface: moved by the flex radius along their normals [m]."""
        vertices, faces = self._data.flexvert_xpos.copy(), self._tissue.sheet.faces
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        normal = np.zeros_like(vertices)
        for k in range(3):
            np.add.at(normal, faces[:, k], np.cross(b - a, c - a))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return vertices + self.scene.tissue.radius * normal

    def _truth_frame(self) -> TruthFrame:
        return TruthFrame(
            index=self._index,
            time=self._time,
            positions=self._surface(),
            stiffness=self._tissue.stiffness.copy(),
            tip=self._tip,
            load=self._load(),
        )

    def _load(self) -> Float[np.ndarray, " n"]:
        """What each spring pulls with, and the constraint force of each weld [N]."""
        data, stiffness = self._data, self._tissue.stiffness
        stretched = np.linalg.norm(data.flexvert_xpos - self._anchors, axis=1)
        load = np.where(np.isfinite(stiffness), stiffness, 0.0) * stretched
        equality = np.where(data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY, data.efc_id, -1)
        for vertex, weld in self._tissue.welds.items():
            load[vertex] = np.linalg.norm(data.efc_force[equality == weld])
        return load

    def _observe(self) -> Observation:
        settings = self.scene.sensing
        images = points = None
        if self._renderer is not None:
            images = sense.add_image_noise(self._renderer.render(self._data), sd=settings.image_sd, rng=self._rng)
        tracks, cloud = self._tracks, self.sensing == "cloud"
        if cloud:
            tracks = sense.surface_points(self._tissue.sheet, n_points=settings.cloud_points, rng=self._rng)
        if tracks is not None:
            positions = tracks.positions(self._surface())
            points = sense.measure(positions, sd=settings.point_sd, rng=self._rng, tracked=not cloud)
        return Observation(index=self._index, time=self._time, tool=self._tool(), images=images, points=points)

    def _tool(self) -> ToolState:
        return ToolState(
            position=self._tip,
            quat_wxyz=self._data.mocap_quat[0].copy(),
            closed=self._closed,
            grasp=self._grasp,
            radius=self._radius,
        )


def _finite(point: Float[np.ndarray, " 3"], *, name: str) -> Float[np.ndarray, " 3"]:
    values = np.array(point, dtype=float)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise ActionError(f"{name} must be three finite numbers in m; got {point}.")
    return values


def _text(point: Float[np.ndarray, " 3"]) -> str:
    return "(" + ", ".join(f"{value:.4f}" for value in point) + ")"
