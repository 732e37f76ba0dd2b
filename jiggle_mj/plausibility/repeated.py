"""Points whose last position is written again while they are lost: they look attached, and are not.

A point that is held in place shows noise, or never moves at all. One that moved, then keeps its position to the last
digit while its neighbours go on, was lost.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from .identity import JUMP, N_NEIGHBOURS

LEAST_RUN = 3
"""Frames in a row that repeat a position, from which it is judged: rounded coordinates repeat once or twice."""


class RepeatedPositions:
    """Points with identities, each compared with its own last position and with how its neighbours move."""

    def __init__(self, rest: Float[np.ndarray, "n 3"], spacing: float | None) -> None:
        """Choose the neighbours at rest.

        Args:
            rest: points of the first frame [m], NaN where unseen; those that come later are not judged.
            spacing: median distance of one to the nearest other [m]; None where it is unknown.
        """
        seen = np.flatnonzero(np.isfinite(rest).all(axis=1))
        self._limit = JUMP * (spacing or 0.0)
        self._rows: Int[np.ndarray, " m"] = seen if self._limit and len(seen) > N_NEIGHBOURS else seen[:0]
        self._around: Int[np.ndarray, "m k"] = np.empty((0, N_NEIGHBOURS), np.int64)
        if len(self._rows):
            self._around = np.asarray(KDTree(rest[seen]).query(rest[seen], k=N_NEIGHBOURS + 1)[1])[:, 1:]
        self._last: Float[np.ndarray, "m 3"] = rest[self._rows]
        self._run = np.zeros(len(self._rows), int)
        self._moved = np.zeros(len(self._rows), bool)
        self._passed = np.zeros((len(self._rows), 3))
        self.farthest: dict[int, float] = {}
        """How far its neighbours went, at most, while a point repeated its position, by row [m]."""

    def add(self, positions: Float[np.ndarray, "n 3"]) -> None:
        """Take the points of one more frame [m], NaN where unseen; rows are those at rest, or more."""
        now = positions[self._rows]
        if not len(now):
            return
        step = now - self._last
        seen = np.asarray(np.isfinite(step).all(axis=1))
        same = np.asarray(seen & ~step.any(axis=1))
        self._run = np.where(same, self._run + 1, 0)
        self._moved |= seen & ~same
        self._passed = np.where(same[:, np.newaxis], self._passed + self._around_them(step, seen), 0.0)
        distance = np.linalg.norm(self._passed, axis=1)
        for at in np.flatnonzero((self._run >= LEAST_RUN) & self._moved & (distance > self._limit)):
            row = int(self._rows[at])
            self.farthest[row] = max(self.farthest.get(row, 0.0), float(distance[at]))
        self._last = now

    def _around_them(self, step: Float[np.ndarray, "m 3"], seen: Bool[np.ndarray, " m"]) -> Float[np.ndarray, "m 3"]:
        """Return the median step of each point's neighbours [m]; 0 for one that is unseen."""
        return np.median(np.where(seen[:, np.newaxis], step, 0.0)[self._around], axis=1)
