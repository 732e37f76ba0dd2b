"""Where the tip may be."""

import numpy as np
from jaxtyping import Float
from jiggle_mj.estimator.estimator import Estimator

from jiggle_mj.limits import Limits

Bounds = tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]


def bounds(estimator: Estimator, limits: Limits) -> Bounds:
    """Corners of the box that the tip may be in: the resting sheet, and the limits beside and above it [m]."""
    rest = estimator.sheet.rest
    bottom, top = rest.min(axis=0), rest.max(axis=0)
    beside = np.array([limits.beside, limits.beside, 0.0])
    return bottom - beside, np.array([*(top + beside)[:2], max(limits.ceiling, top[2])])
