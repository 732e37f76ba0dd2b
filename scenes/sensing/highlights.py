"""Highlights of a lamp on wet tissue. MuJoCo cannot draw them: the texture under its own highlights dims them.

The Blinn-Phong model (doi:10.1145/563858.563893) with one distant lamp, on a surface whose normals come from the
rendered depth and from small bumps at fixed world positions. Each camera sees other highlights, so stereo finds false
matches.
"""

from functools import cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from ..tissue.texture import smooth_noise

SPECULAR_EXPONENT = 120.0
"""Blinn-Phong exponent of wet tissue."""
BUMP_SLOPE_SD = 0.12
"""Standard deviation of the bumps' slope."""
BUMP_CELLS, BUMP_CELL_SIZE = 512, 2.5e-4
"""Cells along each side of the square map of bumps, and their size [m]; the map repeats."""
BUMP_BLUR = 4.0
"""Blur width of the bumps [cells]: 1 mm."""
DEPTH_BLUR = 2.0
"""Blur width of the depth before its slope is taken [px]: triangles have edges, tissue has none."""
MIN_SHARE = 1e-3
"""Smallest share of tissue under the blur by which its depth is divided; it avoids a division by 0."""
MIN_NORM = 1e-12
"""Smallest norm by which a vector is divided; it avoids a division by 0."""


def with_highlights(
    image: UInt8[np.ndarray, "h w 3"],
    depth: Float[np.ndarray, "h w"],
    wet: Bool[np.ndarray, "h w"],
    *,
    focal: float,
    T_world_camera: Float[np.ndarray, "4 4"],
    towards_lamp: Float[np.ndarray, " 3"],
    strength: float,
) -> UInt8[np.ndarray, "h w 3"]:
    """Return the image with highlights added.

    Args:
        image: RGB image.
        depth: depth along the optical axis [m].
        wet: whether a pixel shows tissue.
        focal: focal length [px].
        T_world_camera: pose of the optical frame in the world.
        towards_lamp: unit vector towards the lamp, world.
        strength: brightness of the highlights; at 1 the middle of a highlight is white.
    """
    height, width = depth.shape
    v, u = np.mgrid[:height, :width]
    ray = np.stack([(u - (width - 1) / 2) / focal, (v - (height - 1) / 2) / focal, np.ones_like(depth)], axis=2)
    rotation, place = T_world_camera[:3, :3], T_world_camera[:3, 3]
    share = cv2.GaussianBlur(wet.astype(float), (0, 0), DEPTH_BLUR)
    smooth_depth = np.where(
        wet, cv2.GaussianBlur(np.where(wet, depth, 0.0), (0, 0), DEPTH_BLUR) / np.maximum(share, MIN_SHARE), 1.0
    )
    inner = cv2.erode(wet.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    points = (ray * smooth_depth[..., None]) @ rotation.T + place
    normal = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    normal = _unit(normal * np.sign(normal[..., 2:]))
    u, v = (np.mod(points[..., axis] / BUMP_CELL_SIZE, BUMP_CELLS).astype(np.float32) for axis in (0, 1))
    slope = cv2.remap(_bumps(), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    normal = _unit(normal - np.concatenate([slope, np.zeros((height, width, 1))], axis=2))
    halfway = _unit(_unit(-ray @ rotation.T) + towards_lamp)
    shine = strength * np.maximum((normal * halfway).sum(axis=2), 0.0) ** SPECULAR_EXPONENT
    return np.clip(np.round(image + 255 * np.where(inner, shine, 0.0)[..., None]), 0, 255).astype(np.uint8)


def _unit(vectors: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=2, keepdims=True), MIN_NORM)


@cache
def _bumps() -> Float[np.ndarray, "c c 2"]:
    """Return the slopes of the bumps in x and y."""
    height = smooth_noise(np.random.default_rng(0), BUMP_CELLS, (BUMP_BLUR,))
    slope = np.stack([np.roll(height, -1, axis) - np.roll(height, 1, axis) for axis in (1, 0)], axis=2)
    return BUMP_SLOPE_SD * slope / slope.std()
