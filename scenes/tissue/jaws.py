"""The tweezer's jaws: which vertices they hold, how hard these pull, and where the tip is.

Jaws hold every vertex within their radius but welded ones, which slip out: two rigid constraints would share the gap
between them.
"""

import math

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from .constraints import constraint_force
from .model import TissueModel

OPEN_ANGLE, CLOSED_ANGLE = 0.25, 0.0
"""Of each jaw [rad]."""


class Jaws:
    """Those of one tissue's tweezer."""

    def __init__(self, tissue: TissueModel, data: mujoco.MjData) -> None:
        """Open."""
        self._tissue, self._data = tissue, data
        self.slips_at = math.inf
        """Largest force on a held vertex [N]; beyond it the vertex slips out."""
        self.open()

    @property
    def tip(self) -> Float[np.ndarray, " 3"]:
        """Where the tip truly is [m]."""
        return self._data.mocap_pos[0].copy()

    @tip.setter
    def tip(self, position: Float[np.ndarray, " 3"]) -> None:
        self._data.mocap_pos[0] = position

    @property
    def quat_wxyz(self) -> Float[np.ndarray, " 4"]:
        """Orientation of the tool."""
        return self._data.mocap_quat[0].copy()

    @property
    def held(self) -> Bool[np.ndarray, " n"]:
        """Which vertices are held."""
        return self._data.eq_active[self._tissue.grips].astype(bool)

    def close(self, vertices: Int[np.ndarray, " m"]) -> None:
        """Hold these vertices where they are now."""
        grips, data = self._tissue.grips[vertices], self._data
        self._tissue.model.eq_data[grips, :3] = 0.0
        self._tissue.model.eq_data[grips, 3:6] = data.flexvert_xpos[vertices] - self.tip
        data.eq_active[grips] = 1
        self._turn(CLOSED_ANGLE)

    def open(self) -> None:
        """Let go of everything."""
        self._data.eq_active[self._tissue.grips] = 0
        self._turn(OPEN_ANGLE)

    def force(self) -> Float[np.ndarray, " n"]:
        """How hard the grip pulls at each vertex [N]."""
        return np.linalg.norm(constraint_force(self._data, self._tissue.grips), axis=1)

    def slip(self) -> None:
        """Lose the vertices that are pulled at too hard."""
        if math.isfinite(self.slips_at):
            self._data.eq_active[self._tissue.grips[self.force() > self.slips_at]] = 0

    def _turn(self, angle: float) -> None:
        model = self._tissue.model
        for joint in self._tissue.jaws:
            model.qpos_spring[model.jnt_qposadr[joint]] = angle
            self._data.qpos[model.jnt_qposadr[joint]] = angle
