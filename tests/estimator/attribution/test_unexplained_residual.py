"""Unexplained residual: errors no larger than assumed gain nothing."""

import dataclasses

import jax
import pytest

from jiggle_mj.estimator.attribution.fit import moved
from jiggle_mj.estimator.attribution.unexplained_residual import tool_variance, unexplained_residual
from jiggle_mj.estimator.blas import one_thread

GAIN_ERROR = 1e-3
"""Difference of two gains [nat] for variances that differ by 1e-9."""


def test_a_variance_as_assumed_gains_nothing_even_after_a_last_step(light):
    problem, fitted = light[0].problem, light[0].contexts[0].fitted
    at, gains = problem.sheet.place("stretch"), []
    with jax.enable_x64(True), one_thread():
        stepped = dataclasses.replace(fitted, point=moved(problem, fitted, at, fitted.point.theta[at] - 0.2))
        for variances in ((1.0,), (1.0, 1.0 + 1e-9)):
            gains.append(unexplained_residual(problem, stepped, variances=variances).gain)
    assert gains[1] == pytest.approx(gains[0], abs=GAIN_ERROR)


def test_smaller_errors_than_assumed_leave_nothing_unexplained(light):
    """With smooth force fields assumed 16 times as large no error is larger, and only the tool's gain counts."""
    problem, fitted = light[0].problem, light[0].contexts[-1].fitted
    with jax.enable_x64(True), one_thread():
        found = unexplained_residual(problem.inflated(1.0, 16 * problem.amplitude), fitted, variances=(1.0,))
    assert found.amplitude < 1
    assert found.gain == pytest.approx(tool_variance(problem, fitted)[1])
