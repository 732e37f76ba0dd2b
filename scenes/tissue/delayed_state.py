"""Past states of the simulation, for sensors and tool reports that arrive late."""

from collections import deque

import mujoco
import numpy as np
from jaxtyping import Float


class DelayedState:
    """The states after each step, as far back as the longest delay."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, *, longest: float) -> None:
        """Start with the present state; `longest` is the largest delay that will be asked for [s]."""
        self._model, self._data = model, data
        self._past = mujoco.MjData(model)
        length = int(np.ceil(longest / model.opt.timestep)) + 1
        self._states: deque[tuple[Float[np.ndarray, " q"], Float[np.ndarray, "m 3"]]] = deque(maxlen=length)
        self.record()

    def record(self) -> None:
        """Append the present state."""
        self._states.append((self._data.qpos.copy(), self._data.mocap_pos.copy()))

    def set_tool_at_rest(self) -> None:
        """Replace the tool's past positions by its present one, as if it had stood here all the time."""
        for k, (qpos, _) in enumerate(self._states):
            self._states[k] = (qpos, self._data.mocap_pos.copy())

    def before(self, delay: float) -> mujoco.MjData:
        """Return the state a delay [s] ago, or the oldest; the next call overwrites it."""
        self._past.qpos[:], self._past.mocap_pos[:] = self._state(delay)
        self._past.mocap_quat[:] = self._data.mocap_quat
        mujoco.mj_fwdPosition(self._model, self._past)
        return self._past

    def tip_before(self, delay: float) -> Float[np.ndarray, " 3"]:
        """Return the position of the tool's tip a delay [s] ago, or the oldest [m]."""
        return self._state(delay)[1][0].copy()

    def _state(self, delay: float) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, "m 3"]]:
        steps = round(delay / self._model.opt.timestep)
        return self._states[max(len(self._states) - 1 - steps, 0)]
