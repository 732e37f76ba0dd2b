"""Measured points over the frames of a recording: size, motion, and what was never seen; few frames are kept."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from ..observation import MeasuredPoints, ToolState
from .noise import NeighbourNoise, noise_of_difference

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

    @property
    def still_sd(self) -> float | None:
        """Return the noise from frames before the jaws close [m]; None with fewer than two."""
        return float(np.median(self._still_sds)) if self._still_sds else None

    @property
    def neighbour_sd(self) -> float | None:
        """Return the noise from how points stray from their neighbours [m]; None with too few points."""
        return None if self._neighbours is None else self._neighbours.sd

    def add(self, points: MeasuredPoints, tool: ToolState, *, still: bool, compare: bool) -> Float[np.ndarray, " 3"]:
        """Take one frame; return the mean displacement of the held points since the jaws closed [m], NaN if unknown.

        Args:
            points: the points, with identities.
            tool: the tool in this frame.
            still: whether the jaws have never closed yet.
            compare: whether to compare each point with its neighbours, which takes longest.
        """
        positions = self._by_track(points)
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
        if tool.held_tracks:
            self._held = np.flatnonzero(np.isin(self._ids, tool.held_tracks))
            unknown = set(tool.held_tracks) - set(self._ids.tolist())
            self.missing_tracks = tuple(sorted({*self.missing_tracks, *unknown}))
        else:
            from_tip = np.linalg.norm(positions - tool.position, axis=1)
            self._held = np.flatnonzero(from_tip <= tool.radius)
        held = positions[self._held]
        held = held[np.isfinite(held).all(axis=1)]
        self.held_at_closing = held.mean(axis=0) if len(held) else np.full(3, np.nan)
        if len(held):
            return float(np.linalg.norm(self.held_at_closing - tool.position))
        return nearest_distance(positions, tool.position)

    def _by_track(self, points: MeasuredPoints) -> Float[np.ndarray, "n 3"]:
        """Return positions by track, NaN where unseen; a track that is new gets its first position here."""
        assert points.track_id is not None
        if self.rest is None:
            self._ids, self.rest = points.track_id, points.positions.copy()
            self._neighbours = NeighbourNoise(self.rest)
            return points.positions
        if np.array_equal(points.track_id, self._ids):
            positions = points.positions
        else:
            row = {int(track): i for i, track in enumerate(points.track_id)}
            where = np.array([row.get(int(track), -1) for track in self._ids])
            padded = np.concatenate([points.positions, np.full((1, 3), np.nan)])
            positions = padded[where]
        first = np.isnan(self.rest[:, 0])
        self.rest[first] = positions[first]
        return positions


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
