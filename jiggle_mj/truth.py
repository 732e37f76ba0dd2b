"""The true attachments and positions, which the estimator must not see.

They are stored in a separate file (`run.truth.mcap`). The reference tissue or an importer writes it; only
`jiggle_mj.eval` reads it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, kw_only=True)
class TruthFrame:
    """True state of the tissue at one observation."""

    index: int
    """Index of the observation."""
    time: int
    """Time of the observation [ns]."""
    positions: Float[np.ndarray, "n 3"]
    """True positions of the reference's vertices, on the surface that a camera sees [m]; NaN where unknown."""
    stiffness: Float[np.ndarray, " n"]
    """True attachment stiffness of each vertex [N/m]; inf for a weld, NaN where only its presence is known."""
    tip: Float[np.ndarray, " 3"]
    """True tip position [m]."""
    load: Float[np.ndarray, " n"] | None = None
    """Force on each vertex's attachment [N], 0 where free; None where unknown."""


@dataclass(frozen=True, kw_only=True)
class Truth:
    """Mesh, attachments and frames of the reference tissue."""

    rest: Float[np.ndarray, "n 3"]
    """Rest positions on the visible surface [m]."""
    faces: Int[np.ndarray, "f 3"]
    """Vertex numbers of each triangle, from 0."""
    attached: Bool[np.ndarray, " n"]
    """Which vertices are attached at the start."""
    frames: tuple[TruthFrame, ...]
    """True state at each observation; empty for measured data."""
    scene: str
    """Name of the scene or recording."""
    identity: str = ""
    """Identity of the recording that this truth belongs to, as its metadata has it; empty where unknown."""
    details: dict[str, object]
    """Further entries of the writer (the scene as typed, disturbances), JSON-serialisable."""
