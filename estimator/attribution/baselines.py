"""Held-out predictions without a model: nothing moves, or each particle moves a share of the tool's displacement."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from .grasped_frames import ClosedFrame, Timed
from .held_out import rms


def unmoved(frames: list[Timed], part: int) -> float:
    """Return the root mean square error of a part's frames if nothing moved since the jaws closed [m]."""
    return _rms([motion for motion in _motions(frames) if motion.part == part])


def in_proportion(frames: list[Timed], part: int) -> float:
    """Return the same if each particle moved with the tool by a share that is fitted to the other parts [m]."""
    motions = _motions(frames)
    others = [motion for motion in motions if motion.part != part]
    tool, counted = np.array([motion.tool for motion in others]), np.array([motion.counted for motion in others])
    moved = np.array([np.where(motion.counted[:, None], motion.moved, 0.0) for motion in others])
    squared = np.einsum("kd,kd,kn->n", tool, tool, counted)
    share = np.einsum("knd,kd->n", moved, tool) / np.maximum(squared, np.finfo(float).tiny)
    residual = [
        replace(motion, moved=motion.moved - share[:, None] * motion.tool[None])
        for motion in motions
        if motion.part == part
    ]
    return _rms(residual)


@dataclass(frozen=True, kw_only=True)
class _Motion:
    """Motion of tool and particles since the jaws closed, in one frame."""

    part: int
    tool: Float[np.ndarray, " 3"]
    """Displacement of the tool [m]."""
    moved: Float[np.ndarray, "n 3"]
    """Displacement of each particle [m]."""
    counted: Bool[np.ndarray, " n"]
    """Whether a particle is observed in both frames, and not held."""


def _motions(frames: list[Timed]) -> list[_Motion]:
    first: dict[int, ClosedFrame] = {}
    motions = []
    for timed in frames:
        closed, now = first.setdefault(timed.grasp, timed.frame), timed.frame
        counted = np.asarray(now.counted & closed.visible)
        moved = np.asarray(now.y) - np.asarray(closed.y)
        motions.append(_Motion(part=timed.part, tool=np.asarray(now.displacement), moved=moved, counted=counted))
    return motions


def _rms(motions: list[_Motion]) -> float:
    return rms(np.concatenate([motion.moved[motion.counted] for motion in motions]))
