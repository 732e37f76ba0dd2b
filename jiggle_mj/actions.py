"""Actions on the tissue, one for each observation.

World frame: z up, SI units. Each action checks its numbers when it is constructed.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .argument_checks import as_array, as_number, store
from .errors import ActionError


@dataclass(frozen=True, kw_only=True)
class Grasp:
    """Close the jaws at a point.

    Raises:
        ActionError: the point is not three finite numbers, or the radius is not above 0.
    """

    point: Float[np.ndarray, " 3"]
    """Position of the tip in the world frame [m]."""
    radius: float
    """Distance from the tip within which tissue is held [m]."""

    def __post_init__(self) -> None:
        """Check point and radius."""
        store(
            self,
            point=as_array(self.point, "Grasp.point [m]", (3,), error=ActionError),
            radius=as_number(self.radius, "Grasp.radius", unit="m", above=0, error=ActionError),
        )


@dataclass(frozen=True, kw_only=True)
class Move:
    """Move the tip, and let the tissue settle.

    Raises:
        ActionError: the target is not three finite numbers.
    """

    to: Float[np.ndarray, " 3"]
    """Target of the tip in the world frame [m]."""

    def __post_init__(self) -> None:
        """Check the target."""
        store(self, to=as_array(self.to, "Move.to [m]", (3,), error=ActionError))


@dataclass(frozen=True, kw_only=True)
class Release:
    """Open the jaws and let the tissue settle."""


@dataclass(frozen=True, kw_only=True)
class Wait:
    """Do nothing and observe: a still frame."""


@dataclass(frozen=True, kw_only=True)
class Cut:
    """Cut all attachments of a region of the sheet.

    Raises:
        ActionError: the path has no point, or one that is not two finite numbers, or the width is not above 0.
    """

    path: Float[np.ndarray, "m 2"]
    """Centre line of the region in the coordinates of the resting sheet [m]; one point for a disc."""
    width: float
    """Width of the region, across the path and around its ends [m]."""

    def __post_init__(self) -> None:
        """Check path and width."""
        _check_region(self)


@dataclass(frozen=True, kw_only=True)
class Suture:
    """Attach a region of the sheet to the bed.

    Raises:
        ActionError: path or width as in `Cut`, or the stiffness is not above 0.
    """

    path: Float[np.ndarray, "m 2"]
    """Centre line of the region, as in `Cut` [m]."""
    width: float
    """Width of the region, as in `Cut` [m]."""
    stiffness: float
    """Intended attachment stiffness of each particle of the region [N/m]."""

    def __post_init__(self) -> None:
        """Check path, width and stiffness."""
        _check_region(self)
        stiffness = as_number(self.stiffness, "Suture.stiffness", unit="N/m", above=0, error=ActionError)
        store(self, stiffness=stiffness)


Action = Grasp | Release | Move | Wait | Cut | Suture


def _check_region(event: Cut | Suture) -> None:
    """Check path and width of a cut or suture, and store them in their types."""
    name = type(event).__name__
    path = as_array(event.path, f"{name}.path [m]", (None, 2), error=ActionError)
    if not len(path):
        raise ActionError(f"{name}.path must have one or more points [x, y] in m; got none.")
    store(event, path=path, width=as_number(event.width, f"{name}.width", unit="m", above=0, error=ActionError))
