"""Which camera is on the left, seen from the images: a point of the scene lies further right in the left image.

Features are matched along the rows of the rectified pair. Where too few match, nothing is claimed.
"""

import numpy as np

from ...camera import StereoCamera
from ...observation import StereoPair
from ...plausibility.stereo_images import MIN_MATCHES, SURE_SHARE
from ...plausibility.stereo_matches import find_features, match_features

MAX_ROW_ERROR = 2.0
"""Largest difference of two matched rows after rectification [px]."""


def left_is_left(camera: StereoCamera, pair: StereoPair) -> bool | None:
    """Return whether the left image was taken by the camera on the left; None where the images do not tell."""
    left, right = find_features(camera, "left", pair.left), find_features(camera, "right", pair.right)
    matched = match_features(left, right)
    shift = left.pixels[matched[:, 0]] - right.pixels[matched[:, 1]]
    disparities = shift[np.abs(shift[:, 1]) <= MAX_ROW_ERROR, 0]
    share = float(np.mean(disparities > 0)) if len(disparities) else 0.5
    if len(disparities) < MIN_MATCHES or 1 - SURE_SHARE < share < SURE_SHARE:
        return None
    return share >= SURE_SHARE
