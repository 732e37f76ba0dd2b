"""Where everything was a while ago, for senses that come late."""

from collections import deque

import mujoco
import numpy as np
from jaxtyping import Float


class DelayedState:
    """The states after each step, as far back as the longest delay reaches."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, *, longest: float) -> None:
        """`longest` is how far back anybody will look [s]."""
        self._model, self._data = model, data
        self._past = mujoco.MjData(model)
        length = int(np.ceil(longest / model.opt.timestep)) + 1
        self._states: deque[tuple[Float[np.ndarray, " q"], Float[np.ndarray, "m 3"]]] = deque(maxlen=length)
        self.record()

    def record(self) -> None:
        """Keep the present state."""
        self._states.append((self._data.qpos.copy(), self._data.mocap_pos.copy()))

    def tool_stood(self) -> None:
        """Say that the tool has been where it is for as long as anybody remembers."""
        for k, (qpos, _) in enumerate(self._states):
            self._states[k] = (qpos, self._data.mocap_pos.copy())

    def before(self, delay: float) -> mujoco.MjData:
        """The state of a while ago [s], or the oldest there is; it is overwritten by the next call."""
        steps = round(delay / self._model.opt.timestep)
        self._past.qpos[:], self._past.mocap_pos[:] = self._states[max(len(self._states) - 1 - steps, 0)]
        self._past.mocap_quat[:] = self._data.mocap_quat
        mujoco.mj_fwdPosition(self._model, self._past)
        return self._past

    def tip_before(self, delay: float) -> Float[np.ndarray, " 3"]:
        """Where the tool's tip was [m]."""
        steps = round(delay / self._model.opt.timestep)
        return self._states[max(len(self._states) - 1 - steps, 0)][1][0].copy()
