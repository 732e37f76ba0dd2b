"""What a frame's observed positions say of its errors: of positions, of smooth fields and of forces.

With the terms of `likelihood_slope`, the noise n_y of the positions, the amplitudes a of the smooth noise and c of the
smooth force fields are normal given the frames, and the force error is

    f = i + H (F a - n_y) + Q c,

all of them innovations, i that of H (y - h(x)) + r.
"""

from collections.abc import Iterable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..filters.smooth_noise import each
from ..physics.block_tridiagonal import BlockTridiagonal, inverse_band, window_sums
from .every_frame import each_frame
from .frame_likelihood import FrameLikelihood, seen_noise
from .gauss_newton import Weighed
from .grasped_frames import ClosedFrame
from .normal_equations import common


class CommonAmplitudes(eqx.Module):
    """What the frames of a grasp say of c."""

    mean: Float[Array, " q"]
    """Mean."""
    root: Float[Array, "q q"]
    """Lower Cholesky factor of the covariance."""


class FrameErrors(eqx.Module):
    """What a frame's positions say of their errors: of F a - n_y and of c, each with the mean first.

    The other columns are those of a root of the covariance, less the part that n_y has with a and c known.
    """

    positions: Float[Array, "n 3 k"]
    """Errors F a - n_y of the positions [m]."""
    amplitudes: Float[Array, "q k"]
    """Amplitudes c."""
    position_covariance: BlockTridiagonal
    """Covariance of n_y with a and c known [m^2]."""


class ForceErrors(eqx.Module):
    """What frames say of the size of the model's force errors, a part of all errors of their forces."""

    squared: Float[Array, ""]
    """Sum of the squares of the mean errors, each over its variance."""
    degrees: Float[Array, ""]
    """Number of errors that the frames determine: their number less what is left of their variances."""
    count: Float[Array, ""]
    """Their number; one that is a part of an error counts as that part."""

    @classmethod
    def of(cls, likelihood: FrameLikelihood, f: Float[Array, "n 3 k"], left: Float[Array, " n"]) -> "ForceErrors":
        """Return what there is to say of errors of forces, given their mean and columns of a root [N].

        Args:
            likelihood: weights of the forces.
            f: mean errors of all forces, then columns whose squares sum to a part of what is left of their variances.
            left: the other part, of all three directions [N^2].
        """
        share, weight = likelihood.force_share, likelihood.frame.weight
        left = left + jnp.sum(f[:, :, 1:] ** 2, axis=(1, 2))
        squared = share * weight * jnp.sum(f[:, :, 0] ** 2, axis=1)
        degrees = jnp.sum(share * (3 - weight * left))
        return cls(squared=jnp.sum(squared), degrees=degrees, count=3 * jnp.sum(share))

    @staticmethod
    def together(frames: Iterable["ForceErrors"]) -> "ForceErrors":
        """Return what several frames say."""
        return jax.tree.map(lambda *each: sum(each[1:], each[0]), *frames)


def common_amplitudes(at: Weighed) -> dict[int, CommonAmplitudes]:
    """Return what is known in each frame of what the frames of its grasp have in common."""
    found = dict[int, CommonAmplitudes]()
    for frames in at.problem.by_grasp(at.weights).values():
        c = common(at.problem, at.weights, at.residuals, frames)
        covariance = np.linalg.inv(c.precision)
        known = CommonAmplitudes(
            mean=jnp.asarray(-covariance @ c.products), root=jnp.asarray(np.linalg.cholesky(covariance))
        )
        found |= dict.fromkeys(frames, known)
    return found


def frame_errors(
    likelihood: FrameLikelihood, smooth: Float[Array, "n 3 m"], i: Float[Array, "n 3"], known: CommonAmplitudes
) -> FrameErrors:
    """Return what is known of a frame's errors, with the smooth noise's fields F [m] and the innovation i [N]."""
    balance, frame = likelihood.balance, likelihood.frame
    m, size = smooth.shape[2], len(known.mean)
    c = jnp.concatenate([known.mean[:, None], known.root, jnp.zeros((size, m))], axis=1)
    forces = (likelihood.fields @ c).at[:, :, 0].add(i)
    a = -likelihood.smooth_amplitudes(forces)
    a = a.at[:, 1 + size :].add(jax.scipy.linalg.solve_triangular(likelihood.spread.T, jnp.eye(m)))
    forces = forces + each(partial(balance.apply, frame.dr_dx), smooth @ a)
    explained = each(partial(balance.explained, frame), forces)
    return FrameErrors(positions=smooth @ a - explained, amplitudes=c, position_covariance=inverse_band(frame.factor))


def force_errors(at: Weighed) -> ForceErrors:
    """Return what all frames of a point say of the size of their force errors."""
    amplitudes, noise = common_amplitudes(at), jnp.asarray(at.problem.noise)

    def one(k: int, frame: ClosedFrame, *_: object) -> ForceErrors:
        found = _force_errors(at.weights[k], seen_noise(frame, noise), at.residuals[k].innovation, amplitudes[k])
        return jax.block_until_ready(found)

    return ForceErrors.together(each_frame(at.problem, at.point, at.weights, one).values())


@eqx.filter_jit
def _force_errors(
    likelihood: FrameLikelihood, smooth: Float[Array, "n 3 m"], i: Float[Array, "n 3"], known: CommonAmplitudes
) -> ForceErrors:
    balance, linear = likelihood.balance, likelihood.frame
    errors = frame_errors(likelihood, smooth, i, known)
    f = each(partial(balance.apply, linear.dr_dx), errors.positions) + likelihood.fields @ errors.amplitudes
    left = window_sums(balance.layout, errors.position_covariance, balance.places, linear.dr_dx)
    return ForceErrors.of(likelihood, f.at[:, :, 0].add(i), left)
