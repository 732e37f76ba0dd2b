"""The measured force of the tool, as a residual of a frame's predicted equilibrium.

At equilibrium the tool pulls at the tissue with

    P = c sum_held (f_i + b_i d_i)

with f the gradient of the sheet's energy, b d the pull of an attachment, and c the factor of `force_scale`. A change of
the forces r that do not balance, those of the springs to the grip included, moves the state x by -H^-1 dr, H = dr/dx.
So with

    H^T lambda = dP/dx

P changes by -lambda^T dr in addition to what changes it at the same x, whatever it is that changes r [the adjoint
method: Giles and Pierce 2000, doi:10.1023/A:1011430410075].

Force errors of the model and smooth force fields are errors of inner forces, which cancel in the sum over the sheet:
they do not count here. The noise of the measured force has a scale of its own, which is free in every hypothesis.
"""

from collections.abc import Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..effects.sheet_model import SheetModel
from ..filters.evidence import MeasuredPull
from ..filters.force_balance import ForceBalance
from ..filters.frame import Frame
from ..filters.smooth_noise import each
from ..physics.block_tridiagonal import normal_cholesky, solve
from .grasped_frames import ClosedFrame, FramePull

MODEL_SHARE = 0.05
"""Standard deviation of the model's error of the force in a frame [measured force]. What is the same in all frames is
the nuisance parameter `force_scale`."""


def frame_pulls(measured: Sequence[MeasuredPull | None]) -> list[FramePull | None]:
    """Return the forces of frames as residuals count them; None for all where none has a force whose noise is known."""
    known = [one is not None and bool(np.isfinite(np.asarray(one.covariance)).all()) for one in measured]
    if not any(known):
        return [None] * len(measured)
    return [_frame_pull(one if is_known else None) for one, is_known in zip(measured, known, strict=True)]


def _frame_pull(measured: MeasuredPull | None) -> FramePull:
    with jax.enable_x64(True):
        zero = jnp.zeros(())
        if measured is None:
            return FramePull(force=jnp.zeros(3), weight=zero, offset_sd=zero, offset_number=jnp.asarray(0))
        force, of_sensor = np.asarray(measured.pull, dtype=float), float(measured.covariance[0, 0])
        variance = of_sensor + MODEL_SHARE**2 * float(force @ force)
        return FramePull(
            force=jnp.asarray(force),
            weight=jnp.asarray(variance**-0.5),
            offset_sd=jnp.asarray(float(measured.offset_sd)),
            offset_number=jnp.asarray(int(measured.offset_number)),
        )


def predicted_pull(
    balance: ForceBalance, model: SheetModel, frame: ClosedFrame, s: Float[Array, " n"], x: Float[Array, "n 3"]
) -> Float[Array, " 3"]:
    """Return the force of the tool on the tissue that a model needs to hold what is held at x [N].

    Args:
        balance: of the sheet, with any energy.
        model: of the frame.
        frame: says what is held.
        s: bounded stiffnesses, all below 1.
        x: state [m].
    """
    forces = balance.with_energy(model.energy).unbalanced(x, s) / (1 - s)[:, None]
    return model.force_factor * jnp.sum(jnp.where(frame.held[:, None], forces, 0.0), axis=0)


def adjoint(
    balance: ForceBalance, linear: Frame, dP_dx: Float[Array, "n 3 c"], left_out: Float[Array, "n 3 3"]
) -> Float[Array, "n 3 c"]:
    """Return lambda at a linearised state; dP_dx has the components of P, or of anything else, last.

    `left_out` is the stiffness under each particle that the balance leaves out and the state's equilibrium has [N/m].
    """
    itself = balance.neighbours == jnp.arange(len(linear.x))[:, None]
    springs = grip_stiffness(balance, linear)[:, None, None] * jnp.eye(3)[None]
    added = springs + (1 - linear.s)[:, None, None] * left_out
    rows = linear.dr_dx + jnp.where(itself[:, :, None, None], added[:, None], 0.0)
    n = len(linear.x)
    factor = normal_cholesky(balance.layout, balance.places, rows, jnp.ones(n), jnp.zeros((n, 3, 3)))

    def solved(column: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        return balance.apply(rows, solve(balance.layout, factor, column))

    first = each(solved, dP_dx)
    return first + each(solved, dP_dx - each(partial(balance.transposed, rows), first))  # H^T H is ill-conditioned


def grip_stiffness(balance: ForceBalance, linear: Frame) -> Float[Array, " n"]:
    """Return by how much the springs to the grip change r with the position of each particle [N/m]."""
    return jnp.where(linear.evidence.held, (1 - linear.s) * balance.grip_stiffness, 0.0)


def off_balance(linear: Frame) -> Float[Array, "n 3"]:
    """Return the forces that do not balance at a state [N]; the springs to the grip balance what is held."""
    return jnp.where(linear.evidence.held[:, None], 0.0, linear.unbalanced)


def pull_products(rows: Float[np.ndarray, "t 3 a"], frames: Sequence[ClosedFrame]) -> Float[np.ndarray, "a a"]:
    """Return the inner products of the force's rows over frames, with the sensor's offsets eliminated.

    Args:
        rows: in units of each frame's standard deviation.
        frames: that the rows are of, at least one.
    """
    pulls = [frame.pull for frame in frames if frame.pull is not None]
    offset = np.array([float(pull.weight * pull.offset_sd) for pull in pulls])
    number = np.array([int(pull.offset_number) for pull in pulls])
    flat = rows.reshape(-1, rows.shape[2])
    products = flat.T @ flat
    for which in np.unique(number):
        share = np.where(number == which, offset, 0.0)
        together = np.einsum("t,tia->ia", share, rows)
        products -= together.T @ together / (1 + share @ share)
    return products


@eqx.filter_jit
def pull_slope(
    balance: ForceBalance, model: SheetModel, frame: ClosedFrame, s: Float[Array, " n"], x: Float[Array, "n 3"]
) -> Float[Array, "n 3 3"]:
    """Return dP/dx, with the components of P last."""
    return jnp.moveaxis(jax.jacrev(partial(predicted_pull, balance, model, frame, s))(x), 0, 2)
