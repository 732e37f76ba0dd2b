"""Whether what is held keeps its shape: where it is seen in another, the frame is not followed right.

The jaws hold it, so that it goes and turns with them; a tracker that takes the wrong corner sees it wider, or bent.
"""

import warnings

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from .closed_frames import Timed

FEWEST = 4
"""Held particles that are seen, from which on their shape says something."""
TIMES = 3.0
"""Of the noise's standard deviation, by which the shape may differ."""
RARELY = 0.1
"""Largest share of frames with another shape; where there are more, what holds it is not rigid."""


def another_shape(frames: list[Timed], sd: float, fields: Float[np.ndarray, "n modes"]) -> list[int]:
    """Places of frames in which what is held is seen in another shape than when the jaws closed.

    sd, fields: the white and the smooth part of the noise [m].
    """
    found = [k for k, one in enumerate(frames) if _excess(one, sd, fields) > TIMES**2]
    return found if len(found) <= RARELY * len(frames) else []


def _excess(one: Timed, sd: float, fields: Float[np.ndarray, "n modes"]) -> float:
    """Mean square by which a shape differs, over what the noise of two frames makes of it."""
    seen = np.asarray(one.frame.held & one.frame.visible)
    if seen.sum() < FEWEST:
        return 0.0
    then, now = (np.asarray(where)[seen] for where in (one.frame.rotated, one.frame.y))
    then, now, own = then - then.mean(axis=0), now - now.mean(axis=0), fields[seen] - fields[seen].mean(axis=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a straight row may turn about itself as it likes
        off = now - Rotation.align_vectors(now, then)[0].apply(then)
    return float(np.mean(off**2) / (2 * (sd**2 + np.mean(np.sum(own**2, axis=1)))))
