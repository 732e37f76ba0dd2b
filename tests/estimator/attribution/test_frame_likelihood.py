"""The likelihood of a frame, against dense matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.estimator.attribution.frame_likelihood import FrameLikelihood, seen_shift
from jiggle_mj.estimator.blas import one_thread

ROUNDING = 1e-5
"""Error of a log determinant of some thousands [nat]."""


def dense(likelihood: FrameLikelihood, smooth: np.ndarray) -> float:
    """Return ln |N + H F F' H'| - ln |R| - 2 ln |H| over the rows with a force equation."""
    balance, frame = likelihood.balance, likelihood.frame
    n, known = len(frame.x), np.repeat(np.asarray(frame.weight) > 0, 3)
    slope = np.asarray(jax.jacfwd(balance.unbalanced)(frame.x, frame.s)).reshape(3 * n, 3 * n)[known]
    floor = balance.config.position_precision_floor
    precision = np.asarray(frame.evidence.white_precision) + floor * np.eye(3)
    R = np.zeros((n, 3, n, 3))
    R[np.arange(n), :, np.arange(n)] = np.linalg.inv(precision)
    R, moved = R.reshape(3 * n, 3 * n), slope @ smooth.reshape(3 * n, -1)
    force = np.diag(np.repeat(1 / np.asarray(frame.weight)[np.asarray(frame.weight) > 0], 3))
    N = force + slope @ R @ slope.T + moved @ moved.T
    log_dets = [np.linalg.slogdet(matrix)[1] for matrix in (N, R, slope[:, known])]
    return log_dets[0] - log_dets[1] - 2 * log_dets[2]


def test_both_determinants_are_those_of_dense_matrices(light):
    problem, fitted = light[0].problem, light[0].declared.fitted
    with jax.enable_x64(True), one_thread():
        for k in list(fitted.weights)[::5]:
            fields = jnp.asarray(problem.noise)[:, None, :, None] * jnp.eye(3)[None, :, None, :]
            fields = fields.reshape(len(problem.noise), 3, -1)
            smooth = np.asarray(seen_shift(problem.history.frames[k].frame, fields))
            likelihood = fitted.weights[k]
            new = np.asarray(likelihood.persistence.new)[np.asarray(likelihood.seen) > 0]
            expected = dense(likelihood, smooth) + 3 * float(np.log(new).sum())
            assert float(likelihood.log_determinant()) == pytest.approx(expected, abs=ROUNDING)
