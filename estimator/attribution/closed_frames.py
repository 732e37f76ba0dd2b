"""What a recording's frames with closed jaws hold, for fits over all of them at once."""

from dataclasses import dataclass
from itertools import pairwise

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from jiggle_mj.estimator.effects.sheet_model import Moment

USUAL_GAP = 0.25
"""Between frames, where the jaws have just closed [s]."""


class ClosedFrame(eqx.Module):
    """One frame, as arrays."""

    y: Float[Array, "n 3"]
    """Positions as seen, anything where `visible` is not [m]."""
    visible: Bool[Array, " n"]
    precision: Float[Array, "n 3 3"]
    """Inverse covariance of the white noise, zero where nothing is seen [1/m^2]."""
    held: Bool[Array, " n"]
    loaded: Bool[Array, " n"]
    """Near the grip, where forces are not reckoned with."""
    closed_at: Float[Array, "n 3"]
    """Where the jaws closed on the held particles [m]."""
    way: Float[Array, " 3"]
    """How far the tool says that it has gone since [m]."""


@dataclass(frozen=True, kw_only=True)
class Timed:
    """A frame and when it was."""

    frame: ClosedFrame
    index: int
    grasp: int
    part: int
    """What is left out of fits together: the grasp, or a third of the only one."""
    time: float
    """Since the sheet was seen at rest [s]."""
    closed: float
    """Since the jaws closed [s]."""
    state: Float[np.ndarray, "n 3"]
    """As the filter found it [m]."""


class History:
    """The moments of a recording's frames, for states as far as they are known."""

    def __init__(self, frames: list[Timed], rest: Float[np.ndarray, "n 3"]) -> None:
        """Of all frames, in their order in time."""
        self.frames, self.rest = frames, jnp.asarray(rest)
        self._times = np.array([one.time for one in frames])
        grasps = [one.grasp for one in frames]
        same = np.array([False] + [a == b for a, b in pairwise(grasps)])
        self._follows, self._last = same, np.where(same, np.roll(self._times, 1), self._times)
        longest = max(grasps.count(grasp) for grasp in set(grasps))
        self._reports = {grasp: self._reported(grasp, longest) for grasp in set(grasps)}

    def moment(self, k: int, states: Float[np.ndarray, "frames n 3"]) -> Moment:
        """What an effect may know of frame k."""
        one, follows = self.frames[k], self._follows
        twice = follows[k] and follows[k - 1]
        times, ways = self._reports[one.grasp]
        before = states[k - 1] if follows[k] else one.state
        return Moment(
            rest=self.rest,
            time=jnp.asarray(one.time),
            gap=jnp.asarray(self._times[k] - self._times[k - 1] if follows[k] else USUAL_GAP),
            earlier_gap=jnp.asarray(self._times[k - 1] - self._times[k - 2] if twice else USUAL_GAP),
            closed=jnp.asarray(one.closed),
            now=jnp.asarray(states[k]),
            before=jnp.asarray(before),
            earlier=jnp.asarray(states[k - 2] if twice else before),
            report_times=times,
            reports=ways,
            past=jnp.asarray(states),
            began=jnp.asarray(self._last),
            ended=jnp.asarray(self._times),
        )

    def _reported(self, grasp: int, longest: int) -> tuple[Float[Array, " r"], Float[Array, "r 3"]]:
        mine = [one for one in self.frames if one.grasp == grasp]
        times, ways = [one.time for one in mine], [np.asarray(one.frame.way) for one in mine]
        times += [times[-1] + k for k in range(1, longest - len(mine) + 1)]
        ways += [ways[-1]] * (longest - len(mine))
        return jnp.asarray(times), jnp.asarray(ways)
