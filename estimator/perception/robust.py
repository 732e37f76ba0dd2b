"""Frames that are unlike the others."""

import numpy as np
from jaxtyping import Bool, Float


def usual(squares: Float[np.ndarray, " t"], *, times: float, rarely: float) -> Bool[np.ndarray, " t"]:
    """Return which squares are inliers: all but those above `times` the median, if these are at most a share `rarely`.

    If more squares are that large, they are part of the distribution, and all are inliers.
    """
    beyond = squares > times * np.median(squares)
    return ~beyond if beyond.mean() <= rarely else np.ones(len(squares), dtype=bool)
