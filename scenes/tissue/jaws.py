"""The tweezer's jaws: which vertices they hold, the grip force on each, and where the tip is.

Jaws hold every vertex within their radius except welded ones, which slip out: two rigid constraints on one vertex would
share the gap between them.
"""

import math

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from .constraints import constraint_force
from .model import TissueModel

OPEN_ANGLE, CLOSED_ANGLE = 0.25, 0.0
"""Angle of each jaw while the tweezer is open and closed [rad]; it only changes the images."""


class Jaws:
    """The jaws of one simulation."""

    def __init__(self, tissue: TissueModel, data: mujoco.MjData) -> None:
        """Start with open jaws."""
        self._tissue, self._data = tissue, data
        self.slips_at = math.inf
        """Grip force on a vertex above which it slips out [N]."""
        self.open()

    @property
    def tip(self) -> Float[np.ndarray, " 3"]:
        """Return the true position of the tip [m]."""
        return self._data.mocap_pos[0].copy()

    @tip.setter
    def tip(self, position: Float[np.ndarray, " 3"]) -> None:
        self._data.mocap_pos[0] = position

    @property
    def quat_wxyz(self) -> Float[np.ndarray, " 4"]:
        """Return the orientation of the tool."""
        return self._data.mocap_quat[0].copy()

    @property
    def held(self) -> Bool[np.ndarray, " n"]:
        """Return which vertices are held."""
        return self._data.eq_active[self._tissue.grips].astype(bool)

    def close(self, vertices: Int[np.ndarray, " m"]) -> None:
        """Hold these vertices where they are now, relative to the tip."""
        grips, data = self._tissue.grips[vertices], self._data
        self._tissue.model.eq_data[grips, :3] = 0.0
        self._tissue.model.eq_data[grips, 3:6] = data.flexvert_xpos[vertices] - self.tip
        data.eq_active[grips] = 1
        self._set_angle(CLOSED_ANGLE)

    def open(self) -> None:
        """Release all vertices."""
        self._data.eq_active[self._tissue.grips] = 0
        self._set_angle(OPEN_ANGLE)

    @property
    def pull(self) -> Float[np.ndarray, "n 3"]:
        """Return the force of the jaws on each vertex [N]."""
        return constraint_force(self._data, self._tissue.grips)

    def force(self) -> Float[np.ndarray, " n"]:
        """Return the size of the grip force on each vertex [N]."""
        return np.linalg.norm(self.pull, axis=1)

    def slip(self) -> None:
        """Release the vertices whose grip force exceeds `slips_at`."""
        if math.isfinite(self.slips_at):
            self._data.eq_active[self._tissue.grips[self.force() > self.slips_at]] = 0

    def _set_angle(self, angle: float) -> None:
        model = self._tissue.model
        for joint in self._tissue.jaws:
            model.qpos_spring[model.jnt_qposadr[joint]] = angle
            self._data.qpos[model.jnt_qposadr[joint]] = angle
