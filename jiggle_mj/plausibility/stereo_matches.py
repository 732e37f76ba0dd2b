"""Features that the images of two cameras or moments share: OpenCV's SIFT, matched anywhere in the image.

Pixels are those of the rectified image. False matches are a few: who counts matches must bear them.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from ..camera import StereoCamera

MAX_FEATURES = 1000
"""Most features of an image, the strongest."""
WORKING_WIDTH = 1280
"""Wider images are halved until they are not wider [px]: it bounds the time."""
RATIO = 0.8
"""Largest ratio of the distances to the best and second-best match (Lowe 2004, section 7.1)."""


@dataclass(frozen=True, kw_only=True)
class Features:
    """The features of one image."""

    pixels: Float[np.ndarray, "n 2"]
    """Where they are in the rectified image, u and v [px]."""
    descriptors: Float[np.ndarray, "n d"]
    """What they look like."""


def find_features(
    camera: StereoCamera, side: Literal["left", "right"], image: UInt8[np.ndarray, "height width 3"]
) -> Features:
    """Return the features of one image of the pair, rectified."""
    grey, scale = _rectified_grey(camera, side, image), 1
    while grey.shape[1] > WORKING_WIDTH:
        grey, scale = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), 2 * scale
    found, descriptors = cv2.SIFT.create(nfeatures=MAX_FEATURES).detectAndCompute(grey, None)
    if descriptors is None:
        descriptors = np.empty((0, 128), np.float32)
    # The centre of a pixel of a halved image lies between those of two pixels.
    pixels = np.array([each.pt for each in found], float).reshape(-1, 2) * scale + (scale - 1) / 2
    return Features(pixels=pixels, descriptors=descriptors)


def match_features(first: Features, second: Features) -> Int[np.ndarray, "m 2"]:
    """Return the numbers of features that look alike in both images, and like no other."""
    both = _alike(first, second) & {(other, one) for one, other in _alike(second, first)}
    return np.array(sorted(both), np.int64).reshape(-1, 2)


def _alike(first: Features, second: Features) -> set[tuple[int, int]]:
    """Return each feature with the one that it is most like, where no other comes near."""
    if not len(first.descriptors) or len(second.descriptors) < 2:
        return set()
    found = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first.descriptors, second.descriptors, k=2)
    return {(best.queryIdx, best.trainIdx) for best, other in found if best.distance < RATIO * other.distance}


def _rectified_grey(
    camera: StereoCamera, side: Literal["left", "right"], image: UInt8[np.ndarray, "height width 3"]
) -> UInt8[np.ndarray, "height width"]:
    calibration = camera.left if side == "left" else camera.right
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    if calibration.rectified:
        return grey
    maps = cv2.initUndistortRectifyMap(
        calibration.K,
        calibration.D,
        calibration.R,
        calibration.P[:, :3],
        (calibration.width, calibration.height),
        cv2.CV_32FC1,
    )
    return cv2.remap(grey, *maps, cv2.INTER_LINEAR)
