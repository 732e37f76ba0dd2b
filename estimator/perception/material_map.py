"""Between particles and pixels: piecewise linear fields over the mesh as drawn in the first image.

A material point is named by its pixel in the first left image. Values at the particles spread over the triangles by
barycentric coordinates; the rim's triangles are continued a few pixels outwards, to the edge of the tissue.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt
from scipy.sparse import csr_array

RIM = 2
"""Pixels at the tissue's edge that are left out: they blend with what lies behind [px]."""
REACH = 8.0
"""How far triangles are continued beyond the rim [px]."""
MARGIN = 14
"""Empty border around the region of interest [px]."""


class MaterialMap:
    """Dense fields over the first image's region of interest, from values at the particles."""

    def __init__(
        self,
        uv: Float[np.ndarray, "n 2"],
        faces: Int[np.ndarray, "f 3"],
        tissue: Bool[np.ndarray, "height width"],
    ):
        """Rasterise the mesh.

        Args:
            uv: particles in the first left image [px].
            faces: triangles.
            tissue: tissue pixels of the first left image.
        """
        height, width = tissue.shape
        low = np.maximum(np.floor(uv.min(axis=0)).astype(int) - MARGIN, 0)
        high = np.minimum(np.ceil(uv.max(axis=0)).astype(int) + MARGIN + 1, (width, height))
        self.region = (slice(low[1], high[1]), slice(low[0], high[0]))
        """Rows and columns of the region of interest."""
        self.shape = (int(high[1] - low[1]), int(high[0] - low[0]))
        self.at = uv - low
        """Particles in the region's pixels."""
        owner = np.zeros(self.shape, np.int32)
        for face, corners in enumerate(self.at[faces], start=1):
            cv2.fillConvexPoly(owner, np.round(corners * 16).astype(np.int32), face, shift=4)
        distance = np.empty(self.shape)
        nearest = np.empty((2, *self.shape), np.int32)
        distance_transform_edt(owner == 0, return_indices=True, distances=distance, indices=nearest)
        owner = owner[nearest[0], nearest[1]] - 1
        whole = cv2.erode(np.pad(tissue, 1).astype(np.uint8), np.ones((3, 3), np.uint8), iterations=RIM)[1:-1, 1:-1]
        self.support = whole.astype(bool)[self.region] & (distance < REACH)
        """Pixels whose material point the mesh knows."""
        self._barycentric = _barycentric(self.at, faces, owner, self.support, len(uv))

    def spread(self, values: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "h w k"]:
        """Values at the particles as dense float32 fields; outside the support they are -1."""
        dense = np.full((*self.shape, values.shape[1]), -1, np.float32)
        dense[self.support] = self._barycentric @ values.astype(np.float32)
        return dense

    def sample(self, image: Float[np.ndarray, "h w"]) -> Float[np.ndarray, " n"]:
        """A dense field at the particles, bilinear."""
        x, y = self.at.astype(np.float32).T
        return cv2.remap(image, x[None], y[None], cv2.INTER_LINEAR)[0]


def _barycentric(
    at: Float[np.ndarray, "n 2"],
    faces: Int[np.ndarray, "f 3"],
    owner: Int[np.ndarray, "h w"],
    support: Bool[np.ndarray, "h w"],
    n: int,
) -> csr_array:
    """Sparse matrix (pixels of the support, particles) of barycentric coordinates, unbounded outside a triangle."""
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
