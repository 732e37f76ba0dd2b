"""Actions on the tissue, one for each observation.

World frame: z up, SI units.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, kw_only=True)
class Grasp:
    """Close the jaws at a point."""

    point: Float[np.ndarray, " 3"]
    """Position of the tip in the world frame [m]."""
    radius: float
    """Distance from the tip within which tissue is held [m]."""


@dataclass(frozen=True, kw_only=True)
class Move:
    """Move the tip, and let the tissue settle."""

    to: Float[np.ndarray, " 3"]
    """Target of the tip in the world frame [m]."""


@dataclass(frozen=True, kw_only=True)
class Release:
    """Open the jaws and let the tissue settle."""


@dataclass(frozen=True, kw_only=True)
class Wait:
    """Do nothing and observe: a still frame."""


@dataclass(frozen=True, kw_only=True)
class Cut:
    """Cut all attachments of a region of the sheet."""

    path: Float[np.ndarray, "m 2"]
    """Centre line of the region in the coordinates of the resting sheet [m]; one point for a disc."""
    width: float
    """Width of the region, across the path and around its ends [m]."""


@dataclass(frozen=True, kw_only=True)
class Suture:
    """Attach a region of the sheet to the bed."""

    path: Float[np.ndarray, "m 2"]
    """Centre line of the region, as in `Cut` [m]."""
    width: float
    """Width of the region, as in `Cut` [m]."""
    stiffness: float
    """Intended attachment stiffness of each particle of the region [N/m]."""


Action = Grasp | Release | Move | Wait | Cut | Suture
