"""All frames of a recording at a point: how their misfits weigh, their normal equations, and what misfits cost."""

from collections.abc import Callable, Iterable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..effects.sheet_model import FrameContext
from ..parallel_map import T, parallel_map
from .closed_frames import ClosedFrame
from .linear import N_FIELDS, Metric, NormalEquations, WeightedResiduals, misfit, normal_equations, weigh
from .normal_equations import less_offset
from .problem import Point, Problem

DIRECTIONS = 22
"""Parameters that are fitted together, in most fits at most."""


def directions(problem: Problem, free: np.ndarray) -> Float[np.ndarray, "p d"]:
    """Unit vectors along parameters, padded to a width that most fits share, so that they are compiled once."""
    along = np.zeros((problem.sheet.size, max(DIRECTIONS, len(free))))
    along[free, np.arange(len(free))] = 1
    return along


def weighed(problem: Problem, point: Point, frames: list[int]) -> dict[int, Metric]:
    """Every frame at a point: how misfits weigh."""
    theta, s, noise = (jnp.asarray(a) for a in (point.theta, point.s, problem.noise))

    def one(k: int, frame: ClosedFrame, moment: FrameContext, x: Float[Array, "n 3"]) -> Metric:
        return weigh(problem.sheet, theta, s, frame, moment, x, noise)

    return _each(problem, point, frames, one)


def linearised(
    problem: Problem, point: Point, weights: dict[int, Metric], along: Float[np.ndarray, "p d"]
) -> dict[int, NormalEquations]:
    """Every frame where it was weighed: its normal equations."""
    theta, along_ = jnp.asarray(point.theta), jnp.asarray(along)

    def one(k: int, frame: ClosedFrame, moment: FrameContext, x: Float[Array, "n 3"]) -> NormalEquations:
        return normal_equations(problem.sheet, weights[k], theta, along_, frame, moment)

    return _each(problem, point, weights, one)


def cost_under(problem: Problem, weights: dict[int, Metric], point: Point) -> float:
    """Twice the misfit of a point's predictions [nat], under weights that were reckoned elsewhere."""
    return cost(problem, weights, residual(problem, weights, point), problem.amplitude)


def residual(problem: Problem, weights: dict[int, Metric], point: Point) -> dict[int, WeightedResiduals]:
    """How a point's predictions miss every frame, under weights that were reckoned elsewhere."""
    theta = jnp.asarray(point.theta)

    def one(k: int, frame: ClosedFrame, moment: FrameContext, x: Float[Array, "n 3"]) -> WeightedResiduals:
        return misfit(problem.sheet, weights[k], theta, frame, moment, x)

    return _each(problem, point, weights, one)


def cost(problem: Problem, weights: dict[int, Metric], every: dict[int, WeightedResiduals], amplitude: float) -> float:
    """Twice what frames are missed by together [nat], with smooth force fields of that amplitude."""
    total = 0.0
    for frames in problem.by_part(weights).values():
        tool = np.array([np.asarray(every[k].tool)[:, None] for k in frames])
        fields = np.sum([np.asarray(every[k].fields) for k in frames], axis=0)
        middle = np.sum([np.asarray(weights[k].among) for k in frames], axis=0) + np.eye(N_FIELDS) / amplitude**2
        total += sum(float(every[k].squared) for k in frames)
        total += less_offset(tool, problem.history.frames[frames[0]].frame)[0, 0]
        total -= fields @ np.linalg.solve(middle, fields)
    return float(total)


def _each(
    problem: Problem,
    point: Point,
    frames: Iterable[int],
    of: Callable[[int, ClosedFrame, FrameContext, Float[Array, "n 3"]], T],
) -> dict[int, T]:
    """A function of each frame, of what an effect may know of it, and of its state, at a point."""
    states, history = jnp.asarray(point.states), problem.history
    moments = {k: history.moment(k, states) for k in frames}
    return parallel_map(lambda k: of(k, history.frames[k].frame, moments[k], states[k]), moments)
