"""How a part is foretold without a model: if nothing moves, or each particle goes its own share of the tool's way."""

import numpy as np
from jaxtyping import Bool, Float
from jiggle_mj.estimator.attribution.closed_frames import Timed


def unmoved(frames: list[Timed], part: int) -> float:
    """Root mean square error of a part's frames if all stayed where the jaws closed [m]."""
    return _rms([(_gone(frames, one), _counted(frames, one)) for one in frames if one.part == part])


def in_proportion(frames: list[Timed], part: int) -> float:
    """The same if each particle went along with the tool by the share that it did in the other parts [m]."""
    others = [one for one in frames if one.part != part]
    ways = np.array([np.asarray(one.frame.way) for one in others])
    gone = np.array([np.where(_counted(frames, one)[:, None], _gone(frames, one), 0.0) for one in others])
    seen = np.array([_counted(frames, one) for one in others])
    squared = np.einsum("kd,kd,kn->n", ways, ways, seen)
    share = np.einsum("knd,kd->n", gone, ways) / np.maximum(squared, np.finfo(float).tiny)
    return _rms(
        [
            (_gone(frames, one) - share[:, None] * np.asarray(one.frame.way)[None], _counted(frames, one))
            for one in frames
            if one.part == part
        ]
    )


def _first(frames: list[Timed], like: Timed) -> Timed:
    """The frame in which the jaws closed."""
    return next(one for one in frames if one.grasp == like.grasp)


def _gone(frames: list[Timed], one: Timed) -> Float[np.ndarray, "n 3"]:
    return np.asarray(one.frame.y) - np.asarray(_first(frames, one).frame.y)


def _counted(frames: list[Timed], one: Timed) -> Bool[np.ndarray, " n"]:
    return np.asarray(one.frame.visible & ~one.frame.held & _first(frames, one).frame.visible)


def _rms(off: list[tuple[Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]]) -> float:
    every = np.concatenate([one[counted] for one, counted in off])
    return float(np.sqrt(np.mean(np.sum(every**2, axis=1))))
