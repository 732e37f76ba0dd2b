"""Find frames in which what is held is observed in another shape, because points were tracked wrongly.

What is held moves and rotates with the jaws. A tracker that takes the wrong corner observes it wider, or bent.
"""

import warnings

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from .grasped_frames import Timed

MIN_HELD = 4
"""Smallest number of held particles whose shape is compared."""
MAX_SDS = 3.0
"""Largest difference of shape that noise may explain [standard deviations of the noise]."""
MAX_SHARE = 0.1
"""Largest share of frames with another shape. If there are more, the grip is not rigid and all frames are used."""


def another_shape(frames: list[Timed], sd: float, fields: Float[np.ndarray, "n modes"]) -> list[int]:
    """Return the positions in the list of frames where what is held has another shape than when the jaws closed.

    Args:
        frames: with closed jaws.
        sd: standard deviation of the white noise [m].
        fields: fields of the smooth noise [m].
    """
    found = [k for k, one in enumerate(frames) if _excess(one, sd, fields) > MAX_SDS**2]
    return found if len(found) <= MAX_SHARE * len(frames) else []


def _excess(one: Timed, sd: float, fields: Float[np.ndarray, "n modes"]) -> float:
    """Return the mean squared difference of the shape, over that of the noise of two frames."""
    seen = np.asarray(one.frame.held & one.frame.visible)
    if seen.sum() < MIN_HELD:
        return 0.0
    then, now = (np.asarray(where)[seen] for where in (one.frame.rotated, one.frame.y))
    then, now, smooth = then - then.mean(axis=0), now - now.mean(axis=0), fields[seen] - fields[seen].mean(axis=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # the rotation of a straight row about itself is undefined
        difference = now - Rotation.align_vectors(now, then)[0].apply(then)
    return float(np.mean(difference**2) / (2 * (sd**2 + np.mean(np.sum(smooth**2, axis=1)))))
