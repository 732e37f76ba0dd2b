"""Unexplained residual of a fit: how much larger the assumed errors would have to be to account for it.

It is the likelihood of larger force errors, of smooth force fields of larger amplitude and of less precise tool
reports, against that of the assumed ones. It stands for all causes that the library has no name for: an effect must
explain more.
"""

from dataclasses import dataclass

import equinox as eqx
import numpy as np

from .every_frame import cost, residual, weighed
from .fit import Fitted
from .frame_likelihood import N_FIELDS, FrameLikelihood
from .normal_equations import less_offset
from .problem import Problem

RATIO = 4.0
"""Ratio of neighbouring variances that are tried."""
FORCE_VARIANCES = (1.0, RATIO, RATIO**2, RATIO**3)
"""Variances of the forces that are tried [assumed variances]. Once one is less likely than the one before, the larger
ones are not tried."""
AMPLITUDES = (0.25, 1.0, 4.0, 16.0)
"""Amplitudes of the smooth fields that are tried [assumed amplitudes]."""


@dataclass(frozen=True, kw_only=True)
class UnexplainedResidual:
    """Likeliest size of the errors."""

    gain: float
    """Log likelihood ratio of these errors to the assumed or smaller ones [nat]."""
    variance: float
    """Variance of the forces [assumed variances]."""
    amplitude: float
    """Amplitude of the smooth fields [assumed amplitudes]."""
    tool_variance: float
    """Variance of the tool's residual [assumed variances]."""


def unexplained_residual(
    problem: Problem, fitted: Fitted, *, variances: tuple[float, ...] = FORCE_VARIANCES
) -> UnexplainedResidual:
    """Return the unexplained residual of a fit; `variances` are those of the forces that are tried, 1 first."""
    likelihoods: dict[tuple[float, float], float] = {}
    for variance in variances:
        if likelihoods and max(likelihoods, key=lambda key: likelihoods[key])[0] < variance / RATIO:
            break
        inflated = problem.inflated(variance, problem.amplitude)
        weights = fitted.weights if variance == 1.0 else weighed(inflated, fitted.around, list(fitted.weights))
        residuals = residual(inflated, weights, fitted.point)
        log_determinants = sum(float(_log_determinant(one)) for one in weights.values())
        fields = [
            np.sum([np.asarray(weights[k].among) for k in frames], axis=0)
            for frames in problem.by_part(weights).values()
        ]
        for ratio in AMPLITUDES:
            amplitude = ratio * problem.amplitude
            common = sum(np.linalg.slogdet(np.eye(N_FIELDS) + amplitude**2 * one)[1] for one in fields)
            minus_twice = cost(problem, weights, residuals, amplitude) + log_determinants + common
            likelihoods[variance, ratio] = -minus_twice / 2
    best = max(likelihoods, key=lambda key: likelihoods[key])
    no_larger = max(likelihoods[1.0, ratio] for ratio in AMPLITUDES if ratio <= 1.0)
    gain = likelihoods[best] - no_larger
    tool, tool_gain = tool_variance(problem, fitted)
    return UnexplainedResidual(gain=float(gain + tool_gain), variance=best[0], amplitude=best[1], tool_variance=tool)


def tool_variance(problem: Problem, fitted: Fitted) -> tuple[float, float]:
    """Return the likeliest variance of the tool's residual [assumed variances], at least 1, and its gain [nat]."""
    squared = 0.0
    for frames in problem.by_part(fitted.equations).values():
        rows = np.array([np.asarray(fitted.equations[k].tool)[:, -1:] for k in frames])
        squared += float(less_offset(rows, problem.history.frames[frames[0]].frame)[0, 0])
    degrees = 3 * len(fitted.equations)
    variance = max(squared / degrees, 1.0)
    return variance, 0.5 * (squared - squared / variance - degrees * np.log(variance))


@eqx.filter_jit
def _log_determinant(likelihood: FrameLikelihood):
    """Return the part of the log determinant that depends on the variances, as a compiled program."""
    return likelihood.force_log_determinant()
