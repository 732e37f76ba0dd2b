"""From a raw stereo pair to what perception works on: two rectified colour images and their grey versions.

Rectification with OpenCV's `initUndistortRectifyMap` from the calibration's K, D, R, P; a calibration that already is
rectified costs nothing. Does not calibrate, and does not correct brightness between the cameras: the matching
normalises locally.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jiggle_mj.camera import CameraCalibration, StereoCamera
from jiggle_mj.errors import PerceptionError
from jiggle_mj.observation import StereoPair

from .resampling import double

DARK = 8.0
"""An image is black when even its 99th percentile stays below this grey value of 255 (sensor noise is 1 to 3)."""

SMOOTHING = 0.6
"""Standard deviation of the Gaussian on the grey images [px]: quiets noise and aliasing."""


@dataclass(frozen=True, kw_only=True)
class RectifiedPair:
    """One rectified stereo pair."""

    left: UInt8[np.ndarray, "height width 3"]
    """RGB."""
    right: UInt8[np.ndarray, "height width 3"]
    """RGB."""
    left_grey: Float[np.ndarray, "height width"]
    """0 to 255, float32, lightly smoothed."""
    right_grey: Float[np.ndarray, "height width"]
    """0 to 255, float32, lightly smoothed."""
    left_fine: Float[np.ndarray, "doubled_height doubled_width"]
    """The left grey image at half-pixel spacing."""
    right_fine: Float[np.ndarray, "doubled_height doubled_width"]
    """The right grey image at half-pixel spacing."""

    @property
    def black_side(self) -> str | None:
        """Which image is black: 'left', 'right' or None."""
        for side, grey in (("left", self.left_grey), ("right", self.right_grey)):
            if np.percentile(grey[::4, ::4], 99) < DARK:
                return side
        return None


class Rectifier:
    """Rectifies the pairs of one camera; the maps are computed once."""

    def __init__(self, camera: StereoCamera):
        self._size = (camera.left.height, camera.left.width)
        self._maps = [rectifying_maps(calibration) for calibration in (camera.left, camera.right)]

    def __call__(self, images: StereoPair) -> RectifiedPair:
        """Rectify one pair.

        Raises:
            PerceptionError: the images are not of the calibrated size.
        """
        if images.left.shape[:2] != self._size:
            given = f"{images.left.shape[1]}x{images.left.shape[0]}"
            raise PerceptionError(
                f"the images are {given} px and the calibration is for {self._size[1]}x{self._size[0]} px; "
                "record both at one size."
            )
        left, right = (
            image if maps is None else cv2.remap(image, *maps, cv2.INTER_LINEAR)
            for image, maps in zip((images.left, images.right), self._maps, strict=True)
        )
        grey = [
            cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32), (0, 0), SMOOTHING)
            for image in (left, right)
        ]
        return RectifiedPair(
            left=left,
            right=right,
            left_grey=grey[0],
            right_grey=grey[1],
            left_fine=double(grey[0]),
            right_fine=double(grey[1]),
        )


def rectifying_maps(calibration: CameraCalibration) -> tuple[np.ndarray, np.ndarray] | None:
    """Where each rectified pixel comes from in the raw image, for `cv2.remap`; None when nothing moves."""
    if calibration.rectified:
        return None
    c = calibration
    return cv2.initUndistortRectifyMap(c.K, c.D, c.R, c.P[:, :3], (c.width, c.height), cv2.CV_32FC1)
