"""Refine a fit by the whole slope of its likelihood: parameters, s of the attached particles, and noise scales.

Gauss-Newton steps take the weights of the residuals and the determinants as given, so they end where only the residuals
fit best. Where a model is wrong, the likelihood goes on rising from there by hundreds of nat.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from .frame_errors import ForceErrors
from .gauss_newton import MAX_CHANGE, MIN_GAIN, Fitted, Step, Weighed, after_step, applied, cost, improved
from .likeliest_scales import likelier_force, with_likeliest_others
from .likelihood_slope import likelihood_slopes, whole_slope
from .noise_scales import NoiseScales

MAX_REFINEMENTS = 8
"""Largest number of refining steps."""
MIN_PROMISE = 10.0
"""Fall of the cost, by its slope, from which a refining step is tried [nat, doubled]: half of it is left at its end."""
MAX_LENGTHS = 3
"""Largest number of lengths of a step that are tried."""
MIN_INFORMATION = 0.5
"""Information that is added about each ln s / (1 - s): no frame may show an attachment."""
MAX_LOG_CHANGE = 0.7
"""Largest change of ln s / (1 - s) in one step."""
SHARES = (0.1, 0.5)
"""Range of the length of each, in that of the one before."""


@dataclass(frozen=True, kw_only=True)
class _Slope:
    """The slope of -ln likelihood and prior at a fit by s and the free parameters."""

    slope: Float[np.ndarray, " k"]
    """The slope [nat]."""
    hessian: Float[np.ndarray, "k k"]
    """The curvature, by the normal equations and the determinants [nat]."""
    scales: NoiseScales
    """Noise scales that are likelier there."""


def refined(begun: Fitted, *, log: Callable[[str], None] = lambda _: None) -> Fitted:
    """Return the fit after refining steps."""
    return improved(begun, _better, passes=MAX_REFINEMENTS, step="refinement", log=log)


def _better(now: Fitted) -> Weighed | None:
    """Return a point of lower cost along the step, with likelier noise scales; None if none is found.

    Each try after the whole step is where the parabola through the cost and its slope at the start, and the cost at the
    try before, is least.
    """
    slope = _slope(now)
    step, promise = _step(now, slope)
    share = 1.0
    for _ in range(MAX_LENGTHS):
        if not promise * share > MIN_PROMISE:
            return None
        there = with_likeliest_others(after_step(now, step, share, slope.scales))
        rise = cost(there, now.named) - now.cost
        if rise < -MIN_GAIN:
            return there
        share *= float(np.clip(promise * share / (2 * (rise + promise * share)), *SHARES))
    return None


def _slope(now: Fitted) -> _Slope:
    """Return the slope at a fit.

    The normal equations have the slope and the curvature of the residuals alone. The determinants add to both. A spring
    against a compliance k adds -3 ln(1 + k s) to the log determinant of a frame, with slope -3 k and curvature 3 k^2:
    the curvature of half of it is two thirds of the square of its own slope.
    """
    n, sd, point = len(now.point.s), now.problem.sd(now.named), now.point
    of_frames = likelihood_slopes(now)
    slope = whole_slope(now, of_frames)
    hessian = now.square[:-1, :-1].copy()
    of_determinants = slope[:n] - now.square[:n, -1]
    hessian[range(n), range(n)] += of_determinants**2 / (3 * len(now.equations))
    hessian[range(n, n + len(sd)), range(n, n + len(sd))] += sd**-2
    slope[n:] += point.theta[now.free] / sd**2
    errors = ForceErrors.together(one.force_errors for one in of_frames.values())
    force = float(np.exp(likelier_force(now.problem, errors)))
    return _Slope(slope=slope, hessian=hessian, scales=replace(now.problem.scales, force=force))


def _step(now: Fitted, at: _Slope) -> tuple[Step, float]:
    """Return the step of parameters and of the attached particles' s, and by how much it promises to lower the cost.

    It is solved for the logarithms of s / (1 - s), in which the likelihood is closer to a parabola.
    """
    n, sd, point = len(now.point.s), now.problem.sd(now.named), now.point
    kept = np.concatenate([np.flatnonzero(point.s > 0), n + np.arange(len(sd))])
    unit = np.append(point.s * (1 - point.s), np.ones(len(sd)))
    largest = np.append(np.full(n, MAX_LOG_CHANGE), MAX_CHANGE * sd)
    least = np.append(np.full(n, MIN_INFORMATION), np.zeros(len(sd)))
    hessian = (at.hessian * np.outer(unit, unit) + np.diag(least))[np.ix_(kept, kept)]
    best = np.zeros(n + len(sd))
    best[kept] = -np.linalg.solve(hessian, (unit * at.slope)[kept])
    best = np.clip(best, -largest, largest)
    theta = np.zeros(len(point.theta))
    theta[now.free] = best[n:]
    step = (theta, unit[:n] * np.expm1(best[:n]) / (1 + point.s * np.expm1(best[:n])))
    to_theta, to_s = applied(now, step, 1.0)
    change = np.append(to_s - point.s, (to_theta - point.theta)[now.free])
    return step, -2 * float(at.slope @ change)
