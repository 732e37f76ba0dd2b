"""The estimator's own particles: a triangle mesh laid over the first stereo cloud.

Contour samples of the tissue mask, kept a little inside it so that their surroundings are tissue, plus a hexagonal
lattice, triangulated after Delaunay in the plane that fits the sheet best. Depth comes from a robust low-order
polynomial surface through the disparity, so a sheet must be smooth at rest. The reference's mesh is not used.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay

from jiggle_mj.camera import StereoCamera
from jiggle_mj.errors import PerceptionError

from ..ranges import refuse_many_particles
from .config import SheetMeshConfig
from .tissue_mask import MAX_SECOND_BLOB

MAX_SURFACE_SAMPLES = 20000
"""Most pixels that a surface is fitted to, which bounds the time."""
MAX_PLANE_SAMPLES = 4000
"""Most points that the sheet's plane is fitted to, which bounds the time."""
MIN_DISPARITY_SD = 0.01
"""Lower bound of the standard deviation of disparity [px]: no disparity is known better."""
MAD_TO_SD = 1.4826
"""Standard deviation of a normal distribution [median absolute deviation]."""
CAUCHY_SCALE = 2.0
"""Residual at which a sample has half its weight [standard deviations]."""
REWEIGHTINGS = 10
"""Iterations of reweighting; the weights change by less than 1 % after about six."""
PROJECTION_ITERATIONS = 6
"""Fixed-point iterations from the plane to the image."""
CONTOUR_SMOOTHING = 1.5
"""Standard deviation of the Gaussian on the distance to the contour, against steps of single pixels [px]."""
CORNER_TOLERANCE = 0.25
"""Distance of the contour from a polygon through its corners [spacing]."""
MIN_CONTOUR_GAP = 0.5
"""Smallest distance of two neighbouring particles on the contour [spacing]."""
MIN_LATTICE_DEPTH = 0.6
"""Smallest distance of the lattice's particles from the contour's [spacing]."""


@dataclass(frozen=True, kw_only=True)
class ImageMesh:
    """Mesh over the first image."""

    uvd: Float[np.ndarray, "n 3"]
    """Left pixel and disparity of each particle in the first frame [px]."""
    rest: Float[np.ndarray, "n 3"]
    """World position of each particle [m]."""
    faces: Int[np.ndarray, "f 3"]
    """Particles of each triangle, counter-clockwise as the camera sees them."""


def lay_mesh(
    mask: Bool[np.ndarray, "height width"],
    disparity: Float[np.ndarray, "height width"],
    camera: StereoCamera,
    *,
    spacing: float,
    config: SheetMeshConfig | None = None,
) -> ImageMesh:
    """Return particles and triangles over one connected sheet.

    Args:
        mask: pixels of the sheet.
        disparity: disparity of each pixel [px], NaN where unknown.
        camera: the calibrated pair.
        spacing: distance between neighbouring particles [m].
        config: settings of the mesh; the defaults if None.

    Raises:
        PerceptionError: no disparity on the tissue, too few or too many particles, or a mesh in several pieces.
    """
    config = config or SheetMeshConfig()
    surface = surface_through(mask, disparity, config)
    rows, columns = np.nonzero(mask)
    pick = slice(None, None, max(1, len(rows) // MAX_SURFACE_SAMPLES))
    cloud = camera.back_project(surface(np.stack([columns[pick], rows[pick]], axis=-1).astype(float)))
    frame = _PlaneFrame(cloud, camera, surface)

    pixel = _pixel_size(cloud, camera)
    outline = _outline(mask, config.inset * spacing / pixel, frame)
    _refuse_fine(outline, spacing)
    rim = _resample(outline, spacing, tolerance=CORNER_TOLERANCE * spacing)
    inner = _lattice(outline, spacing)
    flat = np.concatenate([rim, inner])
    if len(flat) < config.min_particles:
        raise PerceptionError(
            f"the sheet has room for {len(flat)} particles at a spacing of {spacing * 1e3:g} mm, at least "
            f"{config.min_particles} are needed; move the camera closer or lower the spacing."
        )
    flat, faces = _triangulate(flat, outline, spacing, config)
    uvd = frame.to_image(flat)
    return ImageMesh(uvd=uvd, rest=camera.back_project(uvd), faces=faces)


class DisparitySurface:
    """Polynomial d(u, v) through disparities, robust against mismatches.

    Iteratively reweighted least squares with Cauchy weights, their scale s from the median absolute residual. The
    degree is the one with the least robust Bayesian information criterion,

        sum_i c^2 log(1 + (r_i / c s)^2) + k log(m),   c = 2,

    with k coefficients, m samples and the scale s of the highest degree.
    """

    def __init__(
        self,
        pixels: Float[np.ndarray, "m 2"],
        disparity: Float[np.ndarray, " m"],
        config: SheetMeshConfig | None = None,
    ):
        highest = (config or SheetMeshConfig()).max_degree
        self._middle, self._scale = pixels.mean(axis=0), pixels.std(axis=0).max()
        fits = [self._fit(pixels, disparity, degree) for degree in range(1, highest + 1)]
        scale = _scale_of(fits[-1][1])
        criteria = [
            _cauchy_cost(residual, scale) + len(coefficients) * np.log(len(residual)) for coefficients, residual in fits
        ]
        self.degree = int(np.argmin(criteria)) + 1
        """Degree of the polynomial."""
        self._coefficients = fits[self.degree - 1][0]

    def __call__(self, pixels: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 3"]:
        """Return pixels with their fitted disparity [px]."""
        disparity = self._basis(pixels, self.degree) @ self._coefficients
        return np.concatenate([pixels, disparity[:, None]], axis=-1)

    def _basis(self, pixels: Float[np.ndarray, "m 2"], degree: int) -> Float[np.ndarray, "m k"]:
        """Return the monomials of up to a degree in the normalised pixels."""
        x, y = ((pixels - self._middle) / self._scale).T
        return np.stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)], axis=-1)

    def _fit(
        self, pixels: Float[np.ndarray, "m 2"], disparity: Float[np.ndarray, " m"], degree: int
    ) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " m"]]:
        """Return the coefficients and residuals of one degree."""
        basis, weight = self._basis(pixels, degree), np.ones(len(disparity))
        coefficients, residual = np.zeros(basis.shape[1]), disparity
        for _ in range(REWEIGHTINGS):
            root = np.sqrt(weight)
            coefficients = np.linalg.lstsq(basis * root[:, None], disparity * root, rcond=None)[0]
            residual = disparity - basis @ coefficients
            weight = 1 / (1 + (residual / (CAUCHY_SCALE * _scale_of(residual))) ** 2)
        return coefficients, residual


def _cauchy_cost(residual: Float[np.ndarray, " m"], scale: float) -> float:
    """Return the sum of the robust cost over all samples."""
    return np.sum(CAUCHY_SCALE**2 * np.log1p((residual / (CAUCHY_SCALE * scale)) ** 2))


def _scale_of(residual: Float[np.ndarray, " m"]) -> float:
    """Return a robust standard deviation, from the median absolute residual [px]."""
    return max(MAD_TO_SD * float(np.median(np.abs(residual))), MIN_DISPARITY_SD)


def surface_through(
    mask: Bool[np.ndarray, "height width"], disparity: Float[np.ndarray, "height width"], config: SheetMeshConfig
) -> DisparitySurface:
    """Return the surface through a dense disparity [px] on the tissue.

    Raises:
        PerceptionError: less than `SheetMeshConfig.min_matched` of the tissue's pixels have a disparity.
    """
    rows, columns = np.nonzero(mask & (np.nan_to_num(disparity) > 0))
    share = len(rows) / max(int(mask.sum()), 1)
    if share < config.min_matched:
        raise PerceptionError(
            f"only {share:.0%} of the tissue has a positive disparity, at least {config.min_matched:.0%} is needed: "
            "are the left and right cameras swapped, the pair not rectified, the tissue without texture, or too near?"
        )
    pick = slice(None, None, max(1, len(rows) // MAX_SURFACE_SAMPLES))
    pixels = np.stack([columns[pick], rows[pick]], axis=-1).astype(float)
    return DisparitySurface(pixels, disparity[rows[pick], columns[pick]].astype(float), config)


class _PlaneFrame:
    """Coordinates in the plane that fits the sheet best [m], with maps to the image and back."""

    def __init__(self, cloud: Float[np.ndarray, "m 3"], camera: StereoCamera, surface: DisparitySurface):
        self._camera, self._surface = camera, surface
        self._origin = np.median(cloud, axis=0)
        _, _, axes = np.linalg.svd(
            cloud[:: max(1, len(cloud) // MAX_PLANE_SAMPLES)] - self._origin, full_matrices=False
        )
        normal = axes[2] * np.sign(axes[2] @ (camera.T_world_camera[:3, 3] - self._origin))
        right = camera.T_world_camera[:3, 0]
        first = right - normal * (normal @ right)
        first /= np.linalg.norm(first)
        self._axes = np.stack([first, np.cross(normal, first)])

    def from_image(self, pixels: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 2"]:
        """Return pixels in the plane [m], through the fitted surface."""
        return (self._camera.back_project(self._surface(pixels)) - self._origin) @ self._axes.T

    def to_image(self, flat: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 3"]:
        """Return points of the plane as pixel and disparity [px], by fixed-point iteration on the surface's height."""
        guess = flat
        for _ in range(PROJECTION_ITERATIONS):
            pixels = self._camera.project(self._origin + guess @ self._axes)[:, :2]
            guess = guess + flat - self.from_image(pixels)
        return self._surface(self._camera.project(self._origin + guess @ self._axes)[:, :2])


def _pixel_size(cloud: Float[np.ndarray, "m 3"], camera: StereoCamera) -> float:
    """Return the size of a pixel at the sheet's median depth [m]."""
    depth = np.median((cloud - camera.T_world_camera[:3, 3]) @ camera.T_world_camera[:3, 2])
    return float(depth / camera.focal[0])


def _outline(mask: Bool[np.ndarray, "height width"], inset: float, frame: _PlaneFrame) -> Float[np.ndarray, "m 2"]:
    """Return the sheet's smoothed contour, `inset` pixels inside the mask, as a closed polygon in the plane [m].

    Raises:
        PerceptionError: the tissue is too thin, or its parts are joined by less than the inset.
    """
    framed = np.pad(mask.astype(np.uint8), 1)
    filled = np.zeros_like(framed)
    contours, _ = cv2.findContours(framed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(filled, [max(contours, key=cv2.contourArea)], -1, 1, cv2.FILLED)
    depth = cv2.GaussianBlur(
        cv2.distanceTransform(filled, cv2.DIST_L2, cv2.DIST_MASK_PRECISE), (0, 0), CONTOUR_SMOOTHING
    )
    contours, _ = cv2.findContours((depth > inset).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        raise PerceptionError("the tissue is thinner than the mesh's inset from its rim; lower the spacing.")
    largest, *others = sorted(contours, key=cv2.contourArea, reverse=True)
    if others and cv2.contourArea(others[0]) > MAX_SECOND_BLOB * cv2.contourArea(largest):
        raise PerceptionError(
            "two disconnected sheets in view: the tissue's parts are joined by less than the mesh's spacing; only one "
            "sheet can be tracked: cover the other, or pass a mask that leaves it out."
        )
    contour = largest[:, 0, :].astype(float) - 1
    return frame.from_image(contour)


def _refuse_fine(outline: Float[np.ndarray, "m 2"], spacing: float) -> None:
    """Refuse a spacing [m] that would give more particles than can be estimated, before any is made."""
    x, y = outline.T
    area = abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2
    low, high = outline.min(axis=0), outline.max(axis=0)
    size = " x ".join(f"{side:.3g}" for side in high - low)
    refuse_many_particles(
        area / (spacing**2 * np.sqrt(3) / 2), f"a sheet of {size} m at a spacing of {spacing * 1e3:g} mm"
    )


def _resample(outline: Float[np.ndarray, "m 2"], spacing: float, *, tolerance: float) -> Float[np.ndarray, "k 2"]:
    """Return points along a closed polygon, about `spacing` [m] apart, its corners among them."""
    scaled = (outline / tolerance).astype(np.float32)
    corners = cv2.approxPolyDP(scaled[:, None], 1.0, True)[:, 0]
    where = np.sort([int(np.argmin(np.sum((scaled - corner) ** 2, axis=1))) for corner in corners])
    points = []
    for start, stop in zip(where, np.roll(where, -1), strict=True):
        index = np.arange(start, stop + 1 if stop > start else stop + len(outline) + 1) % len(outline)
        part = outline[index]
        length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(part, axis=0), axis=1))])
        at = np.linspace(0, length[-1], max(1, round(length[-1] / spacing)) + 1)[:-1]
        points.append(np.stack([np.interp(at, length, part[:, axis]) for axis in range(2)], axis=-1))
    points = np.concatenate(points)
    gap = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1)
    return points[gap > MIN_CONTOUR_GAP * spacing]


def _lattice(outline: Float[np.ndarray, "m 2"], spacing: float) -> Float[np.ndarray, "k 2"]:
    """Return the points of a hexagonal lattice inside a polygon, at least `MIN_LATTICE_DEPTH` from it [m]."""
    low, high = outline.min(axis=0), outline.max(axis=0)
    rise = spacing * np.sqrt(3) / 2
    n_rows, n_columns = (np.ceil((high - low)[::-1] / (rise, spacing)) + 1).astype(int)
    row, column = np.mgrid[:n_rows, :n_columns]
    points = np.stack([column + 0.5 * (row % 2), row], axis=-1).reshape(-1, 2) * (spacing, rise)
    points += (low + high) / 2 - points.mean(axis=0)
    return points[_depth_inside(points, outline, spacing) > MIN_LATTICE_DEPTH * spacing]


def _depth_inside(
    points: Float[np.ndarray, "k 2"], outline: Float[np.ndarray, "m 2"], unit: float
) -> Float[np.ndarray, " k"]:
    """Return the distance to a polygon [m], negative outside; `unit` [m] sets the scale of the float32 arithmetic."""
    polygon = (outline / unit).astype(np.float32)[:, None]
    return unit * np.array([cv2.pointPolygonTest(polygon, (float(x), float(y)), True) for x, y in points / unit])


def _triangulate(
    points: Float[np.ndarray, "n 2"], outline: Float[np.ndarray, "m 2"], spacing: float, config: SheetMeshConfig
) -> tuple[Float[np.ndarray, "k 2"], Int[np.ndarray, "f 3"]]:
    """Return Delaunay triangles inside the outline without needles, and the particles that have a triangle.

    Raises:
        PerceptionError: the triangles form several pieces.
    """
    faces = Delaunay(points).simplices
    corner = points[faces]
    edge = np.roll(corner, -1, axis=1) - corner
    cross = edge[:, 0, 0] * edge[:, 1, 1] - edge[:, 0, 1] * edge[:, 1, 0]
    faces[cross < 0] = faces[cross < 0][:, ::-1]
    length = np.linalg.norm(edge, axis=2)
    sine = np.abs(cross) / (length * np.roll(length, -1, axis=1)).max(axis=1)  # between the two longest sides
    inside = _depth_inside(corner.mean(axis=1), outline, spacing) > 0
    blunt = sine > np.sin(np.radians(config.min_angle))
    faces = faces[inside & blunt & (length.max(axis=1) < config.max_edge * spacing)]
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3)
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = coo_array((np.ones(len(edges)), edges.T), shape=(len(used), len(used)))
    pieces, label = connected_components(graph, directed=False)
    if pieces > 1:
        raise PerceptionError(
            f"the sheet's mesh falls into {pieces} pieces of {np.bincount(label).tolist()} particles; show one "
            "connected sheet, wider than two spacings everywhere, or lower the spacing."
        )
    return points[used], faces
