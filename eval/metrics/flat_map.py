"""The sheet at rest as a map: flat coordinates, a field over its triangles as a grid, and outlines of vertex sets.

Maps are for pictures; no figure is computed from one.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from .detection_metrics import edges

MIN_LEVEL_COSINE = np.cos(np.radians(30))
"""Smallest vertical part of a level sheet's unit normal: such a sheet is drawn in the world's own x and y."""
GRID_CELLS = 150
"""Grid cells along a map's longer side."""


@dataclass(frozen=True, kw_only=True)
class Plane:
    """An orthonormal frame in which the sheet is drawn."""

    origin: Float[np.ndarray, " 3"]
    """Origin in the world [m]."""
    axes: Float[np.ndarray, "2 3"]
    """Unit vectors of the two axes."""
    names: tuple[str, str]
    """Names of the two axes."""

    def flatten(self, points: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 2"]:
        """Return coordinates in the plane [m]."""
        return (points - self.origin) @ self.axes.T


def plane_of(rest: Float[np.ndarray, "n 3"]) -> Plane:
    """Return world x and y for a sheet that lies about level, its two principal axes about its centre otherwise."""
    centre = rest.mean(axis=0)
    axes = np.linalg.svd(rest - centre, full_matrices=False)[2]
    if abs(axes[2, 2]) > MIN_LEVEL_COSINE:
        return Plane(origin=np.zeros(3), axes=np.eye(3)[:2], names=("x", "y"))
    signs = np.sign(axes[np.arange(2), np.abs(axes[:2]).argmax(axis=1)])
    return Plane(origin=centre, axes=axes[:2] * signs[:, None], names=("along", "across"))


def grid_of(
    flat: Float[np.ndarray, "n 2"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Float[np.ndarray, " w"], Float[np.ndarray, " h"], Int[np.ndarray, "h w 3"], Float[np.ndarray, "h w 3"]]:
    """Return cell centres of a grid over the sheet, and for each the corners and weights of its triangle.

    Weights are NaN outside the sheet. Where triangles overlap in the map the last one counts.
    """
    low, high = flat.min(axis=0), flat.max(axis=0)
    cell = (high - low).max() / GRID_CELLS
    shape = np.maximum(1, np.ceil((high - low) / cell)).astype(int)
    x, y = (low[k] + cell * (np.arange(shape[k]) + 0.5) for k in range(2))
    corners = np.zeros((len(y), len(x), 3), dtype=int)
    weights = np.full((len(y), len(x), 3), np.nan)
    for face in faces:
        a, b, c = flat[face]
        start = np.searchsorted(x, min(a[0], b[0], c[0])), np.searchsorted(y, min(a[1], b[1], c[1]))
        stop = np.searchsorted(x, max(a[0], b[0], c[0])), np.searchsorted(y, max(a[1], b[1], c[1]))
        area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
        if area == 0:
            continue
        u, v = np.meshgrid(x[start[0] : stop[0]] - a[0], y[start[1] : stop[1]] - a[1])
        second = (u * (c[1] - a[1]) - v * (c[0] - a[0])) / area
        third = (v * (b[0] - a[0]) - u * (b[1] - a[1])) / area
        inside = (second >= 0) & (third >= 0) & (second + third <= 1)
        block = slice(start[1], stop[1]), slice(start[0], stop[0])
        corners[block][inside] = face
        weights[block][inside] = np.stack([1 - second - third, second, third], axis=-1)[inside]
    return x, y, corners, weights


def outline(
    flat: Float[np.ndarray, "n 2"], faces: Int[np.ndarray, "f 3"], chosen: Bool[np.ndarray, " n"]
) -> Float[np.ndarray, "s 2 2"]:
    """Return segments around the chosen vertices, half an edge away from them, closed along the sheet's border."""
    segments = []
    for face in faces[chosen[faces].any(axis=1) & ~chosen[faces].all(axis=1)]:
        inside = chosen[face]
        odd = int(np.flatnonzero(inside if inside.sum() == 1 else ~inside)[0])
        tip, others = flat[face[odd]], flat[np.delete(face, odd)]
        segments.append((tip + others) / 2)
    count = {}
    for face in faces:
        for k in range(3):
            edge = tuple(sorted((int(face[k]), int(face[(k + 1) % 3]))))
            count[edge] = count.get(edge, 0) + 1
    for a, b in (edge for edge, times in count.items() if times == 1 and chosen[list(edge)].any()):
        middle = (flat[a] + flat[b]) / 2
        segments.append(np.stack([flat[a] if chosen[a] else middle, flat[b] if chosen[b] else middle]))
    return np.array(segments).reshape(-1, 2, 2)


def spacing(rest: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]) -> float:
    """Return the median edge length [m], which is the width of one ring of dilation."""
    pairs = edges(faces)
    return float(np.median(np.linalg.norm(rest[pairs[:, 0]] - rest[pairs[:, 1]], axis=1)))
