"""Mesh over clouds of the sheet at rest, whose points have no identities.

What lies alone is not of the sheet: around a point of the sheet there are as many others as around most, and around one
at a corner a quarter as many.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from jiggle_mj.errors import PerceptionError
from jiggle_mj.estimate import Sheet
from jiggle_mj.mesh_checks import check_mesh
from jiggle_mj.observation import MeasuredPoints
from jiggle_mj.sheet_triangulation import SheetPlane, triangulate

from .config import CloudTrackerConfig

MAX_POINTS = 20_000
"""Most points of each cloud that are looked at."""
MIN_DENSITY = 0.2
"""Smallest number of points within a spacing of one that is of the sheet [median of all points]."""

MIN_WIDTH = 0.5
"""Smallest width of what counts as a sheet [spacing]: narrower points lie along a line."""


def lay_mesh(still: list[MeasuredPoints], *, spacing: float, config: CloudTrackerConfig | None = None) -> Sheet:
    """Return a mesh over clouds of the sheet at rest.

    Its particles are points of the largest cloud, thinned from the outline inwards, at the median height of all clouds'
    points around them.

    Args:
        still: clouds of the sheet at rest.
        spacing: distance between neighbouring particles [m].
        config: settings of the mesh; the defaults if None.

    Raises:
        PerceptionError: the sheet is too small for the spacing, or the points lie along a line.
        MeshError: the points show two sheets.
    """
    config = config or CloudTrackerConfig()
    clouds = [evenly(points.positions[np.isfinite(points.positions).all(axis=1)], MAX_POINTS) for points in still]
    points, cloud = np.concatenate(clouds), np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds])
    points, cloud = points[dense := is_dense(points, spacing)], cloud[dense]
    largest = points[cloud == np.bincount(cloud, minlength=1).argmax()]
    if len(largest) < config.min_points:
        raise PerceptionError(
            f"the clouds at rest have {len(largest)} points at most; a sheet needs {config.min_points}."
        )
    length, width = np.sqrt(12 * np.linalg.eigvalsh(np.cov(points.T))[:0:-1])  # those of a rectangle
    if not width > MIN_WIDTH * spacing:
        raise PerceptionError(
            f"the clouds at rest are about {1e3 * length:.1f} by {1e3 * width:.1f} mm; a sheet is wider than half "
            f"its spacing, {spacing * 1e3:.1f} mm (are x, y and z the right columns?)."
        )
    plane = SheetPlane.through(points)
    flat = plane.flatten(largest)
    flat = np.concatenate([flat[on_outline := outline(flat, spacing)], flat[~on_outline]])
    chosen = flat[thinned(flat, config.min_gap * spacing)]
    if len(chosen) < config.min_points:
        raise PerceptionError(
            f"the clouds at rest give {len(chosen)} particles at a spacing of {spacing * 1e3:.1f} mm; a sheet needs "
            f"{config.min_points} (record more points, or choose a smaller EstimatorConfig.spacing)."
        )
    faces = triangulate(chosen, config.max_edge * spacing)
    used, faces = np.unique(faces, return_inverse=True)
    around = KDTree(plane.flatten(points)).query_ball_point(chosen[used], config.neighbourhood * spacing)
    above = (points - plane.centre) @ plane.axes[2]
    height = np.array([np.median(above[near]) for near in around])
    rest = plane.raise_up(chosen[used]) + height[:, None] * plane.axes[2]
    check_mesh(rest, faces.reshape(-1, 3))
    return Sheet(rest=rest, faces=faces.reshape(-1, 3))


def evenly(cloud: Float[np.ndarray, "m 3"], most: int) -> Float[np.ndarray, "q 3"]:
    """Return at most so many points of a cloud, evenly chosen in their order."""
    return cloud[np.linspace(0, len(cloud), min(len(cloud), most), endpoint=False).astype(int)]


def is_dense(points: Float[np.ndarray, "m 3"], radius: float) -> Bool[np.ndarray, " m"]:
    """Return which points have enough others within the radius [m] to be of the sheet."""
    if not len(points):
        return np.zeros(0, bool)
    count = np.asarray(KDTree(points).query_ball_point(points, radius, return_length=True, workers=-1))
    return count >= MIN_DENSITY * np.median(count)


def outline(flat: Float[np.ndarray, "m 2"], spacing: float) -> Bool[np.ndarray, " m"]:
    """Return which points lie on the outline of the sheet; gaps up to the spacing [m] are no outline."""
    edges = np.sort(triangulate(flat, spacing)[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    pairs, count = np.unique(edges, axis=0, return_counts=True)
    on_outline = np.zeros(len(flat), bool)
    on_outline[pairs[count == 1]] = True
    return on_outline


def thinned(flat: Float[np.ndarray, "m 2"], spacing: float) -> list[int]:
    """Return the indices of points of which no two are nearer than the spacing [m], chosen in order."""
    near = KDTree(flat).query_ball_point(flat, spacing)
    free, chosen = np.ones(len(flat), bool), []
    for i, around in enumerate(near):
        if free[i]:
            chosen.append(i)
            free[around] = False
    return chosen
