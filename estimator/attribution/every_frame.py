"""All frames of a recording at a point: their weights, normal equations, residuals and likelihood."""

from collections.abc import Callable, Iterable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..effects.sheet_model import FrameContext
from ..parallel_map import T, parallel_map
from .frame_likelihood import N_FIELDS, FrameLikelihood, frame_likelihood
from .grasped_frames import ClosedFrame
from .linear import NormalEquations, WeightedResiduals, misfit, normal_equations
from .normal_equations import pull_sum, tool_sum
from .problem import Point, Problem

N_DIRECTIONS = 16
"""Number of parameters that most fits pad to, so that one compilation serves them."""


def directions(problem: Problem, free: np.ndarray) -> Float[np.ndarray, "p d"]:
    """Return unit vectors along parameters, padded to a width that most fits share."""
    along = np.zeros((problem.sheet.size, max(N_DIRECTIONS, len(free))))
    along[free, np.arange(len(free))] = 1
    return along


def weighed(problem: Problem, point: Point, frames: list[int]) -> dict[int, FrameLikelihood]:
    """Return the weights of residuals of each frame at a point."""
    theta, s, noise = (jnp.asarray(a) for a in (point.theta, point.s, problem.noise))

    def one(k: int, frame: ClosedFrame, context: FrameContext, x: Float[Array, "n 3"]) -> FrameLikelihood:
        return frame_likelihood(problem.sheet, theta, s, frame, context, x, noise)

    return each_frame(problem, point, frames, one)


def linearised(
    problem: Problem, point: Point, weights: dict[int, FrameLikelihood], along: Float[np.ndarray, "p d"]
) -> dict[int, NormalEquations]:
    """Return the normal equations of each frame, linearised where its weights were computed."""
    theta, along_ = jnp.asarray(point.theta), jnp.asarray(along)

    def one(k: int, frame: ClosedFrame, context: FrameContext, x: Float[Array, "n 3"]) -> NormalEquations:
        return normal_equations(problem.sheet, weights[k], theta, along_, frame, context)

    return each_frame(problem, point, weights, one)


def misfit_under(problem: Problem, weights: dict[int, FrameLikelihood], point: Point) -> float:
    """Return the weighted squared residuals of a point's predictions [nat, doubled], under weights of another point."""
    return misfit_of(problem, weights, residual(problem, weights, point))


def log_determinants(problem: Problem, weights: dict[int, FrameLikelihood]) -> float:
    """Return the log determinant of all observations' covariance, the smooth fields and the tool included [nat]."""
    total = 3 * len(weights) * float(np.log(problem.scales.tool))
    if problem.scales.pull is not None:
        total += 3 * problem.with_force(weights) * float(np.log(problem.scales.pull))
    for frames in problem.by_part(weights).values():
        among = np.sum([np.asarray(weights[k].among) for k in frames], axis=0)
        with np.errstate(invalid="ignore"):  # where a point has no finite weights, the caller refuses it
            total += float(np.linalg.slogdet(np.eye(N_FIELDS) + problem.amplitude**2 * among)[1])
    every = parallel_map(lambda k: float(weights[k].log_determinant()), weights)
    return total + sum(every.values())


def residual(problem: Problem, weights: dict[int, FrameLikelihood], point: Point) -> dict[int, WeightedResiduals]:
    """Return the weighted residuals of a point's predictions in each frame, under weights of another point."""
    theta, s = jnp.asarray(point.theta), jnp.asarray(point.s)

    def one(k: int, frame: ClosedFrame, context: FrameContext, x: Float[Array, "n 3"]) -> WeightedResiduals:
        return misfit(problem.sheet, weights[k], theta, s, frame, context, x)

    return each_frame(problem, point, weights, one)


def misfit_of(problem: Problem, weights: dict[int, FrameLikelihood], every: dict[int, WeightedResiduals]) -> float:
    """Return weighted squared residuals [nat, doubled], with the smooth force fields eliminated grasp by grasp."""
    total = tool_sum(problem, every) / problem.scales.tool
    if problem.scales.pull is not None:
        total += pull_sum(problem, every) / problem.scales.pull
    for frames in problem.by_part(weights).values():
        precision, fields = field_information(problem, weights, every, frames)
        total += sum(float(every[k].squared) for k in frames)
        total -= fields @ np.linalg.solve(precision, fields)
    return float(total)


def field_information(
    problem: Problem, weights: dict[int, FrameLikelihood], every: dict[int, WeightedResiduals], frames: list[int]
) -> tuple[Float[np.ndarray, "q q"], Float[np.ndarray, " q"]]:
    """Return the precision of the amplitudes c of a grasp's smooth force fields, and their products with the residuals.

    The likeliest c are minus the products, over the precision.
    """
    among = np.sum([np.asarray(weights[k].among) for k in frames], axis=0)
    products = np.sum([np.asarray(every[k].fields) for k in frames], axis=0)
    return among + np.eye(N_FIELDS) / problem.amplitude**2, products


def each_frame(
    problem: Problem,
    point: Point,
    frames: Iterable[int],
    function: Callable[[int, ClosedFrame, FrameContext, Float[Array, "n 3"]], T],
) -> dict[int, T]:
    """Return a function of each frame, its context and its state at a point, for some frames in parallel."""
    states, history = jnp.asarray(point.states), problem.history
    contexts = {k: history.context(k, states) for k in frames}
    return parallel_map(lambda k: function(k, history.frames[k].frame, contexts[k], states[k]), contexts)
