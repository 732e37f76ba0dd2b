"""Measured points and the noise of points and images: what the estimator is given instead of the truth.

`particles` are the mesh's vertices in a shuffled order that does not reveal the mesh. `points` are material points
between them, spread uniformly. Each track id means one material point for the whole run. A `cloud` has no identities:
its points are drawn again in each frame.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jiggle_mj.observation import MeasuredPoints, StereoPair

from ..tissue.mesh import Triangulation, lattice

POINT_JITTER = 0.25
"""Largest displacement of a material point from its lattice position, in lattice spacings."""
EDGE_MARGIN = 0.05
"""Smallest distance of a material point from the sheet's edge, in lattice spacings."""
INSIDE_TOLERANCE = 1e-9
"""Barycentric coordinate below 0 down to which a point still lies inside its triangle; rounding is smaller."""


@dataclass(frozen=True, kw_only=True)
class Tracks:
    """Material points, each at fixed barycentric coordinates in a triangle."""

    corners: Int[np.ndarray, "m 3"]
    """Vertices of each point's triangle."""
    weights: Float[np.ndarray, "m 3"]
    """Barycentric coordinates; each row sums to 1."""

    def positions(self, vertices: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
        """Return the positions of the points for these positions of the vertices [m]."""
        return np.einsum("mk,mkd->md", self.weights, vertices[self.corners])


def vertex_tracks(sheet: Triangulation, *, rng: np.random.Generator) -> Tracks:
    """Return tracks of the vertices themselves, shuffled."""
    order = rng.permutation(len(sheet.vertices))
    return Tracks(corners=np.repeat(order[:, None], 3, axis=1), weights=np.tile([1.0, 0.0, 0.0], (len(order), 1)))


def material_tracks(sheet: Triangulation, *, n_points: int, rng: np.random.Generator) -> Tracks:
    """Return about `n_points` tracks on a jittered triangular lattice, shuffled; they do not coincide with vertices."""
    low, high = sheet.vertices.min(axis=0), sheet.vertices.max(axis=0)
    size = high - low
    spacing = float(np.sqrt(size.prod() / (n_points * np.sqrt(0.75))))
    places = lattice((float(size[0]), float(size[1])), spacing) + (low + high) / 2
    places = places + POINT_JITTER * spacing * rng.uniform(-1, 1, places.shape)
    places = rng.permutation(np.clip(places, low + EDGE_MARGIN * spacing, high - EDGE_MARGIN * spacing))
    tracks = locate(sheet, places)
    inside = tracks.weights.min(axis=1) > -INSIDE_TOLERANCE
    return Tracks(corners=tracks.corners[inside], weights=tracks.weights[inside])


def surface_points(sheet: Triangulation, *, n_points: int, rng: np.random.Generator) -> Tracks:
    """Return random points of the sheet, uniform over its area at rest."""
    a, b, c = (sheet.vertices[sheet.faces[:, k]] for k in range(3))
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    area = np.abs(ux * vy - uy * vx)
    triangle = rng.choice(len(sheet.faces), n_points, p=area / area.sum())
    return Tracks(corners=sheet.faces[triangle], weights=rng.dirichlet(np.ones(3), n_points))


def slide(tracks: Tracks, sheet: Triangulation, displacement: Float[np.ndarray, " 2"]) -> Tracks:
    """Return the tracks after each slid over the sheet by a displacement [m], at most to the sheet's edge."""
    places = np.einsum("mk,mkd->md", tracks.weights, sheet.vertices[tracks.corners]) + displacement
    return locate(sheet, np.clip(places, sheet.vertices.min(axis=0), sheet.vertices.max(axis=0)))


def locate(sheet: Triangulation, places: Float[np.ndarray, "m 2"]) -> Tracks:
    """Return the material points at tissue coordinates [m]; beyond the outline the nearest triangle is extended."""
    weights = barycentric(sheet, places)
    triangle = weights.min(axis=2).argmax(axis=1)
    return Tracks(corners=sheet.faces[triangle], weights=weights[np.arange(len(places)), triangle])


def barycentric(sheet: Triangulation, places: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m f 3"]:
    """Return the barycentric coordinates of every place in every triangle."""
    a, b, c = (sheet.vertices[sheet.faces[:, k]] for k in range(3))
    inverse = np.linalg.inv(np.stack([b - a, c - a], axis=2))
    inner = np.einsum("fij,mfj->mfi", inverse, places[:, None] - a)
    return np.concatenate([1 - inner.sum(axis=2, keepdims=True), inner], axis=2)


def add_point_noise(
    positions: Float[np.ndarray, "m 3"],
    *,
    sd: float,
    rng: np.random.Generator,
    tracked: bool,
    smooth: Float[np.ndarray, "m 3"] | None = None,
    smooth_sd: float = 0.0,
    smooth_length: float | None = None,
) -> MeasuredPoints:
    """Return measured points: positions plus white noise of standard deviation `sd` [m] plus the given smooth noise.

    The result states the standard deviation of both noises together, and of the smooth one with its range [m].
    """
    noisy = positions + sd * rng.standard_normal(positions.shape)
    noisy = noisy if smooth is None else noisy + smooth
    total_sd = float(np.hypot(sd, smooth_sd))
    return MeasuredPoints(
        positions=noisy,
        track_id=np.arange(len(positions)) if tracked else None,
        sd=total_sd,
        smooth_sd=smooth_sd,
        smooth_length=smooth_length if smooth_sd else None,
    )


def smooth_factor(sheet: Triangulation, *, sd: float, length: float) -> Float[np.ndarray, "n n"]:
    """Return L of the smooth noise L z at the vertices [m], with z white.

    Its covariance is sd^2 exp(-d^2 / (2 length^2)), with d the distance over the sheet at rest.
    """
    squared = np.sum((sheet.vertices[:, None] - sheet.vertices[None]) ** 2, axis=2)
    kernel = np.exp(-0.5 * squared / length**2)
    values, vectors = np.linalg.eigh(kernel)
    return sd * vectors * np.sqrt(np.maximum(values, 0))


def add_image_noise(pair: StereoPair, *, sd: float, rng: np.random.Generator) -> StereoPair:
    """Return the images plus white noise of standard deviation `sd` [grey levels] in each channel, rounded."""

    def noisy(image: np.ndarray) -> np.ndarray:
        draw = rng.standard_normal(image.shape, dtype=np.float32)
        return np.clip(np.round(image + np.float32(sd) * draw), 0, 255).astype(np.uint8)

    return StereoPair(left=noisy(pair.left), right=noisy(pair.right))
