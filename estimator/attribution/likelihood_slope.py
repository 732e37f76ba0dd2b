"""The slope of the whole log likelihood by the effects' parameters: that of residuals, weights and determinants.

Given the noise n_y of the positions and the amplitudes a and c of the smooth noise and of the smooth force fields, the
force error is

    f = i + H (F a - n_y) + Q c,    f ~ N(0, T^2),

with i the innovation of H e + r, e = y - h(x), and the positions have no other error. So by Fisher's identity the slope
of the marginal likelihood is the mean of that of this one, over what the frames say of n_y, a and c,

    -d ln p(y) = d [E |f|^2 / T^2 + ln |T^2| - ln |H^T H|] / 2

[Dempster, Laird and Rubin 1977, JRSS B 39:1; Cappe, Moulines and Ryden 2005, doi:10.1007/0-387-28982-8, section 10.1].
With the mean and the covariance held, that takes one reverse pass. e is in the innovation of the next frame too. H, T,
Q and h depend on the parameters theta and on the predicted state x, which itself depends on theta. As r = 0 for it,
springs to the grip included,

    dL/dtheta = (dL/dtheta)_x - lambda . (dr/dtheta)_x,    H^T lambda = (dL/dx)_theta

(`tool_pull`). What a frame has of its own state as known so far, and of those of frames before, counts as given, as in
the normal equations.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..effects.sheet_model import FrameContext, look
from ..filters.smooth_noise import each
from ..parallel_map import parallel_map
from ..physics.block_tridiagonal import inverse_band, window_sums
from .bed_contact import left_out_contact
from .every_frame import each_frame
from .frame_errors import CommonAmplitudes, ForceErrors, common_amplitudes, frame_errors
from .frame_likelihood import FrameLikelihood, around, seen_noise
from .gauss_newton import Fitted, Weighed
from .grasped_frames import ClosedFrame
from .linear import WeightedResiduals
from .normal_equations import tool_products
from .sheet import PredictedSheet, gripped_forces
from .tool_pull import adjoint


class FrameSlope(NamedTuple):
    """Slope of one frame's -ln likelihood at its predicted state [nat]."""

    of_s: Float[Array, " n"]
    """By the bounded stiffnesses."""
    of_theta: Float[Array, " p"]
    """By all parameters of the library."""
    force_errors: ForceErrors
    """What it says of the size of the force errors."""


def likelihood_slopes(at: Weighed) -> dict[int, FrameSlope]:
    """Return the slope of -ln likelihood of each frame's forces.

    The residuals of the tool and of its force are not in it, as their weights do not change.
    """
    theta, noise, amplitudes = jnp.asarray(at.point.theta), jnp.asarray(at.problem.noise), common_amplitudes(at)
    residuals, nothing = at.residuals, jnp.zeros_like(at.problem.history.rest)

    def passed_on(k: int) -> Float[Array, "n 3"]:
        return _of_before(at.weights[k], residuals[k].innovation, amplitudes[k])

    of_next = dict.fromkeys(at.weights, nothing)
    for k, slope in parallel_map(passed_on, at.weights).items():
        last = at.problem.last_seen(k, at.weights)
        for j in np.unique(last[last >= 0]):
            of_next[j] = of_next[j] + jnp.where(jnp.asarray(last == j)[:, None], slope, 0.0)

    def one(k: int, frame: ClosedFrame, context: FrameContext, x: Float[Array, "n 3"]) -> FrameSlope:
        found = frame_slope(
            at.problem.sheet,
            at.weights[k],
            theta,
            frame,
            context,
            x,
            residuals[k],
            noise,
            amplitudes[k],
            of_next[k],
        )
        return jax.block_until_ready(found)

    return each_frame(at.problem, at.point, at.weights, one)


@eqx.filter_jit
def _of_before(
    likelihood: FrameLikelihood, i: Float[Array, "n 3"], amplitudes: CommonAmplitudes
) -> Float[Array, "n 3"]:
    """Return the slope of a frame's -ln likelihood by the residuals e that its errors follow [nat/m]."""
    weighted, _ = likelihood.solved(i + likelihood.fields @ amplitudes.mean)
    pulled = likelihood.balance.transposed(likelihood.frame.dr_dx, weighted)
    return likelihood.persistence.innovation(jnp.zeros_like(pulled), pulled)


def whole_slope(fitted: Fitted, of_frames: dict[int, FrameSlope]) -> Float[np.ndarray, " k"]:
    """Return the slope of -ln likelihood by s and the free parameters, the tool and its force included [nat]."""
    problem, equations = fitted.problem, fitted.equations
    total = np.sum([np.append(one.of_s, one.of_theta[fitted.free]) for one in of_frames.values()], axis=0)
    for frames in problem.by_grasp(equations).values():
        total += tool_products(problem, equations, frames)[: len(total), -1]
    return total


@eqx.filter_jit
def frame_slope(
    sheet: PredictedSheet,
    likelihood: FrameLikelihood,
    theta: Float[Array, " p"],
    frame: ClosedFrame,
    context: FrameContext,
    x: Float[Array, "n 3"],
    residuals: WeightedResiduals,
    noise: Float[Array, "n modes"],
    amplitudes: CommonAmplitudes,
    of_next: Float[Array, "n 3"],
) -> FrameSlope:
    """Return one frame's slope of -ln likelihood by s and theta at its predicted state x [nat].

    `noise` are the smooth noise's fields [m], `of_next` is the slope by e of -ln likelihood of the frames whose errors
    follow these [nat/m].
    """
    s, known, persistence = likelihood.frame.s, likelihood.frame.weight > 0, likelihood.persistence
    errors = frame_errors(likelihood, seen_noise(frame, noise), residuals.innovation, amplitudes)
    of_square = inverse_band(likelihood.square_factor())

    def expected(theta: Float[Array, " p"], s: Float[Array, " n"], x: Float[Array, "n 3"]):
        balance, linear, Q = around(sheet, theta, s, frame, context, x, likelihood.contact)
        model = sheet.model(theta, context, frame.displacement)
        e = likelihood.seen[:, None] * (frame.y - look(model, x))
        new, unbalanced = map(persistence.innovation, (e, linear.unbalanced), residuals.before)
        f = each(partial(balance.apply, linear.dr_dx), errors.positions) + persistence.drive * Q @ errors.amplitudes
        f = f.at[:, :, 0].add(balance.apply(linear.dr_dx, new) + unbalanced)
        left = window_sums(balance.layout, errors.position_covariance, balance.places, linear.dr_dx)
        squared = left + jnp.sum(f**2, axis=(1, 2))
        weight = jnp.where(known, linear.weight, 1.0)
        log_square = window_sums(balance.layout, of_square, balance.places, likelihood.inner(linear.dr_dx))
        total = 0.5 * jnp.sum(jnp.where(known, weight * squared - 3 * jnp.log(weight) - log_square, 0.0))
        return total + jnp.sum(of_next * e), ForceErrors.of(likelihood, f, left)

    (along_theta, along_s, along_x), found = jax.grad(expected, argnums=(0, 1, 2), has_aux=True)(theta, s, x)
    left_out = left_out_contact(sheet.model(theta, context, frame.displacement), x, likelihood.contact)
    balance_slope = adjoint(likelihood.balance, likelihood.frame, along_x[:, :, None], left_out)[:, :, 0]
    of_theta, of_s = jax.vjp(lambda a, b: gripped_forces(sheet, a, b, frame, context, x), theta, s)[1](balance_slope)
    return FrameSlope(of_s=along_s - of_s, of_theta=along_theta - of_theta, force_errors=found)
