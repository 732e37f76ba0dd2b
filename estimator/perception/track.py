"""What any way of seeing hands to the filter: one frame's measurement of the particles."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

UNSEEN_VARIANCE = 1.0
"""Variance of a coordinate of a particle that was not seen: as good as unknown [m^2]."""


@dataclass(frozen=True, kw_only=True)
class Track:
    """One frame's measurement of the particles."""

    positions: Float[np.ndarray, "n 3"]
    """World [m]; NaN where unseen."""
    covariance: Float[np.ndarray, "n 3 3"]
    """[m^2]; `UNSEEN_VARIANCE` on the diagonal where unseen."""
    visible: Bool[np.ndarray, " n"]
    uvd: Float[np.ndarray, "n 3"] | None = None
    """Left rectified pixel and disparity [px], the best guess where unseen; None without images."""
