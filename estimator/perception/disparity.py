"""Dense disparity between the two rectified images.

The shipped `SemiGlobalMatching` is OpenCV's StereoSGBM (after Hirschmueller 2008, doi:10.1109/TPAMI.2007.1166) run
left to right and right to left; what the two do not agree on is unknown. It locks to whole pixels by about 0.2 px;
`lucas_kanade` refines it where it matters. A learned model plugs in through `Disparity`.
"""

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jiggle_mj.camera import StereoCamera

NEAREST = 0.03
"""Distance from the camera within which no tissue is expected [m]."""


@runtime_checkable
class Disparity(Protocol):
    """Anything that matches a rectified pair."""

    def __call__(
        self, left: UInt8[np.ndarray, "height width 3"], right: UInt8[np.ndarray, "height width 3"]
    ) -> Float[np.ndarray, "height width"]:
        """Disparity u_left - u_right at each left pixel [px], above 0; NaN where unknown."""
        ...


@dataclass(frozen=True, kw_only=True)
class SemiGlobalMatching:
    """Semi-global block matching with a left-right check."""

    largest: int
    """Search range [px], a multiple of 16."""
    block: int = 5
    """Block size [px], odd."""
    tolerance: float = 1.5
    """Largest disagreement between the two directions [px]."""

    @classmethod
    def for_camera(cls, camera: StereoCamera) -> "SemiGlobalMatching":
        """With the range that a tissue at the nearest distance needs, at most half of the image's width."""
        needed = min(camera.focal[0] * camera.baseline / NEAREST, camera.left.width / 2)
        return cls(largest=16 * math.ceil(needed / 16))

    def __post_init__(self) -> None:
        """Check the ranges."""
        if self.largest <= 0 or self.largest % 16:
            raise ValueError(f"SemiGlobalMatching.largest must be a positive multiple of 16; got {self.largest}.")
        if self.block < 1 or self.block % 2 == 0:
            raise ValueError(f"SemiGlobalMatching.block must be odd and positive; got {self.block}.")

    def __call__(
        self, left: UInt8[np.ndarray, "height width 3"], right: UInt8[np.ndarray, "height width 3"]
    ) -> Float[np.ndarray, "height width"]:
        """Disparity at each left pixel [px]; NaN where the two directions disagree or nothing was found."""
        grey_left, grey_right = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (left, right))
        forward = self._match(grey_left, grey_right)
        backward = self._match(grey_right[:, ::-1], grey_left[:, ::-1])[:, ::-1]
        rows, columns = np.mgrid[: forward.shape[0], : forward.shape[1]].astype(np.float32)
        known = forward > 0
        there = cv2.remap(
            np.ascontiguousarray(backward), columns - np.where(known, forward, 0), rows, cv2.INTER_NEAREST
        )
        agreed = known & (there > 0) & (np.abs(there - forward) < self.tolerance)
        return np.where(agreed, forward, np.float32(np.nan))

    def _match(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """SGBM with room on the left, so that the image's border is searched too; below 0 where unknown [px]."""
        pad = self.largest
        matcher = cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=self.largest,
            blockSize=self.block,
            P1=8 * self.block**2,
            P2=32 * self.block**2,
            disp12MaxDiff=-1,
            preFilterCap=31,
            uniquenessRatio=5,
            speckleWindowSize=60,
            speckleRange=2,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )
        first, second = (cv2.copyMakeBorder(image, 0, 0, pad, 0, cv2.BORDER_REFLECT) for image in (first, second))
        return matcher.compute(first, second)[:, pad:].astype(np.float32) / 16
