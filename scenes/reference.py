"""The reference tissue as an experiment: actions in, observations out, and the truth for whoever scores.

Each action ends when the tissue is at rest, then one observation is taken. It holds nothing of MuJoCo's state but the
tool's pose and what the chosen sensing shows.
"""

import math
from pathlib import Path
from types import TracebackType
from typing import Self

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from jiggle_mj.actions import Action, Cut, Grasp, Move, Release, Suture, Wait
from jiggle_mj.camera import StereoCamera
from jiggle_mj.errors import ActionError, SceneError
from jiggle_mj.observation import Declaration, Observation, ToolState
from jiggle_mj.options import SENSING, Sensing
from jiggle_mj.truth import Truth, TruthFrame

from .disturbances.registry import described
from .scene.scene import Scene
from .scene_file import scene_table
from .sensing.observer import Observer
from .tissue.model import TIMESTEP
from .tissue.procedure import carry_out
from .tissue.simulation import MAX_STEPS, Simulation

CHANCE = (1,)
"""Sets the failures of cuts and sutures apart from the noise of sensing."""
WIDEST, REACH = 0.05, 1.0
"""Largest radius of the jaws, and how far from the middle of the sheet the tip may go along each axis [m]."""
SUNK = 5e-3
"""How far below the bed the tip may be sent, as what is seen may seem to lie too low; it stops on the bed [m]."""
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
        self._simulation = Simulation(scene, drawn=sensing == "stereo", dump_dir=dump_dir)
        noise, self._chance = (np.random.default_rng([scene.seed, seed, *more]) for more in ((), CHANCE))
        self._observer = Observer(self._simulation, sensing=sensing, rng=noise)
        self._events: tuple[Cut | Suture, ...] = ()
        self._done: list[dict[str, object]] = []
        self._index, self._grasp, self._radius, self._closed = -1, 0, scene.tweezer.radius, False
        self.capped: list[int] = []
        """Indices of observations taken before the tissue was at rest."""
        self._rest = self._simulation.surface()
        self._frames: list[TruthFrame] = []

    @property
    def camera(self) -> StereoCamera | None:
        """Calibration of the stereo pair; None where nothing is imaged."""
        return self._observer.camera if self.sensing == "stereo" else None

    @property
    def declaration(self) -> Declaration:
        """What the scene's author tells the estimator."""
        return self.scene.declared.declaration()

    @property
    def metadata(self) -> dict[str, str]:
        """What a recording says of the scene: its disturbances, unless they are secret."""
        if self.scene.secret or not self.scene.disturbances:
            return {}
        return {"disturbances": ", ".join(map(described, self.scene.disturbances))}

    def step(self, action: Action) -> Observation:
        """Carry out an action, let the tissue settle, and observe; without images and points the frame was lost.

        Raises:
            ActionError: a grasp off the tissue or while grasping, a release of nothing, a cut or suture beside the
                tissue, numbers that are not finite.
            SimulationError: the tissue became unstable.
        """
        match action:
            case Grasp():
                self._close(action)
            case Release():
                self._open()
            case Move():
                self._move(action)
            case Cut() | Suture():
                result = carry_out(action, self._simulation, self._chance)
                self._done.append({"index": self._index + 1} | result)
                self._events = (*self._events, action)
            case Wait():
                pass
            case _:
                raise ActionError(f"step takes a Grasp, Move, Release, Wait, Cut or Suture; got {action!r}.")
        settled = self._wait() if isinstance(action, Wait) else self._settle(hasty=isinstance(action, Move))
        seen = self._observer.look()
        if seen is None:
            return Observation(index=self._index + 1, time=self._time, tool=self._tool(), events=self._events)
        self._index += 1
        if not settled:
            self.capped.append(self._index)
        self._frames.append(self._truth_frame())
        images, points = seen
        events, self._events = self._events, ()
        return Observation(
            index=self._index,
            time=self._time,
            tool=self._tool(),
            reports=self._observer.reports(),
            images=images,
            points=points,
            events=events,
        )

    def truth_frame(self) -> TruthFrame:
        """The truth at the last observation."""
        if not self._frames:
            raise ValueError("no observation yet: call step first.")
        return self._frames[-1]

    def truth(self) -> Truth:
        """Mesh, attachments and every frame so far."""
        return Truth(
            rest=self._rest,
            faces=self._simulation.tissue.sheet.faces,
            attached=self._simulation.tissue.stiffness > 0,
            frames=tuple(self._frames),
            scene=self.scene.name,
            details={"scene": scene_table(self.scene), "capped": list(self.capped), "events": list(self._done)},
        )

    def close(self) -> None:
        """Free the renderer."""
        self._observer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # The tool

    @property
    def held(self) -> Bool[np.ndarray, " n"]:
        """Truth: which vertices the jaws hold."""
        return self._simulation.jaws.held

    def _close(self, action: Grasp) -> None:
        if self._closed:
            raise ActionError(f"grasp at {_text(action.point)} while grasp {self._grasp} holds: release it first.")
        point = _finite(action.point, name="Grasp.point")
        if not 0 < action.radius <= WIDEST:
            raise ActionError(f"Grasp.radius must be above 0 m and at most {WIDEST} m; got {action.radius}.")
        distance = np.linalg.norm(self._simulation.surface() - point, axis=1)
        inside = distance <= action.radius
        if not inside.any():
            raise ActionError(
                f"grasp at {_text(point)} m holds nothing: the nearest tissue is {1e3 * distance.min():.1f} mm away, "
                f"the radius is {1e3 * action.radius:.1f} mm. Grasp closer or widen the radius."
            )
        inside &= ~self._simulation.anchors.welded
        if not inside.any():
            raise ActionError(
                f"grasp at {_text(point)} m meets welded vertices only, and a weld does not yield to the jaws. "
                "Grasp elsewhere or widen the radius."
            )
        self._simulation.jaws.tip = self._above_bed(point)
        self._simulation.jaws.close(np.flatnonzero(inside))
        self._observer.jaws_closed()
        self._grasp, self._radius, self._closed = self._grasp + 1, float(action.radius), True

    def _open(self) -> None:
        if not self._closed:
            raise ActionError("release while nothing is held: grasp first.")
        self._simulation.jaws.open()
        self._closed = False

    def _move(self, action: Move) -> None:
        to = _finite(action.to, name="Move.to")
        lowest = -SUNK if self.scene.bed.present else -REACH
        if np.abs(to).max() > REACH or to[2] < lowest:
            raise ActionError(
                f"Move.to = {_text(to)} m is out of reach: each coordinate must be within {REACH:g} m, and z at least "
                f"{lowest:g} m. Lengths are in metres."
            )
        start, to = self._simulation.jaws.tip, self._above_bed(to)
        n_steps = max(math.ceil(np.linalg.norm(to - start) / (self.scene.tweezer.speed * TIMESTEP)), 1)
        if not self._closed:
            n_steps = 1
        for k in range(1, n_steps + 1):
            self._simulation.jaws.tip = start + (to - start) * k / n_steps
            self._simulation.step()

    def _above_bed(self, point: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
        """The point, or where a tip on its way down there meets the bed."""
        return np.array([*point[:2], max(point[2], 0.0)]) if self.scene.bed.present else point

    def _settle(self, *, hasty: bool = False) -> bool:
        settled = self._simulation.settle(steps=self._simulation.patience if hasty else MAX_STEPS)
        mujoco.mj_forward(self._simulation.model, self._simulation.data)
        return settled

    def _wait(self) -> bool:
        for _ in range(WAIT_STEPS):
            self._simulation.step()
        return self._settle()

    # What is seen

    @property
    def _time(self) -> int:
        return round(self._simulation.data.time * 1e9)

    def _truth_frame(self) -> TruthFrame:
        anchors = self._simulation.anchors
        return TruthFrame(
            index=self._index,
            time=self._time,
            positions=self._simulation.surface(),
            stiffness=anchors.stiffness,
            tip=self._simulation.jaws.tip,
            load=anchors.load,
        )

    def _tool(self) -> ToolState:
        return ToolState(
            position=self._observer.tip(),
            quat_wxyz=self._simulation.jaws.quat_wxyz,
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
