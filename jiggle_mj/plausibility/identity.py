"""Identity of measured points over the frames: rows that change places, and places that stand for lost points.

A point of a sheet moves nearly as its neighbours do. One that jumps away from them has lost its identity: it is where
another one should be, or where lost points are put. Compares consecutive frames alone; needs points that lie some
noise apart.
"""

from collections import defaultdict

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

N_NEIGHBOURS = 8
"""Neighbours whose median motion a point should have: those around it in a lattice, so that a few may jump too."""
JUMP = 0.5
"""Distance from where its neighbours' motion puts a point, above which it jumped [spacings]: nearer to the next one."""
TAKEN = 0.25
"""Distance within which a point is at a place [spacings]: half of a jump, so that none is at two. Single points are
judged where most points are so near to their own: a jump is then three standard deviations of normal noise, and two
that take each other's places are each above four."""
MIXED_EXTENT, MIXED_SPACINGS = 0.2, 2.0
"""Median distance from where neighbours put the points, above both of which rows are mixed up [extents, spacings]: a
sheet that moved so would be torn, and noise of that size shows no sheet."""
ISOLATED = 5.0
"""Distance to the nearest other point, above which one is isolated [spacings]: of points that are strewn at random, one
in thirty million."""
SAME_PLACE_M = 1e-9
"""Rounding of a place [m]: of the transformation into the world, and finer than any measurement."""

Place = tuple[float, float, float]


class PointIdentity:
    """Points with identities, each compared with its neighbours from frame to frame."""

    def __init__(self, rest: Float[np.ndarray, "n 3"], spacing: float | None) -> None:
        """Find the points that are isolated at rest.

        Args:
            rest: points of the first frame [m], NaN where unseen.
            spacing: median distance of one to the nearest other [m]; None where it is unknown.
        """
        self._spacing = spacing or 0.0
        self.isolated: Float[np.ndarray, "i 3"] = rest[isolated(rest, spacing)]
        """Points that are far from all others at rest [m]."""
        self._last: Float[np.ndarray, "n 3"] = np.empty((0, 3))
        self._visitors: defaultdict[Place, set[int]] = defaultdict(set)
        self._exchanged: set[int] = set()
        self.exchange_frames = 0
        """Frames in which points change places."""
        self.largest_exchange = 0.0
        """Largest share of a frame's points that change places."""

    @property
    def n_exchanged(self) -> int:
        """Return the number of points that change places at some time."""
        return len(self._exchanged)

    @property
    def shared_place(self) -> tuple[Place, int] | None:
        """Return the place to which most points jump, and their number; None where no two jump to one place."""
        place = max(self._visitors, key=lambda each: len(self._visitors[each]), default=None)
        return None if place is None or len(self._visitors[place]) < 2 else (place, len(self._visitors[place]))

    def add(self, positions: Float[np.ndarray, "n 3"]) -> None:
        """Take the points of one more frame [m], NaN where unseen; rows are those of the frames before, or more."""
        last = np.full_like(positions, np.nan)
        last[: len(self._last)] = self._last
        step = positions - last
        rows = np.flatnonzero(np.isfinite(step).all(axis=1))
        self._last = positions  # not those from before a point was hidden: meanwhile its neighbours moved on
        limit = JUMP * self._spacing
        if len(rows) <= N_NEIGHBOURS or not limit:
            return
        common = np.median(step[rows], axis=0)
        if not (np.linalg.norm(step[rows] - common, axis=1) > limit).any():
            return
        before, after = last[rows], positions[rows]
        around = np.asarray(KDTree(before).query(before, k=N_NEIGHBOURS + 1)[1])[:, 1:]
        motion = np.median(step[rows][around], axis=1)
        stray = np.linalg.norm(after - before - motion, axis=1)
        jumped = np.flatnonzero(stray > limit)
        usual, size = float(np.median(stray)), float(np.ptp(before, axis=0).max())
        calm = usual < TAKEN * self._spacing
        mixed = usual > max(MIXED_EXTENT * size, MIXED_SPACINGS * self._spacing)
        exchanged = jumped if mixed else self._exchanges(before + motion, after, jumped) if calm else jumped[:0]
        if len(exchanged):
            self._exchanged |= set(rows[exchanged].tolist())
            self.exchange_frames += 1
            self.largest_exchange = max(self.largest_exchange, len(exchanged) / len(rows))
        if calm:
            for row in np.setdiff1d(jumped, exchanged):
                for place in (before[row], after[row]):
                    self._visitors[_place(place)].add(int(rows[row]))

    def _exchanges(
        self, expected: Float[np.ndarray, "m 3"], after: Float[np.ndarray, "m 3"], jumped: Int[np.ndarray, " j"]
    ) -> Int[np.ndarray, " e"]:
        """Return the points that have taken each other's places, in pairs or larger rings.

        Args:
            expected: where the points should be [m].
            after: where they are [m].
            jumped: those that jumped.
        """
        distance, taken = KDTree(expected).query(after[jumped])
        near = (np.asarray(distance) < TAKEN * self._spacing) & (taken != jumped)
        points, taken = jumped[near], np.asarray(taken)[near]
        while len(points):
            ring = np.isin(taken, points) & np.isin(points, taken)
            if ring.all():
                break
            points, taken = points[ring], taken[ring]
        return points


def isolated(rest: Float[np.ndarray, "n 3"], spacing: float | None) -> Bool[np.ndarray, " n"]:
    """Return which seen points are far from all others.

    Args:
        rest: points [m], NaN where unseen.
        spacing: median distance of one to the nearest other [m]; None where it is unknown.
    """
    alone, seen = np.zeros(len(rest), bool), np.isfinite(rest).all(axis=1)
    if spacing:
        distance = np.asarray(KDTree(rest[seen]).query(rest[seen], k=2)[0])[:, 1]
        alone[seen] = distance > ISOLATED * spacing
    return alone


def _place(position: Float[np.ndarray, " 3"]) -> Place:
    x, y, z = (np.round(position / SAME_PLACE_M) * SAME_PLACE_M + 0.0).tolist()
    return x, y, z
