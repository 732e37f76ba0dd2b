"""The noise scales that are likeliest at a fit's point.

Those of the noise (`likeliest_noise`), the smooth fields, the tool and its force follow from the residuals that there
are. The variance v of force errors changes the weights of all frames. At its maximum the likelihood has

    v = sum |f|^2 / degrees,

with f the mean errors in units of the assumed ones, and the number of errors that the frames determine [MacKay 1992,
doi:10.1162/neco.1992.4.3.415]. Both change with v, so that this is repeated; from the second time on by a secant.
"""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from ..parallel_map import parallel_map
from .every_frame import in_common, weighted_together
from .frame_errors import ForceErrors, force_errors
from .frame_likelihood import N_FIELDS, FrameLikelihood, with_force_sd, with_noise
from .gauss_newton import Weighed, evaluated
from .likeliest_noise import likeliest_noise
from .linear import WeightedResiduals
from .noise_scales import LOG_RANGE, likeliest_under, likeliest_variance, log_prior
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
    return float(np.log(likeliest_variance(float(errors.squared) * problem.scales.force, float(errors.degrees))))


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
    return _with_likeliest_others(problem, at.point, weights, at.residuals)


def with_likeliest_others(at: Weighed) -> Weighed:
    """Return a point with the likeliest scales but for the variance of force errors, which it keeps."""
    return _with_likeliest_others(at.problem, at.point, at.weights, at.residuals)


def _with_likeliest_others(
    problem: Problem, point: Point, weights: dict[int, FrameLikelihood], residuals: dict[int, WeightedResiduals]
) -> Weighed:
    """Return a point with its likeliest other scales, from residuals that other weights may have weighted."""
    problem, weights, residuals = _with_likeliest_noise(problem, weights, residuals)
    scales, with_force = problem.scales, problem.with_force(weights)
    scales = replace(
        scales,
        fields=_likeliest_fields(problem, weights, residuals),
        tool=likeliest_variance(tool_sum(problem, residuals), 3 * len(weights)),
        pull=likeliest_variance(pull_sum(problem, residuals), 3 * with_force) if with_force else scales.pull,
    )
    return evaluated(problem.with_scales(scales), point, weights, residuals)


def _with_likeliest_noise(
    problem: Problem, weights: dict[int, FrameLikelihood], residuals: dict[int, WeightedResiduals]
) -> tuple[Problem, dict[int, FrameLikelihood], dict[int, WeightedResiduals]]:
    """Return what there is with the likeliest autocorrelation of the errors and variance of the smooth noise."""
    scales = likeliest_noise(problem, weights, residuals)
    factor = jnp.asarray((scales.smooth / problem.scales.smooth) ** 0.5)
    problem = problem.with_scales(scales)
    changed = parallel_map(lambda k: with_noise(weights[k], factor, problem.persistence(k, weights)), weights)
    return problem, changed, weighted_together(problem, changed, {k: one.own for k, one in residuals.items()})


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

    return likeliest_under(log_likelihood)
