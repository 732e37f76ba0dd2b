"""Segmentation by GrabCut (Rother, Kolmogorov and Blake 2004, doi:10.1145/1015706.1015720), for sheets of any colour.

It is seeded by a rectangle in the image's centre: everything outside is background. Each image is segmented anew.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from jiggle_mj.argument_checks import as_number
from jiggle_mj.errors import PerceptionError

MAX_PIXELS = 80_000
"""Pixels to which an image is reduced first, which bounds the time to about half a second."""
ITERATIONS = 5
"""Iterations of GrabCut; the paper's converge in about as many."""


@dataclass(frozen=True, kw_only=True)
class GrabCut:
    """Segmentation of what differs in colour from the image's surroundings."""

    centre_share: float = 0.8
    """Width and height of the rectangle in the centre that holds the whole sheet [image width and height]."""

    def __post_init__(self) -> None:
        """Check the range."""
        as_number(self.centre_share, "GrabCut.centre_share", above=0, below=1)

    def __call__(self, image: UInt8[np.ndarray, "height width 3"]) -> Bool[np.ndarray, "height width"]:
        """Return the tissue pixels of an RGB image."""
        height, width = image.shape[:2]
        factor = min(1.0, (MAX_PIXELS / (height * width)) ** 0.5)
        small = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA) if factor < 1 else image
        rows, columns = small.shape[:2]
        margin = (1 - self.centre_share) / 2
        rectangle = (
            round(margin * columns),
            round(margin * rows),
            round(self.centre_share * columns),
            round(self.centre_share * rows),
        )
        labels, background, foreground = np.zeros((rows, columns), np.uint8), np.zeros((1, 65)), np.zeros((1, 65))
        cv2.setRNGSeed(0)  # GrabCut draws the beginning of its colour models
        try:
            cv2.grabCut(small, labels, rectangle, background, foreground, ITERATIONS, cv2.GC_INIT_WITH_RECT)
        except cv2.error as failure:
            raise PerceptionError(
                f"GrabCut cannot divide the image ({failure.err}); give a mask as a file."
            ) from failure
        tissue = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD)).astype(np.uint8)
        return cv2.resize(tissue, (width, height), interpolation=cv2.INTER_NEAREST).astype(bool)
