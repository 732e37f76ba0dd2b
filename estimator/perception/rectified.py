"""Rectification of a raw stereo pair: two rectified colour images and their grey versions.

It uses OpenCV's `initUndistortRectifyMap` with the calibration's K, D, R, P; a pair that is rectified already is not
resampled. It does not calibrate, and does not equalise brightness between the cameras: the matching normalises locally.
"""

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from jiggle_mj.camera import CameraCalibration, StereoCamera
from jiggle_mj.errors import PerceptionError
from jiggle_mj.observation import StereoPair

from .config import StereoTrackerConfig
from .resampling import double

BLACK_STRIDE = 4
"""Every fourth pixel in either direction is enough to tell a black image."""
BLACK_PERCENTILE = 99
"""Percentile of the grey values that is compared, so that single hot pixels do not count."""


@dataclass(frozen=True, kw_only=True)
class RectifiedPair:
    """One rectified stereo pair."""

    left: UInt8[np.ndarray, "height width 3"]
    """Rectified left image, RGB."""
    right: UInt8[np.ndarray, "height width 3"]
    """Rectified right image, RGB."""
    left_grey: Float[np.ndarray, "height width"]
    """Smoothed left grey image, 0 to 255, float32."""
    right_grey: Float[np.ndarray, "height width"]
    """Smoothed right grey image, 0 to 255, float32."""
    left_fine: Float[np.ndarray, "doubled_height doubled_width"]
    """The left grey image at half-pixel spacing."""
    right_fine: Float[np.ndarray, "doubled_height doubled_width"]
    """The right grey image at half-pixel spacing."""
    black_side: Literal["left", "right"] | None
    """Which image is black."""


class Rectifier:
    """Rectifier of the pairs of one camera; its maps are computed once."""

    def __init__(self, camera: StereoCamera, config: StereoTrackerConfig | None = None):
        self._config = config or StereoTrackerConfig()
        self._size = (camera.left.height, camera.left.width)
        self._maps = [rectifying_maps(calibration) for calibration in (camera.left, camera.right)]

    def __call__(self, images: StereoPair) -> RectifiedPair:
        """Return one pair, rectified.

        Raises:
            PerceptionError: the images are not of the calibrated size.
        """
        if images.left.shape[:2] != self._size:
            given = f"{images.left.shape[1]}x{images.left.shape[0]}"
            raise PerceptionError(
                f"the images are {given} px and the calibration is for {self._size[1]}x{self._size[0]} px; "
                "record and calibrate at one size."
            )
        left, right = (
            image if maps is None else cv2.remap(image, *maps, cv2.INTER_LINEAR)
            for image, maps in zip((images.left, images.right), self._maps, strict=True)
        )
        grey = [
            cv2.GaussianBlur(
                cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), self._config.grey_smoothing
            )
            for image in (left, right)
        ]
        return RectifiedPair(
            left=left,
            right=right,
            left_grey=grey[0],
            right_grey=grey[1],
            left_fine=double(grey[0]),
            right_fine=double(grey[1]),
            black_side="left" if self._is_black(grey[0]) else "right" if self._is_black(grey[1]) else None,
        )

    def mask(self, mask: Bool[np.ndarray, "h w"], side: Literal["left", "right"]) -> Bool[np.ndarray, "height width"]:
        """Return a mask of a raw image as one of the rectified image.

        Raises:
            PerceptionError: the mask is not of the calibrated size.
        """
        if mask.shape != self._size:
            raise PerceptionError(
                f"the mask of the {side} image is {mask.shape[1]}x{mask.shape[0]} px and the image "
                f"{self._size[1]}x{self._size[0]} px; draw it on the recorded image."
            )
        maps = self._maps[side == "right"]
        return mask if maps is None else cv2.remap(mask.astype(np.uint8), *maps, cv2.INTER_NEAREST).astype(bool)

    def _is_black(self, grey: Float[np.ndarray, "height width"]) -> bool:
        """Return whether an image shows nothing but sensor noise."""
        sampled = grey[::BLACK_STRIDE, ::BLACK_STRIDE]
        return bool(np.percentile(sampled, BLACK_PERCENTILE) < self._config.min_brightness)


def rectifying_maps(calibration: CameraCalibration) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the raw position of each rectified pixel [px], for `cv2.remap`; None if the image is rectified already."""
    if calibration.rectified:
        return None
    c = calibration
    return cv2.initUndistortRectifyMap(c.K, c.D, c.R, c.P[:, :3], (c.width, c.height), cv2.CV_32FC1)
