"""What the reference knows and the estimator must not: the true attachments and positions.

Lives in a file of its own (`run.truth.mcap`). Only `jiggle_mj.eval` reads it; whoever makes the tissue writes it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, kw_only=True)
class TruthFrame:
    """The tissue at one observation."""

    index: int
    """The observation's index."""
    time: int
    """[ns]."""
    positions: Float[np.ndarray, "n 3"]
    """True positions of the reference's vertices, on the surface that a camera sees [m]; NaN where unknown."""
    stiffness: Float[np.ndarray, " n"]
    """True attachment stiffness of each vertex [N/m]; inf for a weld, NaN where only its presence is known."""
    tip: Float[np.ndarray, " 3"]
    """True tip position [m]."""
    load: Float[np.ndarray, " n"] | None = None
    """Force that each vertex's attachment carries [N], 0 where free; None where unknown."""


@dataclass(frozen=True, kw_only=True)
class Truth:
    """The reference's mesh, attachments and frames."""

    rest: Float[np.ndarray, "n 3"]
    """Rest positions on the visible surface [m]."""
    faces: Int[np.ndarray, "f 3"]
    attached: Bool[np.ndarray, " n"]
    """Which vertices are attached at the start."""
    frames: tuple[TruthFrame, ...]
    scene: str
    """Name of the scene or recording."""
    identity: str = ""
    """Of the recording that this is the truth of, as its metadata has it; empty where unknown."""
    details: dict[str, object]
    """Whatever else the maker wants on record (the scene as typed, disturbances), JSON-serialisable."""
