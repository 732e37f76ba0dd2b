"""Frames with closed jaws in the order of time, and what an effect may know of each."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Generic, TypeVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .sheet_model import FrameContext

USUAL_GAP = 0.25
"""Time between frames that is assumed before the first frame of a grasp [s]."""
MAX_PREDICTIONS = 4
"""Most computations of a frame's state where an effect depends on it, each from the state of the one before."""
CONVERGED = 1e-5
"""Largest change of a position [m] with which such a frame has converged."""


@dataclass(frozen=True, kw_only=True)
class FrameRecord:
    """Time, state and tool of one frame with closed jaws."""

    grasp: int
    """Number of the grasp."""
    time: float
    """Time since the sheet was in its rest shape [s]."""
    closed: float
    """Time since the jaws closed [s]."""
    state: Float[np.ndarray, "n 3"]
    """Positions as the filter estimated them [m]."""
    reports: tuple[tuple[float, Float[np.ndarray, " 3"]], ...]
    """Times [s], like `time`, and reported displacements of the tool [m] since the frame before, this one included."""


AnyRecord = TypeVar("AnyRecord", bound=FrameRecord)


class FrameHistory(Generic[AnyRecord]):
    """All frames of a recording, which make each frame's context from the states as known so far."""

    def __init__(self, frames: list[AnyRecord], rest: Float[np.ndarray, "n 3"]) -> None:
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
        self._reports = {grasp: padded(series, longest) for grasp, series in reports.items()}

    def by(self, key: Callable[[AnyRecord], int], frames: Iterable[int]) -> dict[int, list[int]]:
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


def padded(
    reports: list[tuple[float, Float[np.ndarray, " 3"]]], length: int
) -> tuple[Float[Array, " r"], Float[Array, "r 3"]]:
    """Return times and displacements of a series padded to a length; after the last report the tool rests."""
    last, displacement = reports[-1]
    reports = reports + [(last + k, displacement) for k in range(1, length - len(reports) + 1)]
    return jnp.asarray([time for time, _ in reports]), jnp.asarray(np.stack([moved for _, moved in reports]))
