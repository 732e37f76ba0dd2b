"""Doubts about a segmentation by colour, from the picture itself.

A sheet lies on something else: it has an edge inside the image, no other thing shows through it, and its colour stands
apart. What fails this is the likeliest the table that a pale sheet lies on.
"""

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from jiggle_mj.errors import MaskError

TOUCHED = 0.05
"""Share of a side of the image along which a blob touches that side."""
MAX_TOUCHED_SIDES = 2
"""Most sides of the image that a sheet may touch: it can be cut off at a corner."""
MAX_HOLES = 0.05
"""Largest share of the blob's outline that is of another colour; highlights and sutures cover less. The shipped scenes
have none."""
MIN_SEPARATION = 2.0
"""Least distance of the medians of a* (CIE L*a*b*) inside and outside, in spreads of both: 10th percentile to median
inside, and median to 90th percentile outside. The shipped scenes have about 5, two equal normal halves 1.2."""
MIN_SPREAD = 1.0
"""Least spread [levels of a*]: its rounding."""


def refuse_grey(image: UInt8[np.ndarray, "height width 3"]) -> None:
    """Refuse a colour mask on an image without colours.

    Raises:
        MaskError: red, green and blue are equal in every pixel.
    """
    if (image[..., 0] == image[..., 1]).all() and (image[..., 1] == image[..., 2]).all():
        raise MaskError(
            "no tissue can be found by its colour: the images are grey. Say which pixels are tissue with --mask (or "
            "Estimator's mask).",
            np.zeros(image.shape[:2], bool),
        )


def refuse_doubtful(image: UInt8[np.ndarray, "height width 3"], blob: Bool[np.ndarray, "height width"]) -> None:
    """Refuse a blob of tissue colour that does not look like a sheet on something else.

    Args:
        image: RGB image.
        blob: the one blob that was taken for the sheet.

    Raises:
        MaskError: it touches three sides of the image, surrounds much of another colour, or hardly differs in colour.
    """
    reasons = []
    sides = {"top": blob[0], "bottom": blob[-1], "left": blob[:, 0], "right": blob[:, -1]}
    touched = [name for name, side in sides.items() if side.mean() > TOUCHED]
    if len(touched) > MAX_TOUCHED_SIDES:
        reasons.append(f"it touches the image's {', '.join(touched)}")
    holes = 1 - blob.sum() / _filled(blob).sum()
    if holes > MAX_HOLES:
        reasons.append(f"{holes:.0%} of what it surrounds has another colour")
    separation = _separation(image, blob)
    if separation < MIN_SEPARATION:
        reasons.append(f"its colour is hardly that of a thing of its own ({separation:.1f} spreads apart)")
    if reasons:
        raise MaskError(
            f"what has the colour of tissue may not be the sheet: {'; '.join(reasons)}. Is it the table? Say which "
            "pixels are tissue with --mask (or Estimator's mask).",
            blob,
        )


def _filled(blob: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Return the blob with its holes."""
    contours, _ = cv2.findContours(blob.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = np.zeros(blob.shape, np.uint8)
    cv2.drawContours(filled, [max(contours, key=cv2.contourArea)], -1, 1, cv2.FILLED)
    return filled.astype(bool)


def _separation(image: UInt8[np.ndarray, "height width 3"], blob: Bool[np.ndarray, "height width"]) -> float:
    """Return the distance of the colours inside and outside, in spreads; infinite where nothing is outside."""
    a_star = cv2.cvtColor(cv2.GaussianBlur(image, (0, 0), 1.5), cv2.COLOR_RGB2LAB)[..., 1]
    inside, outside = a_star[blob], a_star[~blob]
    if not len(outside):
        return float("inf")
    (low, middle), (rest, high) = np.percentile(inside, [10, 50]), np.percentile(outside, [50, 90])
    return float((middle - rest) / max(middle - low + high - rest, MIN_SPREAD))
