"""Measured points over the frames of a recording: size, motion, and what was never seen; few frames are kept."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from ..observation import MeasuredPoints, ToolState
from .grip_share import held_points
from .identity import PointIdentity
from .noise import NeighbourNoise, noise_of_difference
from .repeated import RepeatedPositions

MOST_MOVED = 95
"""Percentile over the points that counts as how far the points went: single wild points do not count."""
MAX_SPACING_POINTS = 2000
"""Most points whose nearest neighbour is searched, which bounds the time."""


class PointMotion:
    """Points with identities, against where they were first and when the jaws closed."""

    def __init__(self) -> None:
        """Begin without a frame."""
        self._ids = np.zeros(0, np.int64)
        self._last_still: Float[np.ndarray, "n 3"] | None = None
        self._closing: Float[np.ndarray, "n 3"] | None = None
        self._held: Int[np.ndarray, " m"] = np.zeros(0, np.int64)
        self._still_sds: list[float] = []
        self._neighbours: NeighbourNoise | None = None
        self.identity: PointIdentity | None = None
        """Rows that change places, and places of lost points; None before any frame."""
        self.repeated: RepeatedPositions | None = None
        """Positions that are written again while a point is lost; None before any frame."""
        self.restarts = 0
        """Frames in which all points are new ones, though there were others before."""
        self.rest: Float[np.ndarray, "n 3"] | None = None
        """First position of each point [m], NaN before it is seen."""
        self.largest = 0.0
        """Largest `MOST_MOVED` percentile of the distance from the first position, over the frames [m]."""
        self.n_seen = self.n_expected = 0
        """Points that are seen, and that could be, summed over the frames."""
        self.missing_tracks: tuple[int, ...] = ()
        """Held tracks that no frame names."""
        self.held_at_closing = np.full(3, np.nan)
        """Mean of the held points when the jaws closed last [m]; NaN where none is seen."""
        self.held_spread = 0.0
        """Largest distance of a held point from that mean, over the grasps [m]."""
        self.positions: Float[np.ndarray, "n 3"] | None = None
        """Positions in the last frame, by track [m]."""

    @property
    def still_sd(self) -> float | None:
        """Return the noise from frames before the jaws close [m]; None with fewer than two."""
        return float(np.median(self._still_sds)) if self._still_sds else None

    @property
    def neighbour_sd(self) -> float | None:
        """Return the noise from how points stray from their neighbours [m]; None with too few points."""
        return None if self._neighbours is None else self._neighbours.sd

    @property
    def n_points(self) -> int:
        """Return how many points there were so far."""
        return len(self._ids)

    def release(self) -> None:
        """Forget what the last grasp held: the next one may begin in a frame without points."""
        self._closing, self.held_at_closing = None, np.full(3, np.nan)

    def add(self, points: MeasuredPoints, tool: ToolState, *, still: bool, compare: bool) -> Float[np.ndarray, " 3"]:
        """Take one frame; return the mean displacement of the held points since the jaws closed [m], NaN if unknown.

        Args:
            points: the points, with identities.
            tool: the tool in this frame.
            still: whether the jaws have never closed yet.
            compare: whether to compare each point with its neighbours, which takes longest.
        """
        self.positions = positions = self._by_track(points)
        self.n_seen += int(np.isfinite(positions[:, 0]).sum())
        self.n_expected += len(positions)
        assert self.rest is not None
        distance = np.linalg.norm(positions - self.rest, axis=1)
        if np.isfinite(distance).any():
            self.largest = max(self.largest, float(np.nanpercentile(distance, MOST_MOVED)))
        if still:
            if self._last_still is not None:
                sd = noise_of_difference(self._last_still, positions)
                self._still_sds += [] if sd is None else [sd]
            self._last_still = positions
        elif compare and self._neighbours is not None:
            self._neighbours.add(positions)
        assert self.identity is not None and self.repeated is not None
        self.identity.add(positions)
        self.repeated.add(positions)
        if not tool.closed or self._closing is None:
            return np.full(3, np.nan)
        moved = positions[self._held] - self._closing[self._held]
        moved = moved[np.isfinite(moved).all(axis=1)]
        return moved.mean(axis=0) if len(moved) else np.full(3, np.nan)

    def close(self, points: MeasuredPoints, tool: ToolState) -> float:
        """Take the frame in which the jaws close; return the tool's distance from what it holds [m], NaN if unseen.

        What it holds is the declared tracks, or else all points within the grip's radius; without one, the nearest.
        """
        self._closing = positions = self._by_track(points)
        self._held = np.flatnonzero(held_points(tool, positions, self._ids))
        if tool.held_tracks:
            unknown = set(tool.held_tracks) - set(self._ids.tolist())
            self.missing_tracks = tuple(sorted({*self.missing_tracks, *unknown}))
        held = positions[self._held]
        held = held[np.isfinite(held).all(axis=1)]
        self.held_at_closing = held.mean(axis=0) if len(held) else np.full(3, np.nan)
        if len(held):
            spread = float(np.linalg.norm(held - self.held_at_closing, axis=1).max())
            self.held_spread = max(self.held_spread, spread)
            return float(np.linalg.norm(self.held_at_closing - tool.position))
        return nearest_distance(positions, tool.position)

    def _by_track(self, points: MeasuredPoints) -> Float[np.ndarray, "n 3"]:
        """Return positions by track, NaN where unseen, in the order in which tracks appear over the frames."""
        assert points.track_id is not None
        if self.rest is None:
            self.rest = np.empty((0, 3))
        new = np.setdiff1d(points.track_id[points.track_id >= 0], self._ids)
        if len(new):
            self.restarts += bool(len(self._ids)) and not np.isin(points.track_id, self._ids).any()
            self._ids = np.concatenate([self._ids, new])
            self.rest, self._last_still, self._closing = (
                None if known is None else _with_rows(known, len(self._ids))
                for known in (self.rest, self._last_still, self._closing)
            )
        assert self.rest is not None
        order = np.argsort(points.track_id, kind="stable")
        place = np.minimum(np.searchsorted(points.track_id[order], self._ids), len(order) - 1)
        rows = order[place]
        positions = np.where((points.track_id[rows] == self._ids)[:, np.newaxis], points.positions[rows], np.nan)
        first = np.isnan(self.rest[:, 0])
        self.rest[first] = positions[first]
        if self._neighbours is None or self.identity is None:
            rest, apart = self.rest, spacing(self.rest)
            self._neighbours, self.identity = NeighbourNoise(rest), PointIdentity(rest, apart)
            self.repeated = RepeatedPositions(rest, apart)
        return positions


def _with_rows(positions: Float[np.ndarray, "m 3"], count: int) -> Float[np.ndarray, "n 3"]:
    """Return positions with as many rows, NaN in the added ones."""
    return np.concatenate([positions, np.full((count - len(positions), 3), np.nan)])


def nearest_distance(positions: Float[np.ndarray, "n 3"], place: Float[np.ndarray, " 3"]) -> float:
    """Return the distance of a place to the nearest seen point [m]; NaN where none is seen."""
    distance = np.linalg.norm(positions - place, axis=1)
    return float(np.nanmin(distance)) if np.isfinite(distance).any() else float("nan")


def extent(positions: Float[np.ndarray, "n 3"]) -> float | None:
    """Return the longest side of the box around the seen points [m]; None where none is seen."""
    seen = positions[np.isfinite(positions).all(axis=1)]
    return float(np.ptp(seen, axis=0).max()) if len(seen) else None


def spacing(positions: Float[np.ndarray, "n 3"]) -> float | None:
    """Return the median distance of a seen point to the nearest other [m]; None for fewer than two."""
    seen = positions[np.isfinite(positions).all(axis=1)]
    if len(seen) < 2:
        return None
    some = seen[:: max(1, len(seen) // MAX_SPACING_POINTS)]
    return float(np.median(KDTree(seen).query(some, k=2)[0][:, 1]))


def common(values: Sequence[float]) -> float | None:
    """Return the median of those that are known; None without any."""
    known = [value for value in values if np.isfinite(value)]
    return float(np.median(known)) if known else None
