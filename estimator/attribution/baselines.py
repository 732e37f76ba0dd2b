"""How a part is foretold without a model: if nothing moves, or each particle goes its own share of the tool's way."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from .closed_frames import ClosedFrame, Timed
from .held_out import rms


def unmoved(frames: list[Timed], part: int) -> float:
    """Root mean square error of a part's frames if all stayed where the jaws closed [m]."""
    return _rms([one for one in _since_closed(frames) if one.part == part])


def in_proportion(frames: list[Timed], part: int) -> float:
    """The same if each particle went along with the tool by the share that it did in the other parts [m]."""
    every = _since_closed(frames)
    others = [one for one in every if one.part != part]
    ways, seen = np.array([one.way for one in others]), np.array([one.counted for one in others])
    gone = np.array([np.where(one.counted[:, None], one.gone, 0.0) for one in others])
    squared = np.einsum("kd,kd,kn->n", ways, ways, seen)
    share = np.einsum("knd,kd->n", gone, ways) / np.maximum(squared, np.finfo(float).tiny)
    left = [replace(one, gone=one.gone - share[:, None] * one.way[None]) for one in every if one.part == part]
    return _rms(left)


@dataclass(frozen=True, kw_only=True)
class _SinceClosed:
    """One frame."""

    part: int
    way: Float[np.ndarray, " 3"]
    """Of the tool [m]."""
    gone: Float[np.ndarray, "n 3"]
    """How far each particle has gone [m]."""
    counted: Bool[np.ndarray, " n"]
    """Whether it is seen, as it was then, and not held."""


def _since_closed(frames: list[Timed]) -> list[_SinceClosed]:
    first: dict[int, ClosedFrame] = {}
    found = []
    for one in frames:
        then, now = first.setdefault(one.grasp, one.frame), one.frame
        counted = np.asarray(now.counted & then.visible)
        gone = np.asarray(now.y) - np.asarray(then.y)
        found.append(_SinceClosed(part=one.part, way=np.asarray(now.way), gone=gone, counted=counted))
    return found


def _rms(frames: list[_SinceClosed]) -> float:
    return rms(np.concatenate([one.gone[one.counted] for one in frames]))
