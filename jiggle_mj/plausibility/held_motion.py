"""Tool and held points, frame by frame: while the jaws are closed both give the same motion."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from ..observation import Observation
from .closed_tool import NS

N_LEADERS = 4
"""Points whose mean displacement is that of the points that move most: fewer are a tracker's jumps."""


@dataclass(kw_only=True)
class HeldMotion:
    """Where the tool and the points that it holds were, collected over the frames of a recording."""

    _frames: list[tuple[int, int, Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]] = field(default_factory=list)
    _reports: list[tuple[int, Float[np.ndarray, " 3"]]] = field(default_factory=list)
    _shares: dict[bool, Float[np.ndarray, " 2"]] = field(
        default_factory=lambda: {closed: np.zeros(2) for closed in (True, False)}
    )
    _last: tuple[Observation, Float[np.ndarray, "n 3"]] | None = None

    def add(
        self, observation: Observation, held: Float[np.ndarray, " 3"], positions: Float[np.ndarray, "n 3"] | None
    ) -> None:
        """Take one frame.

        Args:
            observation: the frame.
            held: mean place of the held points [m]; NaN if unknown.
            positions: of all points by track [m], NaN where unseen; None where there are none with identities.
        """
        tool = observation.tool
        self._reports += [(report.time, report.position) for report in observation.reports]
        self._reports.append((observation.time, tool.position))
        if tool.closed and np.isfinite(held).all():
            self._frames.append((observation.time, tool.grasp, tool.position, held))
        if positions is None:
            return
        if self._last is not None and self._last[0].tool.closed == tool.closed:
            before, was = self._last
            n = min(len(was), len(positions))
            step, leading = tool.position - before.tool.position, leading_motion(positions[:n] - was[:n])
            if before.tool.grasp == tool.grasp:
                self._shares[tool.closed] += np.array([leading @ step, step @ step])
        self._last = observation, positions

    def followed(self, *, closed: bool) -> tuple[float, float]:
        """Return which share of the tool's steps the points follow that move most, and the root of the steps' squares.

        Args:
            closed: in frames with closed jaws, or in those with open ones.

        Returns:
            The share, 0 where the tool stands still, and the size of the steps [m].
        """
        together, squared = self._shares[closed]
        return (float(together / squared) if squared > 0 else 0.0), float(np.sqrt(squared))

    @property
    def times(self) -> Float[np.ndarray, " n"]:
        """Return the times of the frames with held points [s]."""
        return np.array([time for time, *_ in self._frames]) * NS

    @property
    def grasps(self) -> Int[np.ndarray, " n"]:
        """Return the grasp of each of them, numbered from 0."""
        return np.unique(np.array([grasp for _, grasp, *_ in self._frames], int), return_inverse=True)[1]

    @property
    def tool(self) -> Float[np.ndarray, "n 3"]:
        """Return where the tool was in each of them [m]."""
        return np.array([tool for *_, tool, _ in self._frames]).reshape(-1, 3)

    @property
    def held(self) -> Float[np.ndarray, "n 3"]:
        """Return where the held points were in each of them [m]."""
        return np.array([held for *_, held in self._frames]).reshape(-1, 3)

    def path(self) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 3"]]:
        """Return times [s] and positions [m] of all that the tool reported, in the order of time."""
        in_turn = sorted(self._reports, key=lambda report: report[0])
        return np.array([time for time, _ in in_turn]) * NS, np.array([place for _, place in in_turn]).reshape(-1, 3)


def centred(places: Float[np.ndarray, "n 3"], groups: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Return places relative to the mean of their group [m]; groups are numbered from 0 without a gap."""
    sums = np.stack([np.bincount(groups, weights=places[:, axis]) for axis in range(3)], axis=1)
    return places - (sums / np.bincount(groups)[:, np.newaxis])[groups]


def rms(vectors: Float[np.ndarray, "n 3"]) -> float:
    """Return the root mean square length of vectors, in their unit."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def leading_motion(moved: Float[np.ndarray, "*t n 3"]) -> Float[np.ndarray, "*t 3"]:
    """Return the mean displacement of the points that move most [m], NaN where unseen; 0 where none is seen."""
    most = np.argsort(np.nan_to_num(np.linalg.norm(moved, axis=-1), nan=-1.0), axis=-1)[..., -N_LEADERS:]
    taken = np.take_along_axis(moved, most[..., np.newaxis], axis=-2)
    seen = np.isfinite(taken)
    return np.sum(taken, axis=-2, where=seen) / np.maximum(1, seen.sum(axis=-2))
