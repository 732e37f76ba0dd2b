"""A recording's frames with closed jaws, as arrays for fits over all of them at once."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..effects.sheet_model import FrameContext

USUAL_GAP = 0.25
"""Time between frames that is assumed before the first frame of a grasp [s]."""


class ClosedFrame(eqx.Module):
    """One frame with closed jaws."""

    y: Float[Array, "n 3"]
    """Observed positions, of any value where not `visible` [m]."""
    visible: Bool[Array, " n"]
    """Whether each particle is observed."""
    precision: Float[Array, "n 3 3"]
    """Inverse covariance of the white noise, zero where not observed [1/m^2]."""
    held: Bool[Array, " n"]
    """Whether each particle is in the jaws."""
    force_unknown: Bool[Array, " n"]
    """Particles near the grip, whose forces are not used."""
    rotated: Float[Array, "n 3"]
    """Positions of the held particles when the jaws closed, rotated about the tip as the tool has rotated since [m]."""
    displacement: Float[Array, " 3"]
    """Displacement of the tool since then, as reported [m]."""
    by_points: Bool[Array, ""]
    """Whether the tool's report is derived from the observed positions of the held particles."""
    held_sd: Float[Array, ""]
    """Standard deviation of the mean position of what is held, by the noise of observed positions [m]."""

    @property
    def counted(self) -> Bool[Array, " n"]:
        """Return which particles are observed and not held."""
        return self.visible & ~self.held


@dataclass(frozen=True, kw_only=True)
class Timed:
    """A frame with its time, grasp and part."""

    frame: ClosedFrame
    index: int
    """Index in the recording."""
    grasp: int
    """Number of the grasp."""
    part: int
    """Number of the part that is held out as a whole: the grasp, or a third of the only one."""
    time: float
    """Time since the sheet was in its rest shape [s]."""
    closed: float
    """Time since the jaws closed [s]."""
    state: Float[np.ndarray, "n 3"]
    """Positions as the filter estimated them [m]."""
    reports: tuple[tuple[float, Float[np.ndarray, " 3"]], ...]
    """Times [s], like `time`, and reported displacements of the tool [m] since the frame before, this one included."""


class FrameHistory:
    """All frames of a recording, which make each frame's context from the states as known so far."""

    def __init__(self, frames: list[Timed], rest: Float[np.ndarray, "n 3"]) -> None:
        """Hold all frames in the order of time, and the rest shape [m]."""
        self.frames, self.rest = frames, jnp.asarray(rest)
        self._times = np.array([timed.time for timed in frames])
        grasps = [timed.grasp for timed in frames]
        same = np.array([False] + [a == b for a, b in pairwise(grasps)])
        self._follows, self._last = same, np.where(same, np.roll(self._times, 1), self._times)
        reports = {
            grasp: [report for timed in frames if timed.grasp == grasp for report in timed.reports]
            for grasp in set(grasps)
        }
        longest = max(len(series) for series in reports.values())
        self._reports = {grasp: _padded(series, longest) for grasp, series in reports.items()}

    def by(self, key: Callable[[Timed], int], frames: Iterable[int]) -> dict[int, list[int]]:
        """Return some frames grouped by a key, such as their grasp."""
        groups: dict[int, list[int]] = {}
        for k in frames:
            groups.setdefault(key(self.frames[k]), []).append(k)
        return groups

    def context(self, k: int, states: Float[np.ndarray, "frames n 3"] | Float[Array, "frames n 3"]) -> FrameContext:
        """Return what an effect may know of frame k, for the states of all frames [m]."""
        timed, follows = self.frames[k], self._follows
        twice = follows[k] and follows[k - 1]
        times, displacements = self._reports[timed.grasp]
        before = states[k - 1] if follows[k] else timed.state
        gap = self._times[k] - self._times[k - 1] if follows[k] else USUAL_GAP
        earlier_gap = self._times[k - 1] - self._times[k - 2] if twice else USUAL_GAP
        return FrameContext(
            rest=self.rest,
            time=jnp.asarray(timed.time, dtype=float),  # explicit, so that one compilation serves all frames
            gap=jnp.asarray(gap, dtype=float),
            earlier_gap=jnp.asarray(earlier_gap, dtype=float),
            closed=jnp.asarray(timed.closed, dtype=float),
            now=jnp.asarray(states[k]),
            before=jnp.asarray(before),
            earlier=jnp.asarray(states[k - 2] if twice else before),
            report_times=times,
            reports=displacements,
            past=jnp.asarray(states),
            began=jnp.asarray(self._last),
            ended=jnp.asarray(self._times),
        )


def _padded(
    reports: list[tuple[float, Float[np.ndarray, " 3"]]], length: int
) -> tuple[Float[Array, " r"], Float[Array, "r 3"]]:
    """Return times and displacements of a series padded to a length; after the last report the tool rests."""
    last, displacement = reports[-1]
    reports = reports + [(last + k, displacement) for k in range(1, length - len(reports) + 1)]
    return jnp.asarray([time for time, _ in reports]), jnp.asarray(np.stack([moved for _, moved in reports]))
