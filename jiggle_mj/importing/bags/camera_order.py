"""Which camera is on the left, seen from the images: a point of the scene lies further right in the left image.

Features are matched along the rows of the rectified pair (OpenCV's SIFT). Where too few match, nothing is claimed.
"""

import cv2
import numpy as np
from jaxtyping import UInt8

from ...camera import StereoCamera
from ...observation import StereoPair

MIN_MATCHES = 12
"""Matches from which the sign of the disparity is believed."""
MAX_ROW_ERROR = 2.0
"""Largest difference of two matched rows after rectification [px]."""
SURE_SHARE = 0.8
"""Share of the matches that must agree on the sign."""
RATIO = 0.8
"""Largest ratio of the distances to the best and second-best match (Lowe 2004, section 7.1)."""


def left_is_left(camera: StereoCamera, pair: StereoPair) -> bool | None:
    """Return whether the left image was taken by the camera on the left; None where the images do not tell."""
    left, right = (_rectified_grey(camera, side, image) for side, image in (("left", pair.left), ("right", pair.right)))
    detector = cv2.SIFT.create(nfeatures=1000)
    points_left, described_left = detector.detectAndCompute(left, None)
    points_right, described_right = detector.detectAndCompute(right, None)
    if described_left is None or described_right is None or len(points_right) < 2:
        return None
    signs = []
    for best in cv2.BFMatcher(cv2.NORM_L2).knnMatch(described_left, described_right, k=2):
        if len(best) == 2 and best[0].distance < RATIO * best[1].distance:
            u, v = np.array(points_left[best[0].queryIdx].pt) - points_right[best[0].trainIdx].pt
            if abs(v) <= MAX_ROW_ERROR:
                signs.append(u > 0)
    share = float(np.mean(signs)) if signs else 0.5
    if len(signs) < MIN_MATCHES or 1 - SURE_SHARE < share < SURE_SHARE:
        return None
    return share >= SURE_SHARE


def _rectified_grey(
    camera: StereoCamera, side: str, image: UInt8[np.ndarray, "height width 3"]
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
