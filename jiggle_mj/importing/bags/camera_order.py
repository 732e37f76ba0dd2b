"""What the first images tell of the cameras: which one is on the left, and how far away the scene is.

A point of the scene lies further right in the left image. Features are matched along the rows of the rectified pair.
Where too few match, nothing is claimed.
"""

import numpy as np
from jaxtyping import Float

from ...camera import StereoCamera
from ...observation import StereoPair
from ...plausibility.stereo_images import MIN_MATCHES, SURE_SHARE
from ...plausibility.stereo_matches import find_features, match_features

MAX_ROW_ERROR = 2.0
"""Largest difference of two matched rows after rectification [px]."""


def disparities(camera: StereoCamera, pair: StereoPair) -> Float[np.ndarray, " n"]:
    """Return the disparities of the features that both images show in one row [px]; empty where they are too few."""
    left, right = find_features(camera, "left", pair.left), find_features(camera, "right", pair.right)
    matched = match_features(left, right)
    shift = left.pixels[matched[:, 0]] - right.pixels[matched[:, 1]]
    found = shift[np.abs(shift[:, 1]) <= MAX_ROW_ERROR, 0]
    return found if len(found) >= MIN_MATCHES else np.empty(0)


def left_is_left(found: Float[np.ndarray, " n"]) -> bool | None:
    """Return whether the left image was taken by the camera on the left; None where the disparities do not tell."""
    share = float(np.mean(found > 0)) if len(found) else 0.5
    return None if 1 - SURE_SHARE < share < SURE_SHARE else share >= SURE_SHARE


def scene_range(found: Float[np.ndarray, " n"]) -> tuple[float, float] | None:
    """Return the disparities of what is far and near in the scene [px]; None where they are not known."""
    if not left_is_left(found):
        return None
    low, high = np.percentile(found[found > 0], [5, 95])
    return float(low), float(high)
