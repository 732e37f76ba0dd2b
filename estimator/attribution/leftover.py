"""What a fit leaves that its own errors do not account for: how much larger they would have to be.

The likelihood of larger force errors, and of smooth force fields of larger amplitude, against that of the usual ones.
It stands for all causes that have no name here: an effect must do better than that.
"""

from dataclasses import dataclass

import equinox as eqx
import numpy as np
from jiggle_mj.estimator.attribution.fit import DIRECTIONS, Fitted, cost_under, directions, linearised
from jiggle_mj.estimator.attribution.linear import N_FIELDS, Metric
from jiggle_mj.estimator.attribution.normal_equations import among_fields
from jiggle_mj.estimator.attribution.problem import Problem

VARIANCES = (1.0, 4.0, 16.0, 64.0)
"""Of the forces, in units of the usual."""
AMPLITUDES = (0.25, 1.0, 4.0, 16.0)
"""Of the smooth fields, in units of the usual."""


@dataclass(frozen=True, kw_only=True)
class Leftover:
    """The likeliest of those errors."""

    gain: float
    """By how much the frames are likelier with them than with the usual ones [nat]."""
    variance: float
    amplitude: float


def leftover(problem: Problem, fitted: Fitted) -> Leftover:
    """Of a fit."""
    likelihoods: dict[tuple[float, float], float] = {}
    along = directions(problem, fitted.free, DIRECTIONS)
    for variance in VARIANCES:
        wider = problem.widened(variance, problem.amplitude)
        glances, weights = linearised(wider, fitted.point, list(fitted.glances), along)
        whole = sum(float(_log_determinant(one)) for one in weights.values())
        fields = [
            np.sum([among_fields(np.asarray(glances[k].square)) for k in frames], axis=0)
            for frames in problem.by_part(glances).values()
        ]
        for ratio in AMPLITUDES:
            amplitude = ratio * problem.amplitude
            common = sum(np.linalg.slogdet(np.eye(N_FIELDS) + amplitude**2 * one)[1] for one in fields)
            cost = cost_under(wider.widened(1.0, amplitude), weights, glances, fitted.point)
            likelihoods[variance, ratio] = -(cost + whole + common) / 2
    best = max(likelihoods, key=lambda key: likelihoods[key])
    gain = likelihoods[best] - likelihoods[1.0, 1.0]
    return Leftover(gain=gain, variance=best[0], amplitude=best[1])


@eqx.filter_jit
def _log_determinant(metric: Metric):
    return metric.log_determinant()
