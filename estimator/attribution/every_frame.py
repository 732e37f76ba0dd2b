"""All frames of a recording at a point: their weights, normal equations, residuals and likelihood."""

from collections.abc import Callable, Iterable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..effects.sheet_model import FrameContext
from ..parallel_map import T, parallel_map
from .bed_contact import contact_share
from .frame_likelihood import FrameLikelihood, frame_likelihood, with_noise
from .grasped_frames import ClosedFrame
from .linear import (
    Columns,
    NormalEquations,
    Residuals,
    WeightedResiduals,
    columns_of,
    normal_equations,
    residuals_of,
    weighted_residuals,
)
from .normal_equations import Common, common, pull_sum, tool_sum
from .persistence import carried
from .problem import Point, Problem

N_DIRECTIONS = 16
"""Number of parameters that most fits pad to, so that one compilation serves them."""


def directions(problem: Problem, free: np.ndarray) -> Float[np.ndarray, "p d"]:
    """Return unit vectors along parameters, padded to a width that most fits share."""
    along = np.zeros((problem.sheet.size, max(N_DIRECTIONS, len(free))))
    along[free, np.arange(len(free))] = 1
    return along


def weighed(
    problem: Problem, point: Point, frames: list[int], *, among: Iterable[int] | None = None
) -> dict[int, FrameLikelihood]:
    """Return the weights of residuals of each frame at a point, with errors that follow those of other frames.

    Args:
        problem: has the frames.
        point: parameters and states.
        frames: frames to weigh.
        among: the frames whose errors theirs may follow; the frames themselves if None.
    """
    theta, s, noise = (jnp.asarray(a) for a in (point.theta, point.s, problem.noise))
    assumed = problem.with_scales(problem.assumed_scales).sheet

    def one(k: int, frame: ClosedFrame, context: FrameContext, x: Float[Array, "n 3"]) -> FrameLikelihood:
        persistence = problem.persistence(k, frames if among is None else among)
        variance = jnp.asarray(frame.noise_variance(problem.assumed_noise))
        contact = contact_share(assumed, theta, frame, context, x, variance)  # the same for all noise scales
        return frame_likelihood(problem.sheet, theta, s, frame, context, x, noise, persistence, contact)

    return each_frame(problem, point, frames, one)


def following(problem: Problem, likelihood: FrameLikelihood, k: int, frames: Iterable[int]) -> FrameLikelihood:
    """Return the weights of a frame's residuals with errors that follow those of some other frames before it."""
    return with_noise(likelihood, jnp.ones(()), problem.persistence(k, frames))


def linearised(
    problem: Problem,
    point: Point,
    weights: dict[int, FrameLikelihood],
    residuals: dict[int, WeightedResiduals],
    along: Float[np.ndarray, "p d"],
) -> dict[int, NormalEquations]:
    """Return the normal equations of each frame, linearised where its weights were computed."""
    theta, along_ = jnp.asarray(point.theta), jnp.asarray(along)

    def one(k: int, frame: ClosedFrame, context: FrameContext, x: Float[Array, "n 3"]) -> Columns:
        return columns_of(problem.sheet, weights[k], theta, along_, frame, context)

    columns = each_frame(problem, point, weights, one)
    moved = {k: found.sheet for k, found in columns.items()}

    def equations(k: int) -> NormalEquations:
        before = carried(problem.last_seen(k, weights), moved, moved[k])
        return normal_equations(weights[k], columns[k], before, residuals[k])

    return parallel_map(equations, weights)


def misfit_under(problem: Problem, weights: dict[int, FrameLikelihood], point: Point) -> float:
    """Return the weighted squared residuals of a point's predictions [nat, doubled], under weights of another point."""
    every = residual(problem, weights, point)
    return misfit_of(problem, every, in_common(problem, weights, every))


def log_determinants(problem: Problem, weights: dict[int, FrameLikelihood], grasps: Iterable[Common]) -> float:
    """Return the log determinant of all observations' covariance, what frames share and the tool included [nat]."""
    total = 3 * len(weights) * float(np.log(problem.scales.tool)) + sum(one.log_det for one in grasps)
    if problem.scales.pull is not None:
        total += 3 * problem.with_force(weights) * float(np.log(problem.scales.pull))
    every = parallel_map(lambda k: float(weights[k].log_determinant()), weights)
    return total + sum(every.values())


def residual(problem: Problem, weights: dict[int, FrameLikelihood], point: Point) -> dict[int, WeightedResiduals]:
    """Return the weighted residuals of a point's predictions in each frame, under weights of another point."""
    theta, s = jnp.asarray(point.theta), jnp.asarray(point.s)

    def one(k: int, frame: ClosedFrame, context: FrameContext, x: Float[Array, "n 3"]) -> Residuals:
        return residuals_of(problem.sheet, weights[k], theta, s, frame, context, x)

    return weighted_together(problem, weights, each_frame(problem, point, weights, one))


def weighted_together(
    problem: Problem, weights: dict[int, FrameLikelihood], every: dict[int, Residuals]
) -> dict[int, WeightedResiduals]:
    """Return the weighted residuals of frames from the residuals of each."""
    sheets = {k: found.sheet for k, found in every.items()}

    def one(k: int) -> WeightedResiduals:
        before = carried(problem.last_seen(k, weights), sheets, sheets[k])
        return weighted_residuals(weights[k], every[k], before)

    return parallel_map(one, weights)


def in_common(
    problem: Problem, weights: dict[int, FrameLikelihood], every: dict[int, WeightedResiduals]
) -> list[Common]:
    """Return what the residuals of each grasp's frames say of what these have in common."""
    return [common(problem, weights, every, frames) for frames in problem.by_grasp(weights).values()]


def misfit_of(problem: Problem, every: dict[int, WeightedResiduals], grasps: Iterable[Common]) -> float:
    """Return weighted squared residuals [nat, doubled], with what the frames of a grasp have in common eliminated."""
    total = tool_sum(problem, every) / problem.scales.tool
    if problem.scales.pull is not None:
        total += pull_sum(problem, every) / problem.scales.pull
    return float(total + sum(one.misfit for one in grasps))


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
