"""What the estimator is given instead of the truth: noisy particles, noisy material points, noisy clouds, noisy images.

`particles` are the mesh's vertices in a shuffled order that says nothing of the mesh; `points` are material points
between them, spread evenly. Each track id means one material point for the whole run. A `cloud` has no identities:
its points are other ones in each frame.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from jiggle_mj.observation import MeasuredPoints, StereoPair

from ..tissue.mesh import Triangulation, lattice

POINT_JITTER = 0.25
"""Largest displacement of a material point from its lattice place, in lattice spacings."""


@dataclass(frozen=True, kw_only=True)
class Tracks:
    """Material points as fixed mixtures of three vertices each."""

    corners: Int[np.ndarray, "m 3"]
    """Vertices of the triangle."""
    weights: Float[np.ndarray, "m 3"]
    """Barycentric, rows sum to one."""

    def positions(self, vertices: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
        """Where the points are [m]."""
        return np.einsum("mk,mkd->md", self.weights, vertices[self.corners])


def vertex_tracks(sheet: Triangulation, *, rng: np.random.Generator) -> Tracks:
    """The vertices themselves, shuffled."""
    order = rng.permutation(len(sheet.vertices))
    return Tracks(corners=np.repeat(order[:, None], 3, axis=1), weights=np.tile([1.0, 0.0, 0.0], (len(order), 1)))


def material_tracks(sheet: Triangulation, *, n_points: int, rng: np.random.Generator) -> Tracks:
    """About `n_points` points on a jittered triangular lattice, none of them a vertex on purpose, shuffled."""
    low, high = sheet.vertices.min(axis=0), sheet.vertices.max(axis=0)
    size = high - low
    spacing = float(np.sqrt(size.prod() / (n_points * np.sqrt(0.75))))
    places = lattice((float(size[0]), float(size[1])), spacing) + (low + high) / 2
    places = places + POINT_JITTER * spacing * rng.uniform(-1, 1, places.shape)
    places = rng.permutation(np.clip(places, low + 0.05 * spacing, high - 0.05 * spacing))
    found = located(sheet, places)
    kept = found.weights.min(axis=1) > -1e-9
    return Tracks(corners=found.corners[kept], weights=found.weights[kept])


def surface_points(sheet: Triangulation, *, n_points: int, rng: np.random.Generator) -> Tracks:
    """Points anywhere on the sheet, evenly by its area at rest."""
    a, b, c = (sheet.vertices[sheet.faces[:, k]] for k in range(3))
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    area = np.abs(ux * vy - uy * vx)
    triangle = rng.choice(len(sheet.faces), n_points, p=area / area.sum())
    return Tracks(corners=sheet.faces[triangle], weights=rng.dirichlet(np.ones(3), n_points))


def slid(tracks: Tracks, sheet: Triangulation, by: Float[np.ndarray, " 2"]) -> Tracks:
    """The same tracks on other material: each has slid over the sheet by as much [m], at most to its edge."""
    places = np.einsum("mk,mkd->md", tracks.weights, sheet.vertices[tracks.corners]) + by
    return located(sheet, np.clip(places, sheet.vertices.min(axis=0), sheet.vertices.max(axis=0)))


def located(sheet: Triangulation, places: Float[np.ndarray, "m 2"]) -> Tracks:
    """The material at places in the plane; beyond the outline the nearest triangle is continued."""
    weights = barycentric(sheet, places)
    triangle = weights.min(axis=2).argmax(axis=1)
    return Tracks(corners=sheet.faces[triangle], weights=weights[np.arange(len(places)), triangle])


def barycentric(sheet: Triangulation, places: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m f 3"]:
    """Coordinates of every place in every triangle."""
    a, b, c = (sheet.vertices[sheet.faces[:, k]] for k in range(3))
    inverse = np.linalg.inv(np.stack([b - a, c - a], axis=2))
    inner = np.einsum("fij,mfj->mfi", inverse, places[:, None] - a)
    return np.concatenate([1 - inner.sum(axis=2, keepdims=True), inner], axis=2)


def measure(
    positions: Float[np.ndarray, "m 3"],
    *,
    sd: float,
    rng: np.random.Generator,
    tracked: bool,
    smooth: Float[np.ndarray, "m 3"] | None = None,
    smooth_sd: float = 0.0,
) -> MeasuredPoints:
    """Add white noise of standard deviation `sd` [m] to each coordinate, and the smooth noise that is given."""
    noisy = positions + sd * rng.standard_normal(positions.shape)
    noisy = noisy if smooth is None else noisy + smooth
    stated = float(np.hypot(sd, smooth_sd))
    return MeasuredPoints(positions=noisy, track_id=np.arange(len(positions)) if tracked else None, sd=stated)


def smooth_factor(sheet: Triangulation, *, sd: float, length: float) -> Float[np.ndarray, "n n"]:
    """L of the noise L z at the vertices [m] with z white: covariance sd^2 exp(-d^2 / 2 length^2), d over the sheet."""
    squared = np.sum((sheet.vertices[:, None] - sheet.vertices[None]) ** 2, axis=2)
    kernel = np.exp(-0.5 * squared / length**2)
    values, vectors = np.linalg.eigh(kernel)
    return sd * vectors * np.sqrt(np.maximum(values, 0))


def add_image_noise(pair: StereoPair, *, sd: float, rng: np.random.Generator) -> StereoPair:
    """Add white noise of standard deviation `sd` [grey levels] to each channel of each pixel, and round."""

    def noisy(image: np.ndarray) -> np.ndarray:
        draw = rng.standard_normal(image.shape, dtype=np.float32)
        return np.clip(np.round(image + np.float32(sd) * draw), 0, 255).astype(np.uint8)

    return StereoPair(left=noisy(pair.left), right=noisy(pair.right))
