"""Identity of measured points over the frames: rows that change places, marks of lost points, and wild ones.

A point of a sheet moves nearly as its neighbours do. One that jumps away from them has lost its identity: it is where
another one should be, or where lost points are put. Compares consecutive frames alone; needs points that lie some
noise apart.
"""

from collections import Counter, defaultdict

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
in thirty million. One that jumps so far from its neighbours is wild: the sheet would be torn."""
LEAST_LOST, LOST_SHARE = 3, 0.9
"""Frames in which further points come to one coordinate from which it stands for a lost one, and share of all jumps in
that direction: two wild ones may do so by chance where coordinates are rounded, and what the jaws hold in one frame."""
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
        self._first_arrivals: defaultdict[tuple[int, bool, float], dict[int, int]] = defaultdict(dict)
        self._n_arrivals = Counter[tuple[int, bool, float]]()
        self._n_along = Counter[tuple[int, bool]]()
        self._frames = 0
        self.wild: dict[int, float] = {}
        """Farthest jump away from its neighbours of each point that makes a wild one [m]."""
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

    @property
    def lost_coordinate(self) -> tuple[int, float, int] | None:
        """Return the axis whose coordinate most points jump to alone, that value, and their number; None for none.

        Nearly all that jump along the axis in that direction do, and they do so first in several frames: those that
        the jaws carry do in one, and come to other values too.
        """
        found = [
            (len(first), axis, value)
            for (axis, up, value), first in self._first_arrivals.items()
            if len(set(first.values())) >= LEAST_LOST
            and self._n_arrivals[axis, up, value] >= LOST_SHARE * self._n_along[axis, up]
        ]
        count, axis, value = max(found, default=(0, 0, 0.0))
        return (axis, value, count) if count else None

    def add(self, positions: Float[np.ndarray, "n 3"]) -> None:
        """Take the points of one more frame [m], NaN where unseen; rows are those of the frames before, or more."""
        self._frames += 1
        limit, last = JUMP * self._spacing, np.full_like(positions, np.nan)
        last[: len(self._last)] = self._last
        step = positions - last
        self._last = positions  # not those from before a point was hidden: meanwhile its neighbours moved on
        if not _any_beyond(step, limit / 3):
            return  # of steps so short none is further than the limit from a median of others
        rows = np.flatnonzero(np.isfinite(step).all(axis=1))
        if len(rows) <= N_NEIGHBOURS or not limit or not _any_beyond(step - np.median(step[rows], axis=0), limit / 3):
            return
        before, after = last[rows], positions[rows]
        around = np.asarray(KDTree(before).query(before, k=N_NEIGHBOURS + 1)[1])[:, 1:]
        motion = np.median(step[rows][around], axis=1)
        stray = np.linalg.norm(after - before - motion, axis=1)
        jumped = np.flatnonzero(stray > limit)
        usual, size = float(np.median(stray)), float(np.ptp(before, axis=0).max())
        calm = usual < TAKEN * self._spacing
        mixed = usual > max(MIXED_EXTENT * size, MIXED_SPACINGS * self._spacing)
        alone = jumped[self._alone(step[rows], around, jumped)]
        exchanged = jumped if mixed else self._exchanges(before, motion, after, jumped, alone) if calm else jumped[:0]
        if len(exchanged):
            self._exchanged |= set(rows[exchanged].tolist())
            self.exchange_frames += 1
            self.largest_exchange = max(self.largest_exchange, len(exchanged) / len(rows))
        if calm:
            off = after - before - motion
            for at in np.setdiff1d(jumped, exchanged):
                self._note_coordinate(int(rows[at]), off[at], after[at])
            for at in np.setdiff1d(alone, exchanged):
                row, distance = int(rows[at]), float(stray[at])
                for place in (before[at], after[at]):
                    self._visitors[_place(place)].add(row)
                if distance > ISOLATED * self._spacing:
                    self.wild[row] = max(self.wild.get(row, 0.0), distance)

    def _alone(
        self, steps: Float[np.ndarray, "m 3"], around: Int[np.ndarray, "m k"], jumped: Int[np.ndarray, " j"]
    ) -> Bool[np.ndarray, " j"]:
        """Return which points that jumped do so alone: those that the jaws carry move as a neighbour does."""
        apart = np.linalg.norm(steps[around[jumped]] - steps[jumped][:, np.newaxis], axis=2)
        return np.asarray(apart.min(axis=1) > TAKEN * self._spacing)

    def _note_coordinate(self, row: int, off: Float[np.ndarray, " 3"], after: Float[np.ndarray, " 3"]) -> None:
        """Note the coordinate that a point comes to that jumped along one axis alone.

        Args:
            row: the point.
            off: from where its neighbours' motion puts it [m].
            after: where it is [m].
        """
        axis = int(np.argmax(np.abs(off)))
        if np.abs(np.delete(off, axis)).max() < TAKEN * self._spacing:
            up, value = bool(off[axis] > 0), _place(after)[axis]
            self._n_along[axis, up] += 1
            self._n_arrivals[axis, up, value] += 1
            self._first_arrivals[axis, up, value].setdefault(row, self._frames)

    def _exchanges(
        self,
        before: Float[np.ndarray, "m 3"],
        motion: Float[np.ndarray, "m 3"],
        after: Float[np.ndarray, "m 3"],
        jumped: Int[np.ndarray, " j"],
        alone: Int[np.ndarray, " a"],
    ) -> Int[np.ndarray, " e"]:
        """Return the points that have taken each other's places, in pairs or larger rings, or all moved on by a row.

        Args:
            before: where the points were [m].
            motion: of the neighbours of each [m].
            after: where they are [m].
            jumped: those that jumped.
            alone: those of them that no neighbour goes along with.
        """
        others = self._taken(before, after)
        if (others < 0).sum() <= len(jumped) and (others[jumped] >= 0).any():
            return np.flatnonzero(others >= 0)  # a sheet that moves by a spacing comes to new places, and jumps nowhere
        taken = self._taken(before + motion, after[alone], alone)
        points, taken = alone[taken >= 0], taken[taken >= 0]
        while len(points):
            ring = np.isin(taken, points) & np.isin(points, taken)
            if ring.all():
                break
            points, taken = points[ring], taken[ring]
        return points

    def _taken(
        self,
        places: Float[np.ndarray, "m 3"],
        after: Float[np.ndarray, "j 3"],
        points: Int[np.ndarray, " j"] | None = None,
    ) -> Int[np.ndarray, " j"]:
        """Return whose place each point is at [m], among all others; -1 where at none, or at its own."""
        distance, taken = KDTree(places).query(after)
        own = np.arange(len(after)) if points is None else points
        return np.where((np.asarray(distance) < TAKEN * self._spacing) & (taken != own), taken, -1)


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


def _any_beyond(steps: Float[np.ndarray, "n 3"], length: float) -> bool:
    """Return whether a step is longer; NaN counts as none."""
    return bool((np.einsum("ni,ni->n", steps, steps) > length**2).any())


def _place(position: Float[np.ndarray, " 3"]) -> Place:
    x, y, z = (np.round(position / SAME_PLACE_M) * SAME_PLACE_M + 0.0).tolist()
    return x, y, z
