"""What a fit leaves that its own errors do not account for: how much larger they would have to be.

The likelihood of larger force errors, of smooth force fields of larger amplitude and of a tool that reports its way
less well, against that of the usual ones. It stands for all causes that have no name here: an effect must do better
than that.
"""

from dataclasses import dataclass

import equinox as eqx
import numpy as np

from .every_frame import cost, residual, weighed
from .fit import Fitted
from .linear import N_FIELDS, Metric
from .normal_equations import less_offset
from .problem import Problem

RATIO = 4.0
VARIANCES = (1.0, RATIO, RATIO**2, RATIO**3)
"""Of the forces, in units of the usual; from where one is less likely than the one before on, none is tried."""
AMPLITUDES = (0.25, 1.0, 4.0, 16.0)
"""Of the smooth fields, in units of the usual."""


@dataclass(frozen=True, kw_only=True)
class UnexplainedResidual:
    """The likeliest of those errors."""

    gain: float
    """By how much the frames are likelier with them than with the usual ones, or smaller ones [nat]."""
    variance: float
    """Of the forces, in units of the usual."""
    amplitude: float
    """Of the smooth fields."""
    tool_variance: float
    """Of what the tool says of the held particles."""


def unexplained_residual(problem: Problem, fitted: Fitted) -> UnexplainedResidual:
    """Of a fit."""
    likelihoods: dict[tuple[float, float], float] = {}
    for variance in VARIANCES:
        if likelihoods and max(likelihoods, key=lambda key: likelihoods[key])[0] < variance / RATIO:
            break
        wider = problem.widened(variance, problem.amplitude)
        weights = fitted.weights if variance == 1.0 else weighed(wider, fitted.around, list(fitted.weights))
        every = residual(wider, weights, fitted.point)
        whole = sum(float(_log_determinant(one)) for one in weights.values())
        fields = [
            np.sum([np.asarray(weights[k].among) for k in frames], axis=0)
            for frames in problem.by_part(weights).values()
        ]
        for ratio in AMPLITUDES:
            amplitude = ratio * problem.amplitude
            common = sum(np.linalg.slogdet(np.eye(N_FIELDS) + amplitude**2 * one)[1] for one in fields)
            likelihoods[variance, ratio] = -(cost(problem, weights, every, amplitude) + whole + common) / 2
    best = max(likelihoods, key=lambda key: likelihoods[key])
    no_larger = max(likelihoods[1.0, ratio] for ratio in AMPLITUDES if ratio <= 1.0)
    gain = likelihoods[best] - no_larger
    tool, gain_of_tool = _of_tool(problem, fitted)
    return UnexplainedResidual(gain=float(gain + gain_of_tool), variance=best[0], amplitude=best[1], tool_variance=tool)


def _of_tool(problem: Problem, fitted: Fitted) -> tuple[float, float]:
    """The likeliest variance of what the tool says of the held particles, in units of the usual, and its gain [nat]."""
    squared = 0.0
    for frames in problem.by_part(fitted.equations).values():
        rows = np.array([np.asarray(fitted.equations[k].tool)[:, -1:] for k in frames])
        squared += float(less_offset(rows, problem.history.frames[frames[0]].frame)[0, 0])
    degrees = 3 * len(fitted.equations)
    variance = max(squared / degrees, 1.0)
    return variance, 0.5 * (squared - squared / variance - degrees * np.log(variance))


@eqx.filter_jit
def _log_determinant(metric: Metric):
    return metric.log_determinant()
