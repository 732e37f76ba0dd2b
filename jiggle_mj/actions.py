"""What is done to the tissue, one action for each observation.

World frame: z up, SI units.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, kw_only=True)
class Grasp:
    """Close the jaws at a point."""

    point: Float[np.ndarray, " 3"]
    """World [m]."""
    radius: float
    """[m]."""


@dataclass(frozen=True, kw_only=True)
class Move:
    """Move the tip, and settle."""

    to: Float[np.ndarray, " 3"]
    """World [m]."""


@dataclass(frozen=True, kw_only=True)
class Release:
    """Open the jaws and let the tissue settle."""


@dataclass(frozen=True, kw_only=True)
class Wait:
    """Observe once more without acting: a still frame."""


@dataclass(frozen=True, kw_only=True)
class Cut:
    """Cut whatever attaches a region of the sheet."""

    path: Float[np.ndarray, "m 2"]
    """Middle line of the region, in the sheet's coordinates at rest [m]; one point for a disc."""
    width: float
    """Of the region, across the path and around its ends [m]."""


@dataclass(frozen=True, kw_only=True)
class Suture:
    """Attach a region of the sheet."""

    path: Float[np.ndarray, "m 2"]
    """See `Cut`."""
    width: float
    """See `Cut`."""
    stiffness: float
    """Intended for each particle of the region [N/m]."""


Action = Grasp | Release | Move | Wait | Cut | Suture
