"""Segmentation of tissue by colour.

The shipped `WarmTissue` assumes that soft tissue is warm on the red-green axis of CIE L*a*b*: perfused tissue is red to
yellow, instruments are grey, drapes and beds are green, blue or grey. It splits the warm side by Otsu's threshold (Otsu
1979, doi:10.1109/TSMC.1979.4310076). A learned model plugs in through `TissueMask`, masks of a file through
`FrameMask`. `largest_blob` then selects the sheet, and refuses two sheets.
"""

from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from jiggle_mj.errors import PerceptionError

MAX_SECOND_BLOB = 0.25
"""Largest area of a second blob that is a fleck and not a second sheet [area of the largest blob]."""
NEUTRAL = 128
"""Value of a* in an 8-bit CIE L*a*b* image that is neither red nor green."""
MAX_FLECK, MAX_HOLE = 3, 5
"""Widths of the squares that remove flecks (opening) and fill holes (closing) [px]."""


@runtime_checkable
class TissueMask(Protocol):
    """A segmentation of tissue."""

    def __call__(self, image: UInt8[np.ndarray, "height width 3"]) -> Bool[np.ndarray, "height width"]:
        """Return the tissue pixels of an RGB image."""
        ...


@runtime_checkable
class FrameMask(Protocol):
    """Tissue pixels that are known for each frame, drawn by hand or by another program."""

    def at(self, index: int, side: Literal["left", "right"], *, rest: bool) -> Bool[np.ndarray, "height width"]:
        """Return the tissue pixels of a raw image; all where nothing is known.

        Args:
            index: `Observation.index` of the frame.
            side: which camera's image.
            rest: whether the mesh is laid over this image.

        Raises:
            PerceptionError: there is no mask of this frame, and one is needed.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class WarmTissue:
    """Segmentation of pixels that are clearly redder than grey and redder than the rest of the image."""

    redness: float = 6.0
    """Smallest a* (CIE L*a*b*, 8-bit scale around 128) that can be tissue; grey is 0, raw meat about 30."""
    smoothing: float = 1.5
    """Standard deviation of the Gaussian that reduces colour noise first [px]."""

    def __post_init__(self) -> None:
        """Check the ranges."""
        if not self.redness > 0 or not self.smoothing > 0:
            raise ValueError(
                f"WarmTissue.redness and .smoothing must be above 0; got {self.redness} and {self.smoothing}."
            )

    def __call__(self, image: UInt8[np.ndarray, "height width 3"]) -> Bool[np.ndarray, "height width"]:
        """Return the tissue pixels of an RGB image; none if no pixel is warm."""
        smooth = cv2.GaussianBlur(image, (0, 0), self.smoothing)
        a_star = cv2.cvtColor(smooth, cv2.COLOR_RGB2LAB)[..., 1]
        warmth = np.clip(a_star.astype(np.int16) - NEUTRAL, 0, 127).astype(np.uint8)
        otsu, _ = cv2.threshold(warmth, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
        tissue = (warmth > max(otsu, self.redness)).astype(np.uint8)
        tissue = cv2.morphologyEx(tissue, cv2.MORPH_OPEN, np.ones((MAX_FLECK, MAX_FLECK), np.uint8))
        return cv2.morphologyEx(tissue, cv2.MORPH_CLOSE, np.ones((MAX_HOLE, MAX_HOLE), np.uint8)).astype(bool)


def largest_blob(mask: Bool[np.ndarray, "height width"], *, smallest: int) -> Bool[np.ndarray, "height width"]:
    """Return the one connected sheet of a mask.

    Args:
        mask: tissue pixels.
        smallest: fewest pixels that can be a sheet [px].

    Raises:
        PerceptionError: there is no tissue, or there are two sheets of comparable size.
    """
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    areas = stats[1:, cv2.CC_STAT_AREA]
    if not areas.size or areas.max() < smallest:
        area = int(areas.max()) if areas.size else 0
        raise PerceptionError(
            f"no tissue in view: the largest patch of tissue colour has {area} px, at least {smallest} are needed; "
            "point the camera at the tissue, or say which pixels are tissue with --mask (or Estimator's mask)."
        )
    order = np.argsort(-areas, kind="stable")
    if areas.size > 1 and areas[order[1]] > MAX_SECOND_BLOB * areas[order[0]]:
        raise PerceptionError(
            f"two disconnected sheets in view ({areas[order[0]]} and {areas[order[1]]} px); only one sheet "
            "can be tracked: cover the other, or pass a mask that leaves it out (--mask)."
        )
    return labels == order[0] + 1
