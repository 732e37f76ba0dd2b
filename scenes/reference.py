"""The reference tissue as an experiment: actions in, observations out, and the truth for scoring.

Each action ends when the tissue is at rest; then one observation is taken. An observation holds nothing of MuJoCo's
state but the tool's reported pose and what the chosen sensing shows.
"""

import math
import os
from pathlib import Path
from types import TracebackType
from typing import Self

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from jiggle_mj.actions import Action, Cut, Grasp, Move, Release, Suture, Wait
from jiggle_mj.argument_checks import as_choice, as_instance, as_integer, quoted
from jiggle_mj.camera import StereoCamera
from jiggle_mj.errors import ActionError
from jiggle_mj.observation import Declaration, Observation, ToolState
from jiggle_mj.options import SENSING, Sensing
from jiggle_mj.truth import Truth, TruthFrame

from .disturbances.registry import describe
from .scene.scene import Scene
from .scene_file import scene_table
from .sensing.observer import Observer
from .tissue.model import TIMESTEP
from .tissue.procedure import apply_event
from .tissue.simulation import MAX_SETTLE_STEPS, Simulation

FAILURE_STREAM = 1
"""Number that separates the random stream of failed cuts and sutures from that of the sensing noise."""
MAX_GRASP_RADIUS = 0.05
"""Largest radius of a grasp [m]."""
MAX_REACH = 1.0
"""Largest coordinate of the tip along each axis [m]; beyond it a length is probably in millimetres."""
MAX_DEPTH = 5e-3
"""Largest depth below the bed to which the tip may be sent [m], as measured tissue may seem too low. The tip stops
on the bed."""
MIN_WAIT_STEPS = 5
"""Number of steps of a Wait before the tissue may count as at rest: still frames are a little over 0.1 s apart."""


class Reference:
    """A tissue that can be grasped, lifted, cut, sewn and observed.

    Args:
        scene: of `load_scene`, or constructed.
        seed: seed of the sensing noise.
        sensing: what an observation holds.
        dump_dir: folder for the state of a simulation that becomes unstable.

    Raises:
        OptionError: an argument has the wrong type, the seed is below 0, or `sensing` is not one of `SENSING`.
        SceneError: the scene is impossible.
        RenderError: `sensing="stereo"`, and this machine has no offscreen OpenGL.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        seed: int,
        sensing: Sensing,
        dump_dir: Path | None = None,
    ) -> None:
        self.scene = as_instance(scene, "scene", Scene, hint="load_scene(NAME) reads one.")
        self.sensing: Sensing = as_choice(sensing, "sensing", SENSING)
        seed = as_integer(seed, "seed", at_least=0)
        if dump_dir is not None:
            dump_dir = Path(as_instance(dump_dir, "dump_dir", os.PathLike, hint="Path(TEXT) makes one."))
        self.simulation = Simulation(scene, drawn=sensing == "stereo", dump_dir=dump_dir)
        """Truth: MuJoCo's state behind the experiment, for tests of the reference. An estimator must not read it."""
        noise = np.random.default_rng([scene.seed, seed])
        self._failure_rng = np.random.default_rng([scene.seed, seed, FAILURE_STREAM])
        self.observer = Observer(self.simulation, sensing=sensing, rng=noise)
        """Truth: the sensing with its faults."""
        self._new_events: tuple[Cut | Suture, ...] = ()
        self._outcomes: list[dict[str, object]] = []
        self._index, self._grasp, self._radius, self._closed = -1, 0, scene.tweezer.radius, False
        self.capped: list[int] = []
        """Indices of observations that were taken before the tissue was at rest."""
        self._rest = self.simulation.surface()
        self._frames: list[TruthFrame] = []

    @property
    def camera(self) -> StereoCamera | None:
        """Return the calibration of the stereo pair; None without images."""
        return self.observer.camera if self.sensing == "stereo" else None

    @property
    def declaration(self) -> Declaration:
        """Return what the scene declares to the estimator."""
        return self.scene.declared.declaration()

    @property
    def metadata(self) -> dict[str, str]:
        """Return the metadata of a recording: the scene's disturbances, unless they are secret."""
        if self.scene.secret or not self.scene.disturbances:
            return {}
        return {"disturbances": ", ".join(map(describe, self.scene.disturbances))}

    def step(self, action: Action) -> Observation:
        """Apply an action, let the tissue settle, and observe.

        An observation without images and points is a lost frame.

        Raises:
            ActionError: a grasp off the tissue or during a grasp, a release without a grasp, a cut or suture off the
                tissue, a number out of range, or something that is no action.
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
                outcome = apply_event(action, self.simulation, self._failure_rng)
                self._outcomes.append({"index": self._index + 1} | outcome)
                self._new_events = (*self._new_events, action)
            case Wait():
                pass
            case _:
                raise ActionError(f"step takes a Grasp, Move, Release, Wait, Cut or Suture; got {quoted(action)}.")
        settled = self._wait() if isinstance(action, Wait) else self._settle(after_move=isinstance(action, Move))
        view = self.observer.look()
        if view is None:
            return Observation(index=self._index + 1, time=self._time, tool=self._tool(), events=self._new_events)
        self._index += 1
        if not settled:
            self.capped.append(self._index)
        self._frames.append(self._truth_frame())
        images, points = view
        events, self._new_events = self._new_events, ()
        return Observation(
            index=self._index,
            time=self._time,
            tool=self._tool(),
            reports=self.observer.reports(),
            images=images,
            points=points,
            events=events,
            force=self.observer.force(),
        )

    def truth_frame(self) -> TruthFrame:
        """Return the truth at the last observation.

        Raises:
            ValueError: nothing has been observed yet.
        """
        if not self._frames:
            raise ValueError("no observation yet: call step first.")
        return self._frames[-1]

    def truth(self) -> Truth:
        """Return the mesh, the attachments and every frame so far."""
        return Truth(
            rest=self._rest,
            faces=self.simulation.tissue.sheet.faces,
            attached=self.simulation.tissue.stiffness > 0,
            frames=tuple(self._frames),
            scene=self.scene.name,
            details={
                "scene": scene_table(self.scene),
                "capped": list(self.capped),
                "events": list(self._outcomes),
            },
        )

    def close(self) -> None:
        """Free the renderer."""
        self.observer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # The tool

    @property
    def held(self) -> Bool[np.ndarray, " n"]:
        """Return which vertices the jaws hold; this is truth."""
        return self.simulation.jaws.held

    def _close(self, action: Grasp) -> None:
        if self._closed:
            raise ActionError(f"grasp at {_text(action.point)} while grasp {self._grasp} holds: release it first.")
        point = action.point
        if action.radius > MAX_GRASP_RADIUS:
            raise ActionError(f"Grasp.radius must be at most {MAX_GRASP_RADIUS} m; got {action.radius:g}.")
        distance = np.linalg.norm(self.simulation.surface() - point, axis=1)
        inside = distance <= action.radius
        if not inside.any():
            raise ActionError(
                f"grasp at {_text(point)} m holds nothing: the nearest tissue is {1e3 * distance.min():.1f} mm away, "
                f"the radius is {1e3 * action.radius:.1f} mm. Grasp closer or widen the radius."
            )
        inside &= ~self.simulation.anchors.welded
        if not inside.any():
            raise ActionError(
                f"grasp at {_text(point)} m meets welded vertices only, and the jaws cannot move a weld. "
                "Grasp elsewhere or widen the radius."
            )
        self.simulation.jaws.tip = self._above_bed(point)
        self.simulation.jaws.close(np.flatnonzero(inside))
        self.observer.jaws_closed()
        self._grasp, self._radius, self._closed = self._grasp + 1, action.radius, True

    def _open(self) -> None:
        if not self._closed:
            raise ActionError("release while nothing is held: grasp first.")
        self.simulation.jaws.open()
        self._closed = False

    def _move(self, action: Move) -> None:
        to = action.to
        lowest = -MAX_DEPTH if self.scene.bed.present else -MAX_REACH
        if np.abs(to).max() > MAX_REACH or to[2] < lowest:
            raise ActionError(
                f"Move.to = {_text(to)} m is out of reach: each coordinate must be within {MAX_REACH:g} m, and z "
                f"at least {lowest:g} m. Lengths are in metres."
            )
        start, to = self.simulation.jaws.tip, self._above_bed(to)
        n_steps = max(math.ceil(np.linalg.norm(to - start) / (self.scene.tweezer.speed * TIMESTEP)), 1)
        if not self._closed:
            n_steps = 1
        for k in range(1, n_steps + 1):
            self.simulation.jaws.tip = start + (to - start) * k / n_steps
            self.simulation.step()

    def _above_bed(self, point: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
        """Return the point, or the point on the bed above it if it lies below the bed [m]."""
        return np.array([*point[:2], max(point[2], 0.0)]) if self.scene.bed.present else point

    def _settle(self, *, after_move: bool = False) -> bool:
        steps = self.simulation.max_steps_after_move if after_move else MAX_SETTLE_STEPS
        settled = self.simulation.settle(steps=steps)
        mujoco.mj_forward(self.simulation.model, self.simulation.data)
        return settled

    def _wait(self) -> bool:
        for _ in range(MIN_WAIT_STEPS):
            self.simulation.step()
        return self._settle()

    # Observations

    @property
    def _time(self) -> int:
        return round(self.simulation.data.time * 1e9)

    def _truth_frame(self) -> TruthFrame:
        anchors = self.simulation.anchors
        return TruthFrame(
            index=self._index,
            time=self._time,
            positions=self.simulation.surface(),
            stiffness=anchors.stiffness,
            tip=self.simulation.jaws.tip,
            load=anchors.load,
        )

    def _tool(self) -> ToolState:
        return ToolState(
            position=self.observer.reported_tip(),
            quat_wxyz=self.simulation.jaws.quat_wxyz,
            closed=self._closed,
            grasp=self._grasp,
            radius=self._radius,
        )


def _text(point: Float[np.ndarray, " 3"]) -> str:
    return "(" + ", ".join(f"{value:.4f}" for value in point) + ")"
