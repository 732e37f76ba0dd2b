"""Whether several recordings show one sheet that lies the same way, so that effects of its tissue mean the same in all.

Places and directions of effects are those of the world and of the sheet's outline. So rest shapes are compared as they
lie, with their middles moved onto each other and not rotated. Meshes may differ.
"""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from jiggle_mj.errors import OptionError

MAX_DIFFERENCE = 0.07
"""Largest distance between two rest shapes [diagonal of the first one's bounding box]: particles of two meshes are
closer to each other; the corners of a square that is 15 % larger, or rotated by 14 degrees, are not."""


def refuse_other_shapes(rests: Mapping[str, Float[np.ndarray, "_n 3"]]) -> None:
    """Refuse recordings whose rest shapes are not those of one sheet.

    Args:
        rests: rest shape of each recording by its name [m].

    Raises:
        OptionError: two of them differ.
    """
    (first, shape), *others = rests.items()
    limit = MAX_DIFFERENCE * float(np.linalg.norm(np.ptp(shape, axis=0)))
    for name, other in others:
        if (distance := largest_distance(shape, other)) > limit:
            raise OptionError(
                f"{first} and {name} do not show one sheet that lies the same way: their rest shapes are up to "
                f"{1e3 * distance:.1f} mm apart, with their middles on each other; {1e3 * limit:.1f} mm are allowed. "
                "Effects of the tissue are fitted together for one sheet alone; leave --joint out, or give recordings "
                "of the same sheet in the same pose."
            )


def largest_distance(one: Float[np.ndarray, "_n 3"], other: Float[np.ndarray, "_m 3"]) -> float:
    """Return the largest distance from a point of either set to the other, their middles moved onto each other [m].

    It is the Hausdorff distance after a translation; the middle is that of the bounding box.
    """
    moved = [points - (points.min(axis=0) + points.max(axis=0)) / 2 for points in (one, other)]
    return max(float(KDTree(a).query(b)[0].max()) for a, b in (moved, moved[::-1]))
