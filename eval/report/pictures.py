"""Stereo pairs as small JPEG data URIs, with the pixels of the particles in each image.

Raw images are rectified first if the calibration asks for it, so that the points fall where the projection says.
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

QUALITY = 82
"""JPEG quality: tissue texture stays legible at about 50 kB for 640x480."""
BUDGET_BYTES = 6_000_000
"""Data URIs of all pictures together."""
WIDTH = 640
"""Wider images are shrunk to this [px]."""
SEEN, UNSEEN, HELD = 0, 1, 2


@dataclass(frozen=True, kw_only=True)
class Picture:
    """One stereo pair, ready for a page."""

    step: int
    """Position in the list of estimates."""
    left: str
    right: str
    size: tuple[int, int]
    """Width and height of each [px]."""
    uv_left: Float[np.ndarray, "n 2"]
    """Pixel of each particle: where it was measured, or where it is believed to be if it was not seen."""
    uv_right: Float[np.ndarray, "n 2"]


def state_of(estimate: Estimate) -> Int[np.ndarray, " n"]:
    """0 seen, 1 not seen, 2 in the grip."""
    seen = np.isfinite(estimate.observed).all(axis=1)
    return np.where(estimate.held, HELD, np.where(seen, SEEN, UNSEEN))


def pictures(
    estimates: Sequence[Estimate],
    images: Callable[[int], StereoPair | None],
    camera: StereoCamera,
    steps: Sequence[int],
) -> list[Picture]:
    """Pictures of `steps`, thinned evenly until they fit into the budget, the last kept; frames without any left out.

    Args:
        estimates: one for each used frame.
        images: the raw pair of an observation index.
        camera: that took them.
        steps: positions in `estimates`, ascending.
    """
    available = [step for step in steps if images(estimates[step].index) is not None]
    if not available:
        return []
    first = _picture(available[-1], estimates[available[-1]], images, camera)
    room = max(1, BUDGET_BYTES // (len(first.left) + len(first.right)))
    if len(available) > room:
        chosen = np.unique(np.linspace(0, len(available) - 1, room).round().astype(int))
        available = [available[k] for k in chosen]
    return [_picture(step, estimates[step], images, camera) for step in available]


def _picture(
    step: int, estimate: Estimate, images: Callable[[int], StereoPair | None], camera: StereoCamera
) -> Picture:
    pair = images(estimate.index)
    if pair is None:
        raise ValueError(f"images({estimate.index}) gave None after it gave a pair; it must always answer the same.")
    scale = min(1.0, WIDTH / pair.left.shape[1])
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
    encoded, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    if not encoded:
        raise ValueError(f"an image of shape {image.shape} cannot be written as JPEG.")
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode(), (image.shape[1], image.shape[0])
