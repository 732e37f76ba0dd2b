"""The simulation of the tissue: MuJoCo's state, the springs and jaws, disturbances, and a check for instability.

At rest means that no coordinate moves faster than 1 mm/s; with implicit elasticity that takes about five steps of
20 ms after a small move. MuJoCo's warnings are counted here instead of being appended to MUJOCO_LOG.TXT.
"""

import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from jiggle_mj.errors import SimulationError

from ..scene.disturbance import TissueDisturbance
from ..scene.scene import Scene
from .anchors import Anchors
from .jaws import Jaws
from .model import build_tissue

SETTLED_SPEED = 1e-3
"""Largest speed of any coordinate at rest [m/s]."""
INITIAL_SPEED = 1e-5
"""Largest speed before the first frame [m/s]; smaller, so that still frames show the noise of sensing alone."""
MAX_SETTLE_STEPS = 400
"""Number of steps after which a state that is not at rest is observed all the same, and reported as capped."""
MAX_COORDINATE = 2.0
"""Largest coordinate of a stable state [m]; a sheet of 10 cm that passes it has exploded."""
MAX_SPEED = 50.0
"""Largest speed of a stable state [m/s]."""
WARNING_LENGTH = 60
"""Number of characters that identify a warning of MuJoCo's; the numbers after them differ each time."""

warnings: Counter[str] = Counter()
"""Number of MuJoCo's warnings so far, by their first characters. 'M+K solve ran out of iterations' is harmless: forces
still balance to 5e-4."""


def _count_warning(text: str) -> None:
    warnings[text[:WARNING_LENGTH]] += 1


mujoco.set_mju_user_warning(_count_warning)


class Simulation:
    """One scene's tissue, from rest onwards.

    Raises:
        SceneError: the attachments hold no vertex or contradict each other.
        SimulationError: the tissue became unstable before it came to rest.
    """

    def __init__(self, scene: Scene, *, drawn: bool = True, dump_dir: Path | None = None) -> None:
        """Compile the scene, begin the disturbances that start at 0, let the sheet come to rest, and set the time to 0.

        Args:
            scene: the scene.
            drawn: whether images will be rendered; textures take a second.
            dump_dir: folder for the state of an unstable simulation; a temporary one if None.
        """
        self.scene, self.dump_dir = scene, dump_dir
        self.tissue = build_tissue(scene, drawn=drawn)
        self.model = self.tissue.model
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)
        self.anchors = Anchors(self.tissue, scene, self.data)
        self.jaws = Jaws(self.tissue, self.data)
        self.step_hooks: list[Callable[[], None]] = []
        """Functions called after each step."""
        self.max_steps_after_move = MAX_SETTLE_STEPS
        """Number of steps after a move after which a frame is taken, at rest or not."""
        disturbances = [item for item in scene.disturbances if isinstance(item, TissueDisturbance)]
        self._pending = [item for item in disturbances if item.start == 0]
        self.settle(speed=INITIAL_SPEED)
        self.data.time = 0.0
        self._pending = sorted((item for item in disturbances if item.start > 0), key=lambda item: item.start)

    def step(self) -> None:
        """Advance by one timestep, after the disturbances that are due have begun.

        Raises:
            SimulationError: the state became unstable; the message names the file that holds it.
        """
        while self._pending and self._pending[0].start <= self.data.time:
            self._pending.pop(0).begin(self)
        mujoco.mj_step(self.model, self.data)
        self._check_stability()
        for hook in self.step_hooks:
            hook()
        self.jaws.slip()
        self.anchors.follow()

    def settle(self, *, speed: float = SETTLED_SPEED, steps: int = MAX_SETTLE_STEPS) -> bool:
        """Step until every coordinate is slower than `speed` [m/s]; return False if `steps` did not suffice."""
        for _ in range(steps):
            self.step()
            if np.abs(self.data.qvel).max() < speed:
                return True
        return False

    def surface(self, data: mujoco.MjData | None = None) -> Float[np.ndarray, "n 3"]:
        """Return the vertices of the visible surface [m], now or in `data`: moved by the radius along their normals."""
        vertices, faces = (self.data if data is None else data).flexvert_xpos.copy(), self.tissue.sheet.faces
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        normal = np.zeros_like(vertices)
        for k in range(3):
            np.add.at(normal, faces[:, k], np.cross(b - a, c - a))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return vertices + self.scene.tissue.radius * normal

    def _check_stability(self) -> None:
        """Write a state that is not finite or has exploded to a file, and raise."""
        data = self.data
        size, speed = np.abs(data.qpos).max(), np.abs(data.qvel).max()
        if size < MAX_COORDINATE and speed < MAX_SPEED:
            return
        folder = self.dump_dir if self.dump_dir is not None else Path(tempfile.mkdtemp(prefix="jiggle-mj-"))
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / "unstable_state.npz"
        state = {name: getattr(data, name) for name in ("qpos", "qvel", "time", "mocap_pos", "eq_active")}
        np.savez(path, **state)
        raise SimulationError(
            f"the simulation became unstable at t = {data.time:.2f} s (largest coordinate {size:.3g} m, speed "
            f"{speed:.3g} m/s); the state is in {path}. Lower tissue.young, the attachments' stiffness "
            "or the magnitude of the disturbances, or raise tissue.damping."
        )
