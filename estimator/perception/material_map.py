"""Map between particles and pixels: piecewise linear fields over the mesh in the first image.

The coordinates of a material point are its pixel in the first left image. Barycentric coordinates interpolate values at
the particles over the triangles. The outermost triangles continue a few pixels outwards, to the edge of the tissue.
"""

import math

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt
from scipy.sparse import csr_array

from .config import RegistrationConfig

MARGIN = 6
"""Width of the empty border of the region of interest, beyond the continued triangles [px]."""
SUBPIXEL_BITS = 4
"""Fractional bits of the corners of triangles that OpenCV draws: 1/16 px."""


class MaterialMap:
    """Dense fields over the first image's region of interest, from values at the particles."""

    def __init__(
        self,
        uv: Float[np.ndarray, "n 2"],
        faces: Int[np.ndarray, "f 3"],
        tissue: Bool[np.ndarray, "height width"],
        config: RegistrationConfig | None = None,
    ):
        """Rasterise the mesh.

        Args:
            uv: particles in the first left image [px].
            faces: triangles.
            tissue: tissue pixels of the first left image.
            config: width of the rim and of the continuation; the defaults if None.
        """
        config = config or RegistrationConfig()
        height, width = tissue.shape
        margin = MARGIN + math.ceil(config.max_continuation)
        low = np.maximum(np.floor(uv.min(axis=0)).astype(int) - margin, 0)
        high = np.minimum(np.ceil(uv.max(axis=0)).astype(int) + margin + 1, (width, height))
        self.region = (slice(low[1], high[1]), slice(low[0], high[0]))
        """Rows and columns of the region of interest."""
        self.shape = (int(high[1] - low[1]), int(high[0] - low[0]))
        """Height and width of the region of interest [px]."""
        self.at = uv - low
        """Particles in pixels of the region of interest."""
        owner = np.zeros(self.shape, np.int32)
        for face, corners in enumerate(self.at[faces], start=1):
            cv2.fillConvexPoly(owner, np.round(corners * 2**SUBPIXEL_BITS).astype(np.int32), face, shift=SUBPIXEL_BITS)
        distance = np.empty(self.shape)
        nearest = np.empty((2, *self.shape), np.int32)
        distance_transform_edt(owner == 0, return_indices=True, distances=distance, indices=nearest)
        owner = owner[nearest[0], nearest[1]] - 1
        framed = np.pad(tissue, 1).astype(np.uint8)
        inner = cv2.erode(framed, np.ones((3, 3), np.uint8), iterations=config.rim)[1:-1, 1:-1]
        self.support = inner.astype(bool)[self.region] & (distance < config.max_continuation)
        """Pixels that have a material point on the mesh."""
        self._barycentric = _barycentric(self.at, faces, owner, self.support, len(uv))

    def spread(self, values: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "h w k"]:
        """Return values at the particles as dense float32 fields, which are -1 outside the support."""
        dense = np.full((*self.shape, values.shape[1]), -1, np.float32)
        dense[self.support] = self._barycentric @ values.astype(np.float32)
        return dense

    def sample(self, image: Float[np.ndarray, "h w"]) -> Float[np.ndarray, " n"]:
        """Return a dense field at the particles, by bilinear interpolation."""
        x, y = self.at.astype(np.float32).T
        return cv2.remap(image, x[None], y[None], cv2.INTER_LINEAR)[0]


def _barycentric(
    at: Float[np.ndarray, "n 2"],
    faces: Int[np.ndarray, "f 3"],
    owner: Int[np.ndarray, "h w"],
    support: Bool[np.ndarray, "h w"],
    n: int,
) -> csr_array:
    """Return the matrix of barycentric coordinates (pixels of the support, particles), unbounded outside a triangle."""
    rows, columns = np.nonzero(support)
    corner = at[faces]
    face = owner[rows, columns]
    edge_1, edge_2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    area = edge_1[:, 0] * edge_2[:, 1] - edge_1[:, 1] * edge_2[:, 0]
    x, y = columns - corner[face, 0, 0], rows - corner[face, 0, 1]
    second = (x * edge_2[face, 1] - y * edge_2[face, 0]) / area[face]
    third = (y * edge_1[face, 0] - x * edge_1[face, 1]) / area[face]
    weights = np.stack([1 - second - third, second, third], axis=-1).astype(np.float32)
    pointer = np.arange(0, 3 * len(rows) + 1, 3)
    return csr_array((weights.ravel(), faces[face].ravel(), pointer), shape=(len(rows), n))
