"""The noise scales that are likeliest at a fit: a search over the variance of force errors, with the others profiled.

A variance of force errors needs new weights of all frames. Those of the smooth fields and of the tool do not: with the
fields' inner products in their eigenvectors, both likelihoods are sums of a few numbers.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize_scalar

from .every_frame import residual, weighed
from .gauss_newton import Fitted
from .noise_scales import NoiseScales, log_prior
from .normal_equations import pull_sum, tool_sum
from .problem import AMPLITUDE

STEP = float(np.log(3.0))
"""Smallest step outwards in the logarithm of the force variance [nat]."""
MAX_STEP = 3 * STEP
"""Largest step outwards [nat]."""
MAX_BRACKET = 1.5 * STEP
"""Largest distance of the best place from its neighbours with which the search ends [nat]."""
MAX_EVALUATIONS = 9
"""Largest number of variances that the search tries."""
NEAR = 0.1
"""Distance from a place that was tried within which the search ends [nat]."""
LOG_RANGE = (-3.0, 14.0)
"""Range of the logarithms of all variances [nat]. Where a sheet was measured in one plane, or the tool is the mean of
what it holds, some residuals are 0, and the likelihood would rise towards a variance of 0."""


@dataclass(frozen=True, kw_only=True)
class _Misfit:
    """What the likelihood of the fields' variance needs, at one variance of force errors."""

    force: float
    """The variance of force errors, over the assumed one."""
    squared: float
    """Squared residuals without fields, and the log determinants [nat, doubled]."""
    eigenvalues: Float[np.ndarray, "grasps q"]
    """Eigenvalues of the fields' inner products, with a variance of 1."""
    along: Float[np.ndarray, "grasps q"]
    """Squared inner products of the fields with the residuals, along the eigenvectors."""

    def log_likelihood(self, variance: float) -> float:
        """Return the log likelihood of a variance of the fields [nat]."""
        square = AMPLITUDE**2 * variance / self.force
        gain = np.sum(square * self.along / (1 + square * self.eigenvalues) - np.log1p(square * self.eigenvalues))
        return 0.5 * float(gain - self.squared)


def likeliest_scales(fitted: Fitted, *, near: NoiseScales | None = None) -> NoiseScales:
    """Return the noise scales of largest posterior at a fit's point.

    Args:
        fitted: a fit.
        near: scales that the search begins at too; those of the fit alone if None.
    """
    amplitudes: dict[float, float] = {}

    def log_posterior(log_force: float) -> float:
        misfit = _misfit(fitted, float(np.exp(log_force)))
        amplitudes[log_force], value = _largest(misfit.log_likelihood)
        return value + log_prior(misfit.force)

    own = fitted.problem.scales
    log_force = maximum(log_posterior, float(np.log(own.force)), float(np.log((near or own).force)))
    tried = sorted(amplitudes)
    log_fields = np.interp(log_force, tried, np.log([amplitudes[one] for one in tried]))
    squared = tool_sum(fitted.problem, fitted.equations)
    degrees = 3 * len(fitted.equations)
    tool, _ = _largest(lambda variance: -0.5 * (squared / variance + degrees * np.log(variance)))
    pull, with_force = own.pull, fitted.problem.with_force(fitted.equations)
    if with_force:
        of_pull = pull_sum(fitted.problem, fitted.equations)
        pull, _ = _largest(lambda variance: -0.5 * (of_pull / variance + 3 * with_force * np.log(variance)))
    return NoiseScales(force=float(np.exp(log_force)), fields=float(np.exp(log_fields)), tool=tool, pull=pull)


def maximum(function: Callable[[float], float], *begun: float) -> float:
    """Return where a log likelihood has its maximum over the logarithm of a variance, within its range.

    From the places that it begins at, the search goes on outwards until the largest value is between two others. A
    likelihood falls exponentially below its maximum and linearly above it, as that of Gaussian residuals does. So it
    then goes to where the function -(a exp(-x) + b x) / 2 through these three places has its maximum. Where the
    variance is so small that the frames' matrices are singular to rounding, the function is no number; there the range
    ends.
    """
    lowest, highest = LOG_RANGE
    found: dict[float, float] = {}
    waiting = [float(np.clip(one, *LOG_RANGE)) for one in begun]
    following = waiting.pop(0)
    for _ in range(MAX_EVALUATIONS):
        value = function(following)
        if np.isfinite(value):
            found[following] = value
        else:
            lowest = following + max(NEAR, (min(found, default=following + 2 * STEP) - following) / 2)
        waiting = [one for one in waiting if not _tried(one, found)]
        if waiting:
            following = waiting.pop(0)
            continue
        following = _following(found, lowest, highest) if found else lowest
        if _tried(following, found):
            break
    best = max(found, key=lambda x: found[x], default=begun[0])
    return following if abs(following - best) < NEAR and min(found) < best < max(found) else best


def _tried(place: float, found: dict[float, float]) -> bool:
    """Return whether a place near this one was tried."""
    return any(abs(place - x) < NEAR for x in found)


def _following(found: dict[float, float], lowest: float, highest: float) -> float:
    """Return the place to try next within a range: beyond the best one if it is the first or the last, else between."""
    places = sorted(found)
    best = places.index(max(places, key=lambda x: found[x]))
    if len(places) == 1:
        return max(places[0] - STEP, lowest) if places[0] > lowest else places[0] + STEP
    if best == 0 and places[0] > lowest:
        return max(places[0] - float(np.clip(2 * (places[1] - places[0]), STEP, MAX_STEP)), lowest)
    if best == len(places) - 1 and places[-1] < highest:
        return min(places[-1] + float(np.clip(2 * (places[-1] - places[-2]), STEP, MAX_STEP)), highest)
    if len(places) == 2:
        return sum(places) / 2
    middle = min(max(best, 1), len(places) - 2)
    around = np.array(places[middle - 1 : middle + 2])
    columns = np.column_stack([np.diff(np.exp(around[1] - around)), np.diff(around)])
    a, b = np.linalg.solve(columns, -2 * np.diff([found[x] for x in around]))
    following = float(np.clip(around[1] + np.log(a / b), lowest, highest)) if a > 0 and b > 0 else places[best]
    below, above = np.diff(around)
    if not _tried(following, found) or max(below, above) <= MAX_BRACKET:
        return following
    return float(around[1] + STEP if above > below else around[1] - STEP)


def _largest(log_likelihood: Callable[[float], float]) -> tuple[float, float]:
    """Return the variance of largest posterior, and the logarithm of the latter [nat]."""

    def minus(log_variance: float) -> float:
        return -log_likelihood(float(np.exp(log_variance))) - log_prior(float(np.exp(log_variance)))

    found = minimize_scalar(minus, bounds=LOG_RANGE, method="bounded")
    return float(np.exp(found.x)), -float(found.fun)


def _misfit(fitted: Fitted, force: float) -> _Misfit:
    """Return the residuals of a fit under another variance of force errors."""
    problem = fitted.problem
    same = np.isclose(force, problem.scales.force, rtol=1e-12, atol=0)
    problem = problem.with_scales(replace(problem.scales, force=force))
    weights = fitted.weights if same else weighed(problem, fitted.point, list(fitted.weights))
    every = residual(problem, weights, fitted.point)
    eigenvalues, along = [], []
    for frames in problem.by_part(weights).values():
        values, vectors = np.linalg.eigh(np.sum([np.asarray(weights[k].among) for k in frames], axis=0))
        eigenvalues.append(np.maximum(values, 0))
        along.append((vectors.T @ np.sum([np.asarray(every[k].fields) for k in frames], axis=0)) ** 2)
    squared = sum(float(every[k].squared) + float(weights[k].force_log_determinant()) for k in weights)
    return _Misfit(force=force, squared=squared, eigenvalues=np.array(eigenvalues), along=np.array(along))
