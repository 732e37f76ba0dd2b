"""Triangulation of a nearly flat sheet of points, and its continuation beyond the measured points.

Delaunay triangulation in the best-fit plane, without the long and thin triangles of the outline. It is wrong for a
sheet that folds over itself in that plane, which needs measured faces.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import Delaunay, KDTree, QhullError

from .errors import MeshError
from .observation import MAX_PARTICLES

MIN_OUTLINE_SHAPE = 0.25
"""Twice the area over the longest edge squared below which an outline triangle is dropped (equilateral: 0.87)."""
CLEARANCE = 0.6
"""Distance to a measured point below which a lattice point is left out [spacings]."""
BORDER_CLEARANCE = 0.5
"""Distance to the outline below which a lattice point inside is left out [spacings]."""
END_SHARE, END_SPACINGS = 0.1, 1.5
"""Length of the end zone that gives the width of a strip: a share of the measured length, and at least so many
spacings, so that one unseen corner does not narrow the sheet."""


@dataclass(frozen=True, kw_only=True)
class SheetPlane:
    """Coordinates in a sheet: along an axis, across it, and above it."""

    centre: Float[np.ndarray, " 3"]
    """Origin of the coordinates in the world frame [m]."""
    axes: Float[np.ndarray, "3 3"]
    """Unit vectors along, across, above as rows; right-handed, `above` towards world +z."""

    @classmethod
    def through(cls, points: Float[np.ndarray, "m 3"], axis: Float[np.ndarray, " 3"] | None = None) -> "SheetPlane":
        """Return the best-fit plane of finite points; with an axis, the best one that contains it."""
        centre = points.mean(axis=0)
        rest = points - centre
        along = np.linalg.svd(rest, full_matrices=False)[2][0] if axis is None else axis
        across = np.linalg.svd(rest - np.outer(rest @ along, along), full_matrices=False)[2][0]
        if np.cross(along, across)[2] < 0:
            across = -across
        return cls(centre=centre, axes=np.stack([along, across, np.cross(along, across)]))

    def flatten(self, points: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 2"]:
        """Return the coordinates along and across of world points [m]."""
        return (points - self.centre) @ self.axes[:2].T

    def raise_up(self, flat: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 3"]:
        """Return the world points of coordinates in the plane [m]."""
        return self.centre + flat @ self.axes[:2]

    def along(self, station: float) -> float:
        """Return the coordinate along the axis of a station [m].

        A station is the world coordinate x, y or z, whichever the axis follows most closely, of a point on the centre
        line.
        """
        k = int(np.argmax(np.abs(self.axes[0])))
        return float((station - self.centre[k]) / self.axes[0, k])

    def beyond(self, points: Float[np.ndarray, "m 3"], station: float) -> Bool[np.ndarray, " m"]:
        """Return which points lie at a station or farther from the centre than it."""
        limit, along = self.along(station), (points - self.centre) @ self.axes[0]
        return along >= limit if limit > 0 else along <= limit


def triangulate(flat: Float[np.ndarray, "m 2"], longest_edge: float) -> Int[np.ndarray, "f 3"]:
    """Return Delaunay triangles of one orientation, without the long and thin ones of a ragged outline.

    Args:
        flat: points in the plane [m].
        longest_edge: length above which an edge's triangles are dropped [m].

    Raises:
        MeshError: fewer than three points, or all on one line.
    """
    try:
        faces = Delaunay(flat).simplices.astype(np.int64)
    except (QhullError, ValueError) as failure:
        raise MeshError(f"{len(flat)} points make no sheet: three that are not on one line are needed.") from failure
    corners = flat[faces]
    edges = corners - np.roll(corners, 1, axis=1)
    signed = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
    faces[signed < 0] = faces[signed < 0][:, ::-1]
    longest = np.sqrt((edges**2).sum(axis=2).max(axis=1))
    thin, short = np.abs(signed) < MIN_OUTLINE_SHAPE * longest**2, longest <= longest_edge
    faces, thin = faces[short], thin[short]
    while True:
        ordered = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        _, inverse, count = np.unique(ordered, axis=0, return_inverse=True, return_counts=True)
        drop = thin & (count[inverse.reshape(-1)].reshape(-1, 3) == 1).any(axis=1)
        if not drop.any():
            return faces
        faces, thin = faces[~drop], thin[~drop]


def extend(flat: Float[np.ndarray, "m 2"], *, begin: float, end: float, spacing: float) -> Float[np.ndarray, "k 2"]:
    """Return lattice points that continue a strip's outline along its axis, clear of the measured points.

    The width at either end is that of the measured points in the end zone (`END_SHARE`, `END_SPACINGS`).

    Args:
        flat: measured points, along and across [m].
        begin: coordinate along the axis at which the sheet begins [m].
        end: coordinate at which it ends [m].
        spacing: spacing of the lattice [m].

    Raises:
        MeshError: either end would need more than `MAX_PARTICLES` vertices.
    """
    first, last = flat[:, 0].min(), flat[:, 0].max()
    zone = max(END_SHARE * (last - first), END_SPACINGS * spacing)
    pieces = [np.empty((0, 2))]
    for edge, stop, in_zone in (
        (first, begin, flat[:, 0] <= first + zone),
        (last, end, flat[:, 0] >= last - zone),
    ):
        outward = -1.0 if stop == begin else 1.0
        length = outward * (stop - edge)
        if length <= 0:
            continue
        low, high = flat[in_zone, 1].min(), flat[in_zone, 1].max()
        _refuse_many(float(length), float(high - low), spacing)
        n_rows = max(1, round(length / (spacing * np.sqrt(3) / 2)))
        n_across = max(1, round((high - low) / spacing))
        for row in range(n_rows + 1):
            on_lattice = np.linspace(low, high, n_across + 1)
            shifted = np.concatenate([[low], 0.5 * (on_lattice[1:] + on_lattice[:-1]), [high]])
            across = on_lattice if (n_rows - row) % 2 == 0 else shifted
            pieces.append(np.column_stack([np.full(len(across), edge + outward * length * row / n_rows), across]))
    lattice = np.concatenate(pieces)
    return lattice[KDTree(flat).query(lattice)[0] >= CLEARANCE * spacing]


def fill_outline(
    flat: Float[np.ndarray, "m 2"], *, outline: Float[np.ndarray, "k 2"], spacing: float, clearance: float
) -> Float[np.ndarray, "a 2"]:
    """Return vertices on a polygon's border and a triangular lattice within it, clear of the measured points.

    Args:
        flat: measured points in the plane [m].
        outline: corners of the polygon, in turn [m].
        spacing: spacing of the vertices [m].
        clearance: distance to a measured point below which a vertex is left out [m].

    Raises:
        MeshError: the polygon would need more than `MAX_PARTICLES` vertices.
    """
    low, high = outline.min(axis=0), outline.max(axis=0)
    pitch = np.array([spacing, spacing * np.sqrt(3) / 2])
    _refuse_many(float(high[1] - low[1]), float(high[0] - low[0]), spacing)
    across, rows = np.ceil((high - low) / pitch) + 1
    row, column = np.mgrid[: int(rows), : int(across)]
    lattice = low + np.column_stack([(column + 0.5 * (row % 2)).ravel(), row.ravel()]) * pitch
    border = np.concatenate(
        [
            np.linspace(begin, end, max(1, round(float(np.linalg.norm(end - begin)) / spacing)), endpoint=False)
            for begin, end in zip(outline, np.roll(outline, -1, axis=0), strict=True)
        ]
    )
    inside = lattice[within(lattice, outline)]
    inside = inside[KDTree(border).query(inside)[0] >= BORDER_CLEARANCE * spacing]
    added = np.concatenate([border, inside])
    return added[KDTree(flat).query(added)[0] >= clearance]


def _refuse_many(length: float, width: float, spacing: float) -> None:
    """Refuse a lattice of more than `MAX_PARTICLES` vertices, before it is made."""
    rows, across = (float(np.ceil(each)) + 1 for each in (length / (spacing * 3**0.5 / 2), width / spacing))
    count = rows * across
    if not count <= MAX_PARTICLES:
        raise MeshError(
            f"a sheet of {width:.3g} x {length:.3g} m at a spacing of {spacing:.3g} m has about {count:.3g} vertices; "
            f"at most {MAX_PARTICLES} are allowed: give a larger spacing, or lengths in m."
        )


def within(points: Float[np.ndarray, "p 2"], outline: Float[np.ndarray, "k 2"]) -> Bool[np.ndarray, " p"]:
    """Return which points lie within a polygon, by the even-odd rule."""
    inside = np.zeros(len(points), bool)
    for (ax, ay), (bx, by) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if ay == by:
            continue
        crosses = (ay > points[:, 1]) != (by > points[:, 1])
        inside ^= crosses & (points[:, 0] < ax + (points[:, 1] - ay) * (bx - ax) / (by - ay))
    return inside
