"""The slope of the whole log likelihood by the effects' parameters: that of residuals, weights and determinants.

Given the noise n_y of the positions and the amplitudes a and c of the smooth noise and force fields, the force error is

    f = H (y - h(x) + F a - n_y) + r + Q c,    f ~ N(0, T^2),

and the positions have no other error. So by Fisher's identity the slope of the marginal likelihood is the mean of that
of this one, over what the frames say of n_y, a and c,

    -d ln p(y) = d [E |f|^2 / T^2 + ln |T^2| - ln |H^T H|] / 2

[Dempster, Laird and Rubin 1977, JRSS B 39:1; Cappe, Moulines and Ryden 2005, doi:10.1007/0-387-28982-8, section 10.1].
With the mean and the covariance held, that takes one reverse pass. H, T, Q and h depend on the parameters theta and on
the predicted state x, which itself depends on theta. As r = 0 for it, springs to the grip included,

    dL/dtheta = (dL/dtheta)_x - lambda . (dr/dtheta)_x,    H^T lambda = (dL/dx)_theta

(`tool_pull`). What a frame has of its own state as known so far, and of those of frames before, counts as given, as in
the normal equations.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..effects.sheet_model import FrameContext, look
from ..filters.smooth_noise import each
from ..physics.block_tridiagonal import BlockTridiagonal, inverse_band, window_sums
from .every_frame import each_frame, field_information, residual
from .frame_likelihood import N_FIELDS, FrameLikelihood, around, seen_noise
from .grasped_frames import ClosedFrame
from .linear import WeightedResiduals
from .problem import Point, Problem
from .sheet import PredictedSheet, gripped_forces
from .tool_pull import adjoint


class FieldAmplitudes(eqx.Module):
    """What the frames of a grasp say of the amplitudes c of its smooth force fields."""

    mean: Float[Array, " q"]
    """Mean."""
    root: Float[Array, "q q"]
    """Lower Cholesky factor of the covariance."""


def likelihood_slopes(
    problem: Problem,
    point: Point,
    weights: dict[int, FrameLikelihood],
) -> dict[int, tuple[Float[np.ndarray, " n"], Float[np.ndarray, " p"]]]:
    """Return the slope of -ln likelihood of each frame's forces by s and by all parameters of the library [nat].

    The residuals of the tool and of its force are not in it, as their weights do not change.

    Args:
        problem: what is fitted to.
        point: parameters and predicted states.
        weights: weights of the residuals there.
    """
    every = residual(problem, weights, point)
    amplitudes = dict[int, FieldAmplitudes]()
    for frames in problem.by_part(weights).values():
        amplitudes |= dict.fromkeys(frames, _amplitudes(problem, frames, weights, every))
    theta, noise = jnp.asarray(point.theta), jnp.asarray(problem.noise)

    def one(k: int, frame: ClosedFrame, context: FrameContext, x: Float[Array, "n 3"]) -> tuple[np.ndarray, np.ndarray]:
        e = every[k].forces
        of_s, of_theta = frame_slope(problem.sheet, weights[k], theta, frame, context, x, e, noise, amplitudes[k])
        return np.asarray(of_s), np.asarray(of_theta)

    return each_frame(problem, point, weights, one)


def _amplitudes(
    problem: Problem, frames: list[int], weights: dict[int, FrameLikelihood], every: dict[int, WeightedResiduals]
) -> FieldAmplitudes:
    precision, products = field_information(problem, weights, every, frames)
    covariance = np.linalg.inv(precision)
    mean = -covariance @ products
    return FieldAmplitudes(mean=jnp.asarray(mean), root=jnp.asarray(np.linalg.cholesky(covariance)))


class _Errors(eqx.Module):
    """What a frame's positions say of their errors: of F a - n_y and of c, each with the mean first.

    The other columns are those of a root of the covariance, less the part that n_y has with a and c known.
    """

    positions: Float[Array, "n 3 k"]
    """Errors F a - n_y of the positions [m]."""
    amplitudes: Float[Array, "q k"]
    """Amplitudes c."""
    position_covariance: BlockTridiagonal
    """Covariance of n_y with a and c known [m^2]."""


def _errors(
    likelihood: FrameLikelihood,
    smooth: Float[Array, "n 3 m"],
    e: Float[Array, "n 3"],
    fields: FieldAmplitudes,
) -> _Errors:
    """Return what is known of a frame's errors, with the smooth noise's fields F [m] and e = H (y - h(x)) + r [N]."""
    balance, frame = likelihood.balance, likelihood.frame
    m = smooth.shape[2]
    c = jnp.concatenate([fields.mean[:, None], fields.root, jnp.zeros((N_FIELDS, m))], axis=1)
    forces = likelihood.fields @ c
    forces = forces.at[:, :, 0].add(e)
    a = -jax.scipy.linalg.cho_solve((likelihood.spread, True), jnp.einsum("nim,nik->mk", likelihood.noise, forces))
    a = a.at[:, 1 + N_FIELDS :].add(jax.scipy.linalg.solve_triangular(likelihood.spread.T, jnp.eye(m)))
    seen = smooth @ a
    forces = forces + each(partial(balance.apply, frame.dr_dx), seen)
    explained = each(partial(balance.explained, frame), forces)
    return _Errors(positions=seen - explained, amplitudes=c, position_covariance=inverse_band(frame.factor))


@eqx.filter_jit
def frame_slope(
    sheet: PredictedSheet,
    likelihood: FrameLikelihood,
    theta: Float[Array, " p"],
    frame: ClosedFrame,
    context: FrameContext,
    x: Float[Array, "n 3"],
    e: Float[Array, "n 3"],
    noise: Float[Array, "n modes"],
    fields: FieldAmplitudes,
) -> tuple[Float[Array, " n"], Float[Array, " p"]]:
    """Return one frame's slope of -ln likelihood by s and theta at its predicted state x [nat].

    `e` are the forces H (y - h(x)) + r there [N], `noise` the smooth noise's fields [m].
    """
    s, known = likelihood.frame.s, likelihood.frame.weight > 0
    errors = _errors(likelihood, seen_noise(frame, noise), e, fields)
    of_square = inverse_band(likelihood.square_factor())

    def expected(theta: Float[Array, " p"], s: Float[Array, " n"], x: Float[Array, "n 3"]) -> Float[Array, ""]:
        balance, linear, Q = around(sheet, theta, s, frame, context, x)
        model = sheet.model(theta, context, frame.displacement)
        positions = errors.positions.at[:, :, 0].add(likelihood.seen[:, None] * (frame.y - look(model, x)))
        f = each(partial(balance.apply, linear.dr_dx), positions) + Q @ errors.amplitudes
        f = f.at[:, :, 0].add(linear.unbalanced)
        squared = jnp.sum(f**2, axis=(1, 2))
        squared = squared + window_sums(balance.layout, errors.position_covariance, balance.places, linear.dr_dx)
        weight = jnp.where(known, linear.weight, 1.0)
        log_square = window_sums(balance.layout, of_square, balance.places, likelihood.inner(linear.dr_dx))
        return 0.5 * jnp.sum(jnp.where(known, weight * squared - 3 * jnp.log(weight) - log_square, 0.0))

    along_theta, along_s, along_x = jax.grad(expected, argnums=(0, 1, 2))(theta, s, x)
    balance_slope = adjoint(likelihood.balance, likelihood.frame, along_x[:, :, None])[:, :, 0]
    of_theta, of_s = jax.vjp(lambda *at: gripped_forces(sheet, *at, frame, context, x), theta, s)[1](balance_slope)
    return along_s - of_s, along_theta - of_theta
