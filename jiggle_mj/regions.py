"""Regions of the resting sheet in tissue coordinates: bands around a path."""

from itertools import pairwise

import numpy as np
from jaxtyping import Float

MIN_SQUARED_LENGTH = 1e-300
"""Floor of a squared length [m^2], so that a segment of no length is a point and gives no division by 0."""


def distance_to_segment(
    p: Float[np.ndarray, "n 2"], start: Float[np.ndarray, " 2"], end: Float[np.ndarray, " 2"]
) -> Float[np.ndarray, " n"]:
    """Return the distance from points to the segment between two points [m]."""
    along = end - start
    share = np.clip((p - start) @ along / max(float(along @ along), MIN_SQUARED_LENGTH), 0.0, 1.0)
    return np.linalg.norm(p - start - share[:, None] * along, axis=1)


def distance_to_path(p: Float[np.ndarray, "n 2"], path: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, " n"]:
    """Return the distance from points to a polyline, or to its only point [m]."""
    ends = pairwise(path) if len(path) > 1 else [(path[0], path[0])]
    return np.min([distance_to_segment(p, start, end) for start, end in ends], axis=0)
