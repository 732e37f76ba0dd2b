"""The corners of a sheet that goes on beyond the measured points, in its plane: those given, or a rectangle around."""

import numpy as np
from jaxtyping import Float

from ..errors import RecordingError
from ..sheet_triangulation import SheetPlane, within
from .recording_toml import Margin

MIN_LEVEL = 0.5
"""Cosine of the steepest slope at which [x, y] names a place on the sheet: 60 degrees."""
MAX_OUTSIDE = 0.05
"""Share of the points that may lie outside a given outline: single wild points do, those of a sheet do not."""


def sheet_outline(
    plane: SheetPlane, flat: Float[np.ndarray, "m 2"], margin: Margin, *, spacing: float
) -> Float[np.ndarray, "k 2"]:
    """Return the sheet's corners in its plane [m].

    Args:
        plane: of the measured points.
        flat: these points in it [m].
        margin: a width around the points, or corners.
        spacing: of the points [m]; those no farther outside are on the outline.

    Raises:
        RecordingError: the sheet is too steep for the corners, their polygon crosses itself, or points lie outside it.
    """
    if margin.outline is None:
        assert margin.width is not None
        (left, low), (right, high) = flat.min(axis=0) - margin.width, flat.max(axis=0) + margin.width
        return np.array([[left, low], [right, low], [right, high], [left, high]])
    corners = plane.flatten(_in_space(plane, margin.outline))
    crossing = _crossing(corners)
    if crossing is not None:
        raise RecordingError(
            f"[mesh] outline crosses itself: edges from corners {crossing[0]} and {crossing[1]} (from 0) intersect; "
            "give the corners in turn."
        )
    outside = ~within(flat, corners) & (_from_edges(flat, corners) > spacing)
    if outside.mean() > MAX_OUTSIDE:
        raise RecordingError(
            f"[mesh] outline leaves out {int(outside.sum())} of {len(flat)} points; it must surround what is seen: are "
            "its corners in metres, in the world?"
        )
    return corners


def _in_space(plane: SheetPlane, outline: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3"]:
    """Return corners of which z may be NaN, then in the sheet's plane [m]."""
    corners, above = outline.copy(), plane.axes[2]
    if np.isnan(corners[:, 2]).any():
        if abs(above[2]) < MIN_LEVEL:
            raise RecordingError("[mesh] outline needs corners [x, y, z]: the sheet stands too steep for [x, y].")
        offset = (corners[:, :2] - plane.centre[:2]) @ above[:2]
        corners[:, 2] = plane.centre[2] - offset / above[2]
    return corners


def _crossing(corners: Float[np.ndarray, "k 2"]) -> tuple[int, int] | None:
    """Return the corners at which two edges that cross begin; None where none do."""
    begin, end = corners, np.roll(corners, -1, axis=0)
    apart = _side(begin, end, begin) * _side(begin, end, end) < 0
    first, second = np.nonzero(apart & apart.T)
    return (int(first[0]), int(second[0])) if len(first) else None


def _side(
    begin: Float[np.ndarray, "k 2"], end: Float[np.ndarray, "k 2"], places: Float[np.ndarray, "p 2"]
) -> Float[np.ndarray, "k p"]:
    """Return on which side of each edge each place is: 1, -1, or 0 on its line."""
    along, to = (end - begin)[:, np.newaxis], places - begin[:, np.newaxis]
    return np.sign(along[..., 0] * to[..., 1] - along[..., 1] * to[..., 0])


def _from_edges(places: Float[np.ndarray, "p 2"], corners: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, " p"]:
    """Return the distance of each place from the nearest edge [m]."""
    distance = np.full(len(places), np.inf)
    for begin, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along, to = end - begin, places - begin
        share = np.clip(to @ along / max(float(along @ along), 1e-300), 0, 1)
        distance = np.minimum(distance, np.linalg.norm(to - share[:, np.newaxis] * along, axis=1))
    return distance
