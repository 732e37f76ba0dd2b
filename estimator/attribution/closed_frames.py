"""What a recording's frames with closed jaws hold, for fits over all of them at once."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..effects.sheet_model import FrameContext

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
    force_unknown: Bool[Array, " n"]
    """Near the grip, where forces are not reckoned with."""
    rotated: Float[Array, "n 3"]
    """Where the jaws closed on the held particles, turned about the tip as the tool has turned since [m]."""
    way: Float[Array, " 3"]
    """How far the tool says that it has gone since [m]."""
    by_points: Bool[Array, ""]
    """Whether that is but where the held particles were seen."""
    held_sd: Float[Array, ""]
    """Of the mean of what is held, by the noise of what is seen [m]."""

    @property
    def counted(self) -> Bool[Array, " n"]:
        """Particles that are seen and not held."""
        return self.visible & ~self.held


@dataclass(frozen=True, kw_only=True)
class Timed:
    """A frame and when it was."""

    frame: ClosedFrame
    index: int
    grasp: int
    part: int
    """What is left out of fits together: the grasp, or a third of the only one."""
    time: float
    """Since the sheet lay as its rest shape has it [s]."""
    closed: float
    """Since the jaws closed [s]."""
    state: Float[np.ndarray, "n 3"]
    """As the filter found it [m]."""
    reports: tuple[tuple[float, Float[np.ndarray, " 3"]], ...]
    """Times [s], as `time`, and the tool's way [m] by its reports since the frame before and in this one."""


class FrameHistory:
    """The moments of a recording's frames, for states as far as they are known."""

    def __init__(self, frames: list[Timed], rest: Float[np.ndarray, "n 3"]) -> None:
        """Of all frames, in their order in time."""
        self.frames, self.rest = frames, jnp.asarray(rest)
        self._times = np.array([one.time for one in frames])
        grasps = [one.grasp for one in frames]
        same = np.array([False] + [a == b for a, b in pairwise(grasps)])
        self._follows, self._last = same, np.where(same, np.roll(self._times, 1), self._times)
        told = {grasp: [told for one in frames if one.grasp == grasp for told in one.reports] for grasp in set(grasps)}
        longest = max(len(one) for one in told.values())
        self._reports = {grasp: _padded(one, longest) for grasp, one in told.items()}

    def by(self, of: Callable[[Timed], int], frames: Iterable[int]) -> dict[int, list[int]]:
        """Some frames, sorted by their grasp, say."""
        found: dict[int, list[int]] = {}
        for k in frames:
            found.setdefault(of(self.frames[k]), []).append(k)
        return found

    def moment(self, k: int, states: Float[np.ndarray, "frames n 3"] | Float[Array, "frames n 3"]) -> FrameContext:
        """What an effect may know of frame k."""
        one, follows = self.frames[k], self._follows
        twice = follows[k] and follows[k - 1]
        times, ways = self._reports[one.grasp]
        before = states[k - 1] if follows[k] else one.state
        gap = self._times[k] - self._times[k - 1] if follows[k] else USUAL_GAP
        earlier_gap = self._times[k - 1] - self._times[k - 2] if twice else USUAL_GAP
        return FrameContext(
            rest=self.rest,
            time=jnp.asarray(one.time, dtype=float),  # said, so that all moments are compiled for as one
            gap=jnp.asarray(gap, dtype=float),
            earlier_gap=jnp.asarray(earlier_gap, dtype=float),
            closed=jnp.asarray(one.closed, dtype=float),
            now=jnp.asarray(states[k]),
            before=jnp.asarray(before),
            earlier=jnp.asarray(states[k - 2] if twice else before),
            report_times=times,
            reports=ways,
            past=jnp.asarray(states),
            began=jnp.asarray(self._last),
            ended=jnp.asarray(self._times),
        )


def _padded(
    told: list[tuple[float, Float[np.ndarray, " 3"]]], length: int
) -> tuple[Float[Array, " r"], Float[Array, "r 3"]]:
    """As long a series; after the last report the tool stood."""
    last, way = told[-1]
    told = told + [(last + k, way) for k in range(1, length - len(told) + 1)]
    return jnp.asarray([time for time, _ in told]), jnp.asarray(np.stack([way for _, way in told]))
