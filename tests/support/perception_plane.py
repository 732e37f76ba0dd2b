"""A textured plane sheet seen by an ideal stereo camera, drawn by homography: the truth has a closed form.

The sheet is the affine image of a square, P(s, t) = centre + s * along + t * across, so a pixel sees the material point
that solves a 3x3 linear system. Texture is smooth noise, the same for every frame; the bed behind is another plane.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np

from jiggle_mj.camera import StereoCamera
from jiggle_mj.observation import StereoPair, ToolState

WIDTH, HEIGHT, FOCAL = 400, 300, 420.0
"""Size of the images and focal length [px]."""
BASELINE = 5e-3
"""Distance between the cameras [m]."""
DISTANCE = 0.11
"""Height of the cameras above the flat sheet [m]."""
HALF = 0.025
"""Half the side of the sheet [m]."""
BED = -2e-3
"""Height of the bed [m]."""


def camera() -> StereoCamera:
    """Return a camera that looks straight down: image right is world x, image down is world -y."""
    T = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, DISTANCE], [0, 0, 0, 1]])
    return StereoCamera.rectified(width=WIDTH, height=HEIGHT, focal=FOCAL, baseline=BASELINE, T_world_camera=T)


@dataclass(frozen=True, kw_only=True)
class PlaneSheet:
    """Position of the sheet, P(s, t) = centre + s along + t across."""

    centre: np.ndarray = field(default_factory=lambda: np.zeros(3))
    along: np.ndarray = field(default_factory=lambda: np.array([1.0, 0, 0]))
    across: np.ndarray = field(default_factory=lambda: np.array([0, 1.0, 0]))

    def deformed(self, rest: np.ndarray) -> np.ndarray:
        """Return the positions [m] of material points that are at `rest` on the flat sheet at z = 0."""
        return self.centre + rest[:, :1] * self.along + rest[:, 1:2] * self.across


def texture(seed: int) -> np.ndarray:
    """Return smooth noise of several scales over the square from -2 HALF to 2 HALF, 0 to 1."""
    rng = np.random.default_rng(seed)
    layers = [cv2.GaussianBlur(rng.standard_normal((1000, 1000)), (0, 0), s) * s for s in (4.0, 8.0, 20.0)]
    noise = np.sum(layers, axis=0)
    return (0.5 + 0.2 * noise / noise.std()).clip(0, 1).astype(np.float32)


TISSUE, CLOTH = texture(1), texture(2)


def draw(sheets: tuple[PlaneSheet, ...], *, shift: float, pixels: np.ndarray | None = None) -> np.ndarray:
    """Return the image of a camera moved by `shift` along its x axis [m], at `pixels` (h, w, 2) or all [px]."""
    cam = camera()
    if pixels is None:
        v, u = np.mgrid[:HEIGHT, :WIDTH].astype(float)
        pixels = np.stack([u, v], axis=-1)
    (cx, cy), T = cam.centre, cam.T_world_camera
    rays = np.stack([(pixels[..., 0] - cx) / FOCAL, (pixels[..., 1] - cy) / FOCAL, np.ones(pixels.shape[:2])], axis=-1)
    rays, eye = rays @ T[:3, :3].T, T[:3, 3] + shift * T[:3, 0]
    bed = PlaneSheet(centre=np.array([0, 0, BED]))
    image = _colour(_look(bed, eye, rays), CLOTH, np.array([40.0, 90, 110]))
    for sheet in sheets:
        material = _look(sheet, eye, rays)
        inside = (np.abs(material) < HALF).all(axis=-1)
        image[inside] = _colour(material, TISSUE, np.array([215.0, 110, 95]))[inside]
    return image.round().astype(np.uint8)


def _look(sheet: PlaneSheet, eye: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Return the material coordinates (s, t) that each ray meets: eye + l ray = centre + s along + t across."""
    system = np.stack([np.broadcast_to(sheet.along, rays.shape), np.broadcast_to(sheet.across, rays.shape), -rays], -1)
    return np.linalg.solve(system, (eye - sheet.centre)[:, None])[..., :2, 0]


def _colour(material: np.ndarray, pattern: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """Return the colour of material points under a texture."""
    at = ((material / (4 * HALF) + 0.5) * (len(pattern) - 1)).astype(np.float32)
    shade = cv2.remap(pattern, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return np.clip(colour * (0.35 + 0.65 * shade[..., None]), 0, 255)


def stereo(*sheets: PlaneSheet, noise: float = 1.0, seed: int = 0) -> StereoPair:
    """Return both images with white noise [grey levels]."""
    rng = np.random.default_rng(seed)
    left, right = (
        np.clip(np.round(draw(sheets, shift=s) + noise * rng.standard_normal((HEIGHT, WIDTH, 3))), 0, 255)
        for s in (0.0, BASELINE)
    )
    return StereoPair(left=left.astype(np.uint8), right=right.astype(np.uint8))


def tool(*, grasp: int = 0, closed: bool = False, z: float = 0.0) -> ToolState:
    """Return a tip above one corner."""
    return ToolState(
        position=np.array([HALF, HALF, z]), quat_wxyz=np.array([1.0, 0, 0, 0]), closed=closed, grasp=grasp, radius=5e-3
    )
