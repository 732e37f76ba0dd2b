"""Dense optical flow between two grey images, checked forward and backward: the initial guess of the sheet's motion.

OpenCV's DIS (Kroeger et al. 2016, doi:10.1007/978-3-319-46493-0_29). Good to a pixel or two and drifts from frame to
frame: `registration` refines it against the first image.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float

MIN_AGREED = 0.99
"""Interpolated share of the four surrounding pixels whose flow must be consistent: all, within float32 rounding."""


def dense_flow(
    first: Float[np.ndarray, "height width"], second: Float[np.ndarray, "height width"], *, max_gap: float
) -> tuple[Float[np.ndarray, "height width 2"], Bool[np.ndarray, "height width"]]:
    """Return the flow from the first image to the second [px], and where it is consistent.

    Flow is consistent where forward and backward flow return to within `max_gap` [px] of the start.
    """
    grey = [np.clip(image, 0, 255).astype(np.uint8) for image in (first, second)]
    method = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    forward = method.calc(grey[0], grey[1], np.zeros((*first.shape, 2), np.float32))
    backward = method.calc(grey[1], grey[0], np.zeros((*first.shape, 2), np.float32))
    rows, columns = np.mgrid[: first.shape[0], : first.shape[1]].astype(np.float32)
    back = cv2.remap(backward, columns + forward[..., 0], rows + forward[..., 1], cv2.INTER_LINEAR)
    gap = forward + back
    return forward, (gap * gap).sum(axis=-1) < max_gap**2


def flow_at(
    points: Float[np.ndarray, "n 2"],
    flow: Float[np.ndarray, "height width 2"],
    agreed: Bool[np.ndarray, "height width"],
) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    """Return the flow at given pixels [px], and whether it is inside the image and consistent there."""
    x, y = points.astype(np.float32).T
    height, width = agreed.shape
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    moved = cv2.remap(flow, x[None], y[None], cv2.INTER_LINEAR)[0]
    consistent = cv2.remap(agreed.astype(np.float32), x[None], y[None], cv2.INTER_LINEAR)[0] > MIN_AGREED
    return moved.astype(float), inside & consistent
