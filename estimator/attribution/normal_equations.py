"""Sums of the frames' normal equations, with what is common to a grasp eliminated."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..belief.gaussian_information import GaussianInformation
from .frame_likelihood import N_FIELDS, FrameLikelihood
from .grasped_frames import ClosedFrame
from .linear import NormalEquations, WeightedResiduals, grasp_sd, tool_sd
from .problem import Problem
from .tool_pull import pull_products


class Common(NamedTuple):
    """What the residuals of a grasp's frames say of what these have in common."""

    squared: float
    """Sum of the squared residuals [nat, doubled]."""
    precision: Float[np.ndarray, "q q"]
    """Precision of the amplitudes c of its smooth force fields."""
    products: Float[np.ndarray, " q"]
    """Inner products of the fields with the residuals: the likeliest c are minus these, over the precision."""
    log_det: float
    """ln of the volume of c by its prior, over that by the frames [nat, doubled]."""

    @property
    def misfit(self) -> float:
        """Return the squared residuals with c eliminated too [nat, doubled]."""
        return self.squared - float(self.products @ np.linalg.solve(self.precision, self.products))


def common(
    problem: Problem, weights: dict[int, FrameLikelihood], residuals: dict[int, WeightedResiduals], frames: list[int]
) -> Common:
    """Return what the residuals of a grasp's frames say of its fields."""
    among = np.sum([np.asarray(weights[k].among) for k in frames], axis=0)
    products = np.sum([np.asarray(residuals[k].common) for k in frames], axis=0)
    precision = among + np.eye(N_FIELDS) / problem.amplitude**2
    with np.errstate(invalid="ignore"):  # where a point has no finite weights, the caller refuses it
        log_det = float(np.linalg.slogdet(problem.amplitude**2 * precision)[1])
    squared = sum(float(residuals[k].squared) for k in frames)
    return Common(squared=squared, precision=precision, products=products, log_det=log_det)


def reduced(problem: Problem, equations: dict[int, NormalEquations], d: int) -> Float[np.ndarray, "k k"]:
    """Return the normal equations of all frames over s, the first d directions and -1."""
    total: np.ndarray | float = 0.0
    for frames in problem.by_grasp(equations).values():
        whole = sum(np.asarray(equations[k].square) for k in frames) + tool_products(problem, equations, frames)
        n = len(whole) - equations[frames[0]].tool.shape[1]
        fields = slice(-1 - N_FIELDS, -1)
        kept = np.r_[0 : n + d, len(whole) - 1]
        middle = whole[fields, fields] + np.eye(N_FIELDS) / problem.amplitude**2
        beside = whole[fields][:, kept]
        total = total + whole[np.ix_(kept, kept)] - beside.T @ np.linalg.solve(middle, beside)
    return np.asarray(total)


def tool_products(
    problem: Problem, equations: dict[int, NormalEquations], frames: list[int]
) -> Float[np.ndarray, "k k"]:
    """Return the part that the residuals of the tool and of its force have in the normal equations of a grasp."""
    closed = [problem.history.frames[k].frame for k in frames]
    rows = np.array([np.asarray(equations[k].tool) for k in frames])
    size = len(equations[frames[0]].square)
    n = size - rows.shape[2]
    total = np.zeros((size, size))
    total[n:, n:] = less_offset(rows, closed[0]) / problem.scales.tool
    if problem.scales.pull is not None and problem.with_force(frames):
        pulls = np.array([np.asarray(equations[k].pull) for k in frames])
        total += pull_products(pulls, closed) / problem.scales.pull
    return total


def tool_sum(problem: Problem, residuals: dict[int, WeightedResiduals]) -> float:
    """Return the sum of the tool's squared residuals over all frames, over the assumed variances."""
    total = 0.0
    for frames in problem.by_grasp(residuals).values():
        rows = np.array([np.asarray(residuals[k].own.tool)[:, None] for k in frames])
        total += float(less_offset(rows, problem.history.frames[frames[0]].frame)[0, 0])
    return total


def pull_sum(problem: Problem, residuals: dict[int, WeightedResiduals]) -> float:
    """Return the sum of the squared residuals of the tool's force over all frames, over the assumed variances."""
    total = 0.0
    for frames in problem.by_grasp(one for one in residuals if problem.with_force([one])).values():
        rows = np.array([np.asarray(residuals[k].own.pull)[:, None] for k in frames])
        total += float(pull_products(rows, [problem.history.frames[k].frame for k in frames])[0, 0])
    return total


def without_stiffnesses(
    square: Float[np.ndarray, "k k"], site_precision: Float[np.ndarray, " n"]
) -> GaussianInformation:
    """Return the information about all parameters but s, with s marginalised under the sites of the belief."""
    n = len(site_precision)
    joint = GaussianInformation.from_normal_equations(square, s=n, theta=len(square) - 1 - n)
    return joint.with_independent("s", site_precision).marginal("theta")


def less_offset(rows: Float[np.ndarray, "t 3 a"], frame: ClosedFrame) -> Float[np.ndarray, "a a"]:
    """Return the inner products of the tool's rows over a grasp's frames, with their common offset eliminated.

    `frame` is one of them, and gives the standard deviations.
    """
    (_, share), together = offset_share(frame, len(rows)), rows.sum(0)
    return np.einsum("tia,tib->ab", rows, rows) - share * np.einsum("ia,ib->ab", together, together)


def offset_share(frame: ClosedFrame, count: int) -> tuple[float, float]:
    """Return the variance of the tool's offset in a grasp, in units of `tool_sd`, and the offset of largest density.

    The latter is over the sum of the residuals of the grasp's `count` frames.
    """
    ratio = float(grasp_sd(frame) / tool_sd(frame)) ** 2
    return ratio, ratio / (1 + ratio * count)
