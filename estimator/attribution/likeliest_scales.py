"""The noise scales that are likeliest at a fit: a search over the variance of force errors, with the others profiled.

A variance of force errors needs new weights of all frames. Those of the smooth fields and of the tool do not: with the
fields' inner products in their eigenvectors, both likelihoods are sums of a few numbers.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import minimize_scalar

from .every_frame import residual, weighed
from .frame_likelihood import FrameLikelihood
from .gauss_newton import Fitted
from .noise_scales import NoiseScales, log_prior
from .normal_equations import tool_sum
from .problem import AMPLITUDE

STEP = float(np.log(3.0))
"""Step of the search in the logarithm of the force variance [nat]."""
MAX_STEPS = 6
"""Largest number of steps of the search."""
LOG_RANGE = (-1.5, 14.0)
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


def likeliest_scales(fitted: Fitted) -> NoiseScales:
    """Return the noise scales of largest posterior at a fit's point."""
    began = float(np.log(fitted.problem.scales.force))
    found: dict[int, tuple[float, float]] = {}

    def at(step: int) -> tuple[float, float]:
        if step not in found:
            moved = float(np.exp(np.clip(began + step * STEP, *LOG_RANGE)))
            force = moved if step else fitted.problem.scales.force  # whose weights the fit has
            misfit = _misfit(fitted, force)
            amplitude, value = _largest(misfit.log_likelihood)
            found[step] = value + log_prior(force), amplitude
        return found[step]

    best = 0
    for _ in range(MAX_STEPS):
        around = max((best, best - 1, best + 1), key=lambda step: at(step)[0])
        if around == best:
            break
        best = around
    (below, _), (middle, amplitude), (above, _) = at(best - 1), at(best), at(best + 1)
    bend = below - 2 * middle + above
    top = 0.5 * (below - above) / bend if bend < 0 else 0.0
    squared = tool_sum(fitted.problem, fitted.equations)
    degrees = 3 * len(fitted.equations)
    tool, _ = _largest(lambda variance: -0.5 * (squared / variance + degrees * np.log(variance)))
    log_force = np.clip(began + STEP * (best + np.clip(top, -0.5, 0.5)), *LOG_RANGE)
    return NoiseScales(force=float(np.exp(log_force)), fields=amplitude, tool=tool)


def _largest(log_likelihood: Callable[[float], float]) -> tuple[float, float]:
    """Return the variance of largest posterior, and the logarithm of the latter [nat]."""

    def minus(log_variance: float) -> float:
        return -log_likelihood(float(np.exp(log_variance))) - log_prior(float(np.exp(log_variance)))

    found = minimize_scalar(minus, bounds=LOG_RANGE, method="bounded")
    return float(np.exp(found.x)), -float(found.fun)


def _misfit(fitted: Fitted, force: float) -> _Misfit:
    """Return the residuals of a fit under another variance of force errors."""
    problem = fitted.problem
    same = force == problem.scales.force
    problem = problem.with_scales(replace(problem.scales, force=force))
    weights = fitted.weights if same else weighed(problem, fitted.point, list(fitted.weights))
    every = residual(problem, weights, fitted.point)
    eigenvalues, along = [], []
    for frames in problem.by_part(weights).values():
        values, vectors = np.linalg.eigh(np.sum([np.asarray(weights[k].among) for k in frames], axis=0))
        eigenvalues.append(np.maximum(values, 0))
        along.append((vectors.T @ np.sum([np.asarray(every[k].fields) for k in frames], axis=0)) ** 2)
    squared = sum(float(every[k].squared) + float(_log_determinant(weights[k])) for k in weights)
    return _Misfit(force=force, squared=squared, eigenvalues=np.array(eigenvalues), along=np.array(along))


@eqx.filter_jit
def _log_determinant(likelihood: FrameLikelihood) -> Float[Array, ""]:
    """Return the part of the log determinant that depends on the variances, as a compiled program."""
    return likelihood.force_log_determinant()
