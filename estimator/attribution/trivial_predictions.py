"""Held-out predictions without a model, which a model must beat."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from .grasped_frames import ClosedFrame, Timed

TRIVIAL = ("unmoved", "last_frame", "in_proportion")
"""Names of the predictions."""
RIDGE = 1e-3
"""Prior precision of the matrix of a particle about its scalar share, over the largest square of a displacement: it
decides in directions in which nothing was pulled."""


def trivial_predictions(frames: list[Timed], part: int) -> dict[str, list[Float[np.ndarray, "m 3"]]]:
    """Return the residuals of each frame of a part by each prediction without a model, of what counts [m].

    They are: `unmoved`, nothing moved since the jaws closed; `last_frame`, the last frame of the other parts stays; and
    `in_proportion`, each particle moved with the tool by a linear share, a 3 x 3 matrix, that is fitted to the other
    parts by least squares, after one number for all directions.
    """
    motions = _motions(frames)
    held, others = ([motion for motion in motions if (motion.part == part) == is_held] for is_held in (True, False))
    last = others[-1]
    tool, counted = np.array([motion.tool for motion in others]), np.array([motion.counted for motion in others])
    moved = np.array([np.where(motion.counted[:, None], motion.moved, 0.0) for motion in others])
    squared = np.einsum("kd,ke,kn->nde", tool, tool, counted)
    product = np.einsum("kd,knc->ndc", tool, moved)
    tiny = np.finfo(float).tiny
    scalar = np.trace(product, axis1=1, axis2=2) / np.maximum(np.trace(squared, axis1=1, axis2=2), tiny)
    ridge = (RIDGE * np.max(np.sum(tool**2, axis=1)) + tiny) * np.eye(3)
    share = np.linalg.solve(squared + ridge, product + scalar[:, None, None] * ridge)
    return {
        "unmoved": [motion.moved[motion.counted] for motion in held],
        "last_frame": [(motion.y - last.y)[motion.counted & last.counted] for motion in held],
        "in_proportion": [(motion.moved - motion.tool @ share)[motion.counted] for motion in held],
    }


@dataclass(frozen=True, kw_only=True)
class _Motion:
    """Motion of tool and particles since the jaws closed, in one frame."""

    part: int
    tool: Float[np.ndarray, " 3"]
    """Displacement of the tool [m]."""
    y: Float[np.ndarray, "n 3"]
    """Observed positions [m]."""
    moved: Float[np.ndarray, "n 3"]
    """Displacement of each particle [m]."""
    counted: Bool[np.ndarray, " n"]
    """Whether a particle is observed in both frames, and not held."""


def _motions(frames: list[Timed]) -> list[_Motion]:
    first: dict[int, ClosedFrame] = {}
    motions = []
    for timed in frames:
        closed, now = first.setdefault(timed.grasp, timed.frame), timed.frame
        counted, y = np.asarray(now.counted & closed.visible), np.asarray(now.y)
        moved = y - np.asarray(closed.y)
        motions.append(_Motion(part=timed.part, tool=np.asarray(now.displacement), y=y, moved=moved, counted=counted))
    return motions
