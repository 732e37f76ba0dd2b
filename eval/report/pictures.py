"""Stereo pairs as small JPEG data URIs, with the pixels of the particles in each image.

Raw images are rectified first if the calibration asks for it, so that the points lie at their projections.
"""

import base64
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from jiggle_mj.camera import CameraCalibration, StereoCamera
from jiggle_mj.estimate import Estimate
from jiggle_mj.estimator.perception.rectified import rectifying_maps
from jiggle_mj.observation import StereoPair

JPEG_QUALITY = 82
"""Quality of the JPEGs: tissue texture stays legible at about 50 kB for 640x480."""
MAX_BYTES = 6_000_000
"""Most bytes of the data URIs of all pictures together."""
MAX_WIDTH = 640
"""Most pixels along a picture's width; wider images are shrunk to it."""
SEEN, UNSEEN, HELD = 0, 1, 2
"""Codes of a particle's state in the page's data."""


@dataclass(frozen=True, kw_only=True)
class Picture:
    """One stereo pair, ready for a page."""

    step: int
    """Position in the list of estimates."""
    left: str
    right: str
    size: tuple[int, int]
    """Width and height of each image [px]."""
    uv_left: Float[np.ndarray, "n 2"]
    """Pixel of each particle: where it was measured, or where it is estimated to be if it was not seen."""
    uv_right: Float[np.ndarray, "n 2"]


def state_of(estimate: Estimate) -> Int[np.ndarray, " n"]:
    """Return the state of each particle: 0 seen, 1 not seen, 2 held by the jaws."""
    seen = np.isfinite(estimate.observed).all(axis=1)
    return np.where(estimate.held, HELD, np.where(seen, SEEN, UNSEEN))


def pictures(
    estimates: Sequence[Estimate],
    images: Callable[[int], StereoPair | None],
    camera: StereoCamera,
    steps: Sequence[int],
) -> list[Picture]:
    """Return pictures of `steps`, thinned evenly to `MAX_BYTES` with the last kept; frames without images are left out.

    Args:
        estimates: one for each used frame.
        images: gives the raw pair of an observation index.
        camera: the camera that took them.
        steps: positions in `estimates`, ascending.
    """
    available = [step for step in steps if images(estimates[step].index) is not None]
    if not available:
        return []
    first = _picture(available[-1], estimates[available[-1]], images, camera)
    most = max(1, MAX_BYTES // (len(first.left) + len(first.right)))
    if len(available) > most:
        chosen = np.unique(np.linspace(0, len(available) - 1, most).round().astype(int))
        available = [available[k] for k in chosen]
    return [_picture(step, estimates[step], images, camera) for step in available]


def _picture(
    step: int, estimate: Estimate, images: Callable[[int], StereoPair | None], camera: StereoCamera
) -> Picture:
    pair = images(estimate.index)
    if pair is None:
        raise ValueError(f"images({estimate.index}) gave None after it gave a pair; it must give the same each time.")
    scale = min(1.0, MAX_WIDTH / pair.left.shape[1])
    seen = np.isfinite(estimate.observed).all(axis=1, keepdims=True)
    uvd = camera.project(np.where(seen, estimate.observed, estimate.positions))
    left, size = _data_uri(pair.left, camera.left, scale)
    right, _ = _data_uri(pair.right, camera.right, scale)
    pixel = (uvd[:, :2] + 0.5) * scale - 0.5
    return Picture(
        step=step,
        left=left,
        right=right,
        size=size,
        uv_left=pixel,
        uv_right=pixel - np.stack([uvd[:, 2] * scale, np.zeros(len(uvd))], axis=1),
    )


def _data_uri(
    image: UInt8[np.ndarray, "height width 3"], calibration: CameraCalibration, scale: float
) -> tuple[str, tuple[int, int]]:
    maps = rectifying_maps(calibration)
    if maps is not None:
        image = cv2.remap(image, *maps, cv2.INTER_LINEAR)
    if scale < 1:
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    encoded, data = cv2.imencode(
        ".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    )
    if not encoded:
        raise ValueError(f"an image of shape {image.shape} cannot be written as JPEG.")
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode(), (image.shape[1], image.shape[0])
