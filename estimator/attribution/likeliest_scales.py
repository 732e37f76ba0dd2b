"""The noise scales that are likeliest at a fit's point.

Those of the walk, the smooth fields, the tool and its force follow from the residuals that there are. The variance v of
force errors changes the weights of all frames. At its maximum the likelihood has

    v = sum |f|^2 / degrees,

with f the mean errors in units of the assumed ones, and the number of errors that the frames determine [MacKay 1992,
doi:10.1162/neco.1992.4.3.415]. Both change with v, so that this is repeated; from the second time on by a secant.
"""

from collections.abc import Callable
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize_scalar

from ..parallel_map import parallel_map
from .every_frame import in_common, residual
from .frame_errors import ForceErrors, force_errors
from .frame_likelihood import N_FIELDS, FrameLikelihood, with_force_sd
from .gauss_newton import Weighed, evaluated
from .linear import WeightedResiduals
from .noise_scales import log_prior
from .normal_equations import pull_sum, tool_sum
from .problem import AMPLITUDE, Point, Problem

SETTLED = 0.25
"""Gain that is expected of another variance of force errors, up to which it has settled [nat]."""
MAX_CHANGES = 5
"""Largest number of times that it is changed."""
MAX_LOG_CHANGE = 3.0
"""Largest change of its logarithm at once."""
MIN_DETERMINED = 1e-3
"""Lower bound of the share of the force errors that the frames determine, by which steps are divided."""
PRIOR_STEP = 1e-4
"""Change of the logarithm of a variance in the difference that is the slope of its prior."""
WALK_TOLERANCE = 0.02
"""Tolerance of the logarithm of the variance of the walk's steps, each value of which costs a pass over all frames."""
LOG_RANGE = (-3.0, 14.0)
"""Range of the logarithms of all variances [nat]. Where a sheet was measured in one plane, or the tool is the mean of
what it holds, some residuals are 0, and the likelihood would rise towards a variance of 0."""


def with_likeliest_scales(at: Weighed) -> Weighed:
    """Return a point with the noise scales of largest posterior.

    Where they would make a frame's matrix singular to rounding, the last ones remain.
    """
    at, before = with_likeliest_others(at), None
    for _ in range(MAX_CHANGES):
        place, errors = float(np.log(at.problem.scales.force)), force_errors(at)
        step, slope = likelier_force(at.problem, errors) - place, force_slope(at.problem, errors)
        least = determined(errors)
        if not 0.5 * slope * step / least > SETTLED:
            break
        bend = 1.0 if before is None else max((before[1] - step) / (place - before[0]), least)
        before = (place, step)
        change = float(np.clip(step / bend, -MAX_LOG_CHANGE, MAX_LOG_CHANGE))
        there = with_force(at, float(np.clip(place + change, *LOG_RANGE)))
        if not np.isfinite(there.log_likelihood):
            break
        at = there
    return at


def likelier_force(problem: Problem, errors: ForceErrors) -> float:
    """Return the logarithm of a likelier variance of force errors, over the assumed one, from what all frames say."""
    return float(np.log(_likeliest(float(errors.squared) * problem.scales.force, float(errors.degrees))))


def force_slope(problem: Problem, errors: ForceErrors) -> float:
    """Return the slope of the log posterior by the logarithm of the variance of force errors [nat]."""
    of_likelihood = 0.5 * float(errors.squared - errors.degrees)
    above, below = (log_prior(problem.scales.force * float(np.exp(change))) for change in (PRIOR_STEP, -PRIOR_STEP))
    return of_likelihood + (above - below) / (2 * PRIOR_STEP)


def determined(errors: ForceErrors) -> float:
    """Return the share of all force errors that the frames determine.

    It is the least curvature of the log likelihood by the logarithm of their variance, over that of as many errors that
    are known exactly.
    """
    return max(float(errors.degrees / errors.count), MIN_DETERMINED)


def with_force(at: Weighed, log_force: float) -> Weighed:
    """Return a point with a variance of force errors, over the assumed one, and the likeliest other scales."""
    problem = at.problem.with_scales(replace(at.problem.scales, force=float(np.exp(log_force))))
    frames, noise = problem.history.frames, jnp.asarray(problem.noise)
    force_sd = problem.sheet.balance.force_sd
    weights = parallel_map(lambda k: with_force_sd(at.weights[k], force_sd, frames[k].frame, noise), at.weights)
    return _with_likeliest_others(problem, at.point, weights, residual(problem, weights, at.point))


def with_likeliest_others(at: Weighed) -> Weighed:
    """Return a point with the likeliest scales but for the variance of force errors, which it keeps."""
    return _with_likeliest_others(at.problem, at.point, at.weights, at.residuals)


def _with_likeliest_others(
    problem: Problem, point: Point, weights: dict[int, FrameLikelihood], residuals: dict[int, WeightedResiduals]
) -> Weighed:
    problem = problem.with_scales(replace(problem.scales, walk=_likeliest_walk(problem, weights, residuals)))
    scales, with_force = problem.scales, problem.with_force(weights)
    scales = replace(
        scales,
        fields=_likeliest_fields(problem, weights, residuals),
        tool=_likeliest(tool_sum(problem, residuals), 3 * len(weights)),
        pull=_likeliest(pull_sum(problem, residuals), 3 * with_force) if with_force else scales.pull,
    )
    return evaluated(problem.with_scales(scales), point, weights, residuals)


def _likeliest_walk(
    problem: Problem, weights: dict[int, FrameLikelihood], residuals: dict[int, WeightedResiduals]
) -> float:
    """Return the likeliest variance of the steps of the tracker's walk, over the assumed one."""
    if not problem.noise.size:
        return problem.scales.walk

    def log_likelihood(variance: float) -> float:
        with_walk = problem.with_scales(replace(problem.scales, walk=variance))
        return -0.5 * sum(one.misfit + one.log_det for one in in_common(with_walk, weights, residuals))

    return _largest(log_likelihood, tolerance=WALK_TOLERANCE)


def _likeliest_fields(
    problem: Problem, weights: dict[int, FrameLikelihood], residuals: dict[int, WeightedResiduals]
) -> float:
    """Return the likeliest variance of the smooth force fields, over the assumed one."""
    eigenvalues, along = [], []
    for one in in_common(problem, weights, residuals):
        values, vectors = np.linalg.eigh(one.precision - np.eye(N_FIELDS) / problem.amplitude**2)
        eigenvalues.append(np.maximum(values, 0))
        along.append((vectors.T @ one.products) ** 2)

    def log_likelihood(variance: float) -> float:
        square = AMPLITUDE**2 * variance / problem.scales.force
        each = 1 + square * np.array(eigenvalues)
        return 0.5 * float(np.sum(square * np.array(along) / each - np.log(each)))

    return _largest(log_likelihood)


def _likeliest(squared: float, degrees: float) -> float:
    """Return the likeliest variance of a number of residuals, from their squared sum."""
    return _largest(lambda variance: -0.5 * (squared / variance + degrees * float(np.log(variance))))


def _largest(log_likelihood: Callable[[float], float], tolerance: float = 1e-5) -> float:
    """Return the variance of largest posterior, up to a tolerance of its logarithm."""

    def minus(log_variance: float) -> float:
        return -log_likelihood(float(np.exp(log_variance))) - log_prior(float(np.exp(log_variance)))

    return float(np.exp(minimize_scalar(minus, bounds=LOG_RANGE, method="bounded", options={"xatol": tolerance}).x))
