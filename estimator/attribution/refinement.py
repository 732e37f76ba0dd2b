"""Refine a fit by the whole slope of its likelihood: of the parameters, and of s of the particles that are attached.

Gauss-Newton steps take the weights of the residuals and the determinants as given, so they end where only the residuals
fit best. Where a model is wrong, the likelihood goes on rising from there by hundreds of nat.
"""

from collections.abc import Callable

import numpy as np

from .gauss_newton import MAX_CHANGE, MIN_GAIN, Fitted, Step, Weighed, after_step, applied, improved
from .likelihood_slope import likelihood_slopes
from .normal_equations import whole_slope

MAX_REFINEMENTS = 8
"""Largest number of refining steps."""
MIN_PROMISE = 10.0
"""Fall of the cost, by its slope, from which a refining step is tried [nat, doubled]: half of it is left at its end."""
MAX_LENGTHS = 3
"""Largest number of lengths of a step that are tried."""
MIN_INFORMATION = 1e-6
"""Information about each s that is assumed at least: no frame may show an attachment."""
SHARES = (0.1, 0.5)
"""Range of the length of each, in that of the one before."""


def refined(begun: Fitted, *, log: Callable[[str], None] = lambda _: None) -> Fitted:
    """Return the fit after refining steps, with the noise scales that it has."""
    return improved(begun, refined_point, passes=MAX_REFINEMENTS, step="refinement", log=log)


def refined_point(now: Fitted) -> Weighed | None:
    """Return a point of lower cost along the step by the whole slope; None if none is found.

    Each try after the whole step is where the parabola through the cost and its slope at the start, and the cost at the
    try before, is least.
    """
    step, slope = refining_step(now)
    share = 1.0
    for _ in range(MAX_LENGTHS):
        if not -slope * share > MIN_PROMISE:
            return None
        there, cost = after_step(now, step, share)
        if cost < now.cost - MIN_GAIN:
            return there
        rise = cost - now.cost - slope * share
        share *= float(np.clip(-slope * share / (2 * rise), *SHARES))
    return None


def refining_step(now: Fitted) -> tuple[Step, float]:
    """Return the step of the parameters and of the attached particles' s by the whole slope, and the cost's slope.

    The normal equations have the slope and the curvature of the residuals alone. The determinants add to both. A spring
    against a compliance k adds -3 ln(1 + k s) to the log determinant of a frame, with slope -3 k and curvature 3 k^2:
    the curvature of half of it is two thirds of the square of its own slope.
    """
    n, sd, point = len(now.point.s), now.problem.sd(now.named), now.point
    slope = whole_slope(now.problem, now.equations, likelihood_slopes(now.problem, point, now.weights), now.free)
    kept = np.concatenate([np.flatnonzero(point.s > 0), n + np.arange(len(sd))])
    of_s, of_theta = np.split(np.arange(len(kept)), [len(kept) - len(sd)])
    hessian, slope = now.square[np.ix_(kept, kept)].copy(), slope[kept]
    of_determinants = slope[of_s] - now.square[kept[of_s], -1]
    hessian[of_s, of_s] += of_determinants**2 / (3 * len(now.equations)) + MIN_INFORMATION
    hessian[of_theta, of_theta] += sd**-2
    slope[of_theta] += point.theta[now.free] / sd**2
    best = -np.linalg.solve(hessian, slope)
    theta, s = np.zeros(len(point.theta)), np.zeros(n)
    theta[now.free] = np.clip(best[of_theta], -MAX_CHANGE * sd, MAX_CHANGE * sd)
    s[kept[of_s]] = best[of_s]
    to_theta, to_s = applied(now, (theta, s), 1.0)
    change = np.concatenate([to_s - point.s, (to_theta - point.theta)[now.free]])[kept]
    return (theta, s), 2 * float(slope @ change)
