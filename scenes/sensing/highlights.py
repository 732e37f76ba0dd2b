"""Highlights of a lamp on wet tissue, which MuJoCo cannot draw: its own are dimmed by the texture under them.

The Blinn-Phong model (doi:10.1145/563858.563893) with one lamp far away, on a surface whose normals come from rendered
depth and from small bumps that stay with the place. Each camera has its own, so that stereo finds false matches there.
"""

from functools import cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from ..tissue.texture import smooth_noise

SHARPNESS = 120.0
"""Exponent; wet tissue."""
SLOPE = 0.12
"""Standard deviation of the bumps' slope."""
CELLS, CELL = 512, 2.5e-4
"""The map of bumps: square, each side so many cells of so many metres; it repeats."""
SMOOTH = 2.0
"""Width [px] over which depth is averaged before its slope is taken: triangles have edges, tissue has not."""


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
    """The image with highlights.

    Args:
        image: RGB.
        depth: along the optical axis [m].
        wet: where the tissue is.
        focal: [px].
        T_world_camera: pose of the optical frame.
        towards_lamp: a unit vector, world.
        strength: 1 turns a highlight's middle white.
    """
    height, width = depth.shape
    v, u = np.mgrid[:height, :width]
    sight = np.stack([(u - (width - 1) / 2) / focal, (v - (height - 1) / 2) / focal, np.ones_like(depth)], axis=2)
    rotation, place = T_world_camera[:3, :3], T_world_camera[:3, 3]
    share = cv2.GaussianBlur(wet.astype(float), (0, 0), SMOOTH)
    even = np.where(wet, cv2.GaussianBlur(np.where(wet, depth, 0.0), (0, 0), SMOOTH) / np.maximum(share, 1e-3), 1.0)
    inner = cv2.erode(wet.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    points = (sight * even[..., None]) @ rotation.T + place
    normal = np.cross(np.gradient(points, axis=0), np.gradient(points, axis=1))
    normal = _unit(normal * np.sign(normal[..., 2:]))
    u, v = (np.mod(points[..., axis] / CELL, CELLS).astype(np.float32) for axis in (0, 1))
    slope = cv2.remap(_bumps(), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    normal = _unit(normal - np.concatenate([slope, np.zeros((height, width, 1))], axis=2))
    halfway = _unit(_unit(-sight @ rotation.T) + towards_lamp)
    shine = strength * np.maximum((normal * halfway).sum(axis=2), 0.0) ** SHARPNESS
    return np.clip(np.round(image + 255 * np.where(inner, shine, 0.0)[..., None]), 0, 255).astype(np.uint8)


def _unit(vectors: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=2, keepdims=True), 1e-12)


@cache
def _bumps() -> Float[np.ndarray, "c c 2"]:
    """Slopes in x and y."""
    height = smooth_noise(np.random.default_rng(0), CELLS, (4.0,))
    slope = np.stack([np.roll(height, -1, axis) - np.roll(height, 1, axis) for axis in (1, 0)], axis=2)
    return SLOPE * slope / slope.std()
