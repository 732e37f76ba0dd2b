"""Dense disparity between the two rectified images.

The shipped `SemiGlobalMatching` is OpenCV's StereoSGBM (after Hirschmueller 2008, doi:10.1109/TPAMI.2007.1166) run
left to right and right to left; pixels where the two disagree are unknown. It locks to whole pixels with an error of
about 0.2 px; `lucas_kanade` refines it at the particles. A learned model plugs in through `Disparity`.
"""

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jiggle_mj.camera import StereoCamera

from .config import StereoTrackerConfig

RANGE_STEP = 16
"""OpenCV's search range is a multiple of this [px]."""
SUBPIXEL_SCALE = 16
"""OpenCV's disparities are integers in units of 1/16 px."""
SMALL_STEP_PENALTY, LARGE_STEP_PENALTY = 8, 32
"""P1 and P2: penalties for a change of disparity by one and by more [block area]; OpenCV's recommendation."""
PREFILTER_CAP = 31
"""Bound of the prefiltered gradients [grey levels]."""
UNIQUENESS_RATIO = 5
"""Margin by which the best match must win [%]; OpenCV recommends 5 to 15."""
MAX_SPECKLE_SIZE, SPECKLE_RANGE = 60, 2
"""Size of connected regions that are dropped as speckles [px], and the change of disparity within one [px]."""


@runtime_checkable
class Disparity(Protocol):
    """A matcher of a rectified pair."""

    def __call__(
        self, left: UInt8[np.ndarray, "height width 3"], right: UInt8[np.ndarray, "height width 3"]
    ) -> Float[np.ndarray, "height width"]:
        """Return the disparity u_left - u_right at each left pixel [px], above 0; NaN where unknown."""
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
    def for_camera(
        cls, camera: StereoCamera, *, min_depth: float = StereoTrackerConfig.min_depth
    ) -> "SemiGlobalMatching":
        """Return a matcher whose range reaches to tissue at `min_depth` [m], at most half of the image's width."""
        needed = min(camera.focal[0] * camera.baseline / min_depth, camera.left.width / 2)
        return cls(largest=RANGE_STEP * math.ceil(needed / RANGE_STEP))

    def __post_init__(self) -> None:
        """Check the ranges."""
        if self.largest <= 0 or self.largest % RANGE_STEP:
            raise ValueError(
                f"SemiGlobalMatching.largest must be a positive multiple of {RANGE_STEP}; got {self.largest}."
            )
        if self.block < 1 or self.block % 2 == 0:
            raise ValueError(f"SemiGlobalMatching.block must be odd and positive; got {self.block}.")

    def __call__(
        self, left: UInt8[np.ndarray, "height width 3"], right: UInt8[np.ndarray, "height width 3"]
    ) -> Float[np.ndarray, "height width"]:
        """Return the disparity at each left pixel [px]; NaN where the directions disagree or no match exists."""
        grey_left, grey_right = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (left, right))
        forward = self._match(grey_left, grey_right)
        backward = self._match(grey_right[:, ::-1], grey_left[:, ::-1])[:, ::-1]
        rows, columns = np.mgrid[: forward.shape[0], : forward.shape[1]].astype(np.float32)
        known = forward > 0
        reverse = cv2.remap(
            np.ascontiguousarray(backward), columns - np.where(known, forward, 0), rows, cv2.INTER_NEAREST
        )
        agreed = known & (reverse > 0) & (np.abs(reverse - forward) < self.tolerance)
        return np.where(agreed, forward, np.float32(np.nan))

    def _match(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return SGBM's disparity [px], below 0 where unknown; padding on the left lets it search the border too."""
        pad = self.largest
        matcher = cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=self.largest,
            blockSize=self.block,
            P1=SMALL_STEP_PENALTY * self.block**2,
            P2=LARGE_STEP_PENALTY * self.block**2,
            disp12MaxDiff=-1,
            preFilterCap=PREFILTER_CAP,
            uniquenessRatio=UNIQUENESS_RATIO,
            speckleWindowSize=MAX_SPECKLE_SIZE,
            speckleRange=SPECKLE_RANGE,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )
        first, second = (cv2.copyMakeBorder(image, 0, 0, pad, 0, cv2.BORDER_REFLECT) for image in (first, second))
        return matcher.compute(first, second)[:, pad:].astype(np.float32) / SUBPIXEL_SCALE
