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
from .normal_equations import tool_sum
from .problem import AMPLITUDE

STEP = float(np.log(3.0))
"""First steps of the search in the logarithm of the force variance [nat]."""
MAX_EVALUATIONS = 9
"""Largest number of variances that the search tries."""
NEAR = 0.25
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
        near: scales that the search begins at; those of the fit if None.
    """
    amplitudes: dict[float, float] = {}

    def log_posterior(log_force: float) -> float:
        misfit = _misfit(fitted, float(np.exp(log_force)))
        amplitudes[log_force], value = _largest(misfit.log_likelihood)
        return value + log_prior(misfit.force)

    log_force = maximum(log_posterior, float(np.log((near or fitted.problem.scales).force)))
    nearest = min(amplitudes, key=lambda tried: abs(tried - log_force))
    squared = tool_sum(fitted.problem, fitted.equations)
    degrees = 3 * len(fitted.equations)
    tool, _ = _largest(lambda variance: -0.5 * (squared / variance + degrees * np.log(variance)))
    return NoiseScales(force=float(np.exp(log_force)), fields=amplitudes[nearest], tool=tool)


def maximum(function: Callable[[float], float], begun: float) -> float:
    """Return where a log likelihood has its maximum over the logarithm of a variance, within its range.

    It falls exponentially below its maximum and linearly above it, as that of Gaussian residuals does. So the search
    goes to where the function -(a exp(-x) + b x) / 2 through three places has its maximum. Where the variance is so
    small that the frames' matrices are singular to rounding, the function is no number; there the range ends.
    """
    lowest, highest = LOG_RANGE
    begun = float(np.clip(begun, lowest + STEP, highest - STEP))
    found: dict[float, float] = {}
    following = begun + STEP
    for _ in range(MAX_EVALUATIONS):
        value = function(following)
        if np.isfinite(value):
            found[following] = value
        else:
            lowest = max(lowest, following + NEAR)
        places = sorted(found)
        if len(places) < 3:
            outwards = [x for x in (begun, begun - STEP) if x > lowest and x not in found]
            following = outwards[0] if outwards else max([lowest, *places]) + STEP
            if following > highest:
                break
            continue
        following = float(np.clip(_following(places, [found[x] for x in places]), lowest, highest))
        if min(abs(following - x) for x in places) < NEAR:
            return float(np.clip(following, places[0], places[-1]))
    return max(found, key=lambda x: found[x], default=begun)


def _following(places: list[float], values: list[float]) -> float:
    """Return the place to try next, of three or more places in order and their values."""
    best = int(np.argmax(values))
    middle = min(max(best, 1), len(places) - 2)
    around = np.array(places[middle - 1 : middle + 2])
    columns = np.column_stack([np.diff(np.exp(-around)), np.diff(around)])
    a, b = np.linalg.solve(columns, -2 * np.diff(values[middle - 1 : middle + 2]))
    if a > 0 and b > 0:
        return float(np.log(a / b))
    return 2 * places[best] - (places[-1] if best == 0 else places[0])


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
