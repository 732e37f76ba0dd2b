"""The tissue in motion: MuJoCo's state, what holds the sheet, what disturbs it, and a guard against instability.

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

SETTLED = 1e-3
"""Largest speed of a settled coordinate [m/s]."""
AT_REST = 1e-5
"""Before the first frame [m/s]: still frames are to show the noise of sensing, not the last of the settling."""
MAX_STEPS = 400
"""After these a state counts as capped, not settled."""
MAX_COORDINATE, MAX_SPEED = 2.0, 50.0
"""Beyond these [m], [m/s] a state of a 10 cm sheet is an explosion."""

warnings: Counter[str] = Counter()
"""MuJoCo's warnings so far, by their first 60 characters; 'M+K solve ran out of iterations' is harmless: forces
balance to 5e-4 all the same."""


def _count(text: str) -> None:
    warnings[text[:60]] += 1


mujoco.set_mju_user_warning(_count)


class Simulation:
    """One scene's tissue, from rest onwards."""

    def __init__(self, scene: Scene, *, drawn: bool = True, dump_dir: Path | None = None) -> None:
        """Compile the scene, start what disturbs it from the beginning, and let it come to rest; time is 0 then."""
        self.scene, self.dump_dir = scene, dump_dir
        self.tissue = build_tissue(scene, drawn=drawn)
        self.model = self.tissue.model
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)
        self.anchors = Anchors(self.tissue, scene, self.data)
        self.jaws = Jaws(self.tissue, self.data)
        self.rules: list[Callable[[], None]] = []
        """Called after each step."""
        self.patience = MAX_STEPS
        """Steps after a move after which a frame is taken, at rest or not."""
        mine = [one for one in scene.disturbances if isinstance(one, TissueDisturbance)]
        self._coming = [one for one in mine if one.start == 0]
        self.settle(speed=AT_REST)
        self.data.time = 0.0
        self._coming = sorted((one for one in mine if one.start > 0), key=lambda one: one.start)

    def step(self) -> None:
        """20 ms.

        Raises:
            SimulationError: the state became unstable; its dump is named.
        """
        while self._coming and self._coming[0].start <= self.data.time:
            self._coming.pop(0).begin(self)
        mujoco.mj_step(self.model, self.data)
        self._check()
        for rule in self.rules:
            rule()
        self.jaws.slip()
        self.anchors.follow()

    def settle(self, *, speed: float = SETTLED, steps: int = MAX_STEPS) -> bool:
        """Step until every coordinate is slower than `speed` [m/s]; False if `steps` came first."""
        for _ in range(steps):
            self.step()
            if np.abs(self.data.qvel).max() < speed:
                return True
        return False

    def surface(self, data: mujoco.MjData | None = None) -> Float[np.ndarray, "n 3"]:
        """The vertices on the drawn surface, now or in `data`: moved by the flex radius along their normals [m]."""
        vertices, faces = (self.data if data is None else data).flexvert_xpos.copy(), self.tissue.sheet.faces
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        normal = np.zeros_like(vertices)
        for k in range(3):
            np.add.at(normal, faces[:, k], np.cross(b - a, c - a))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        return vertices + self.scene.tissue.radius * normal

    def _check(self) -> None:
        """Refuse a state that is not finite or has exploded, after writing it to a file."""
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
            "or the magnitude of what disturbs the tissue, or raise tissue.damping."
        )
