"""Split the log likelihood of a fit exactly over its frames and particles.

With the smooth force fields c and the tool's offset o of each grasp at their likeliest values, i the innovation of the
frame's forces and C its covariance (see `frame_likelihood`), t the tool's residual and v
the variance of its scale, frame k has

    -1/2 [z^T C^-1 z + ln |C| - 2 ln |H| + sum ln (kappa (1 - rho^2)) + |t - o|^2 / v + 3 ln v],   z = i + Q c,

and each grasp, for what its frames share,

    -1/2 [|c|^2 / amplitude^2 + ln |P| + |o|^2 / (ratio v)],

with P the precision of c by prior and frames, over that by the prior.

z^T C^-1 z is the least of what force errors f, noise d of single positions and noise a of neighbours together cost if
z = f + H d + H F a:

    z^T C^-1 z = sum_i (w_i |f_i|^2 + d_i^T R_i^-1 d_i) + |a|^2,

with w the precision of force errors and R the covariance of a position's noise. Particle i has its term of that sum,
which is never negative, and of the determinants an even share if it is observed.
"""

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..parallel_map import parallel_map
from .frame_errors import common_amplitudes
from .frame_likelihood import FrameLikelihood
from .gauss_newton import Weighed
from .normal_equations import common, offset_share
from .tool_pull import pull_products


@dataclass(frozen=True, kw_only=True)
class LikelihoodSplit:
    """Parts of a log likelihood [nat], which sum to it."""

    particles: Float[np.ndarray, "frames n"]
    """Part of each particle in each frame."""
    shared: Float[np.ndarray, " frames"]
    """Part of each frame that belongs to no particle: the tool's reports and force, and the noise that neighbours
    share."""
    grasps: float
    """What belongs to no frame: the fields and the offsets that the frames of a grasp share."""

    @property
    def frames(self) -> Float[np.ndarray, " frames"]:
        """Return the part of each frame."""
        return self.particles.sum(axis=1) + self.shared


def likelihood_split(fit: Weighed) -> LikelihoodSplit:
    """Return the parts of a fit's log likelihood; frames are in the order of its weights."""
    problem, weights = fit.problem, fit.weights
    every, variance = fit.residuals, problem.scales.tool
    likeliest, tool, grasps = common_amplitudes(fit), dict[int, float](), 0.0
    for frames in problem.by_grasp(weights).values():
        known = common(problem, weights, every, frames)
        reports = np.array([np.asarray(every[k].own.tool) for k in frames])
        ratio, share = offset_share(problem.history.frames[frames[0]].frame, len(frames))
        offset = share * reports.sum(axis=0)
        for k, apart in zip(frames, reports - offset, strict=True):
            tool[k] = -0.5 * float(apart @ apart / variance + 3 * np.log(variance))
        if problem.scales.pull is not None and problem.with_force(frames):
            pulls = np.array([np.asarray(every[k].own.pull)[:, None] for k in frames])
            for k, own in zip(frames, pulls[:, :, 0], strict=True):
                constant = 3 * problem.with_force([k]) * np.log(problem.scales.pull)
                tool[k] -= 0.5 * float(own @ own / problem.scales.pull + constant)
            whole = pull_products(pulls, [problem.history.frames[k].frame for k in frames])[0, 0]
            grasps -= 0.5 * float(whole - np.sum(pulls**2)) / problem.scales.pull
        c = np.asarray(likeliest[frames[0]].mean)
        of_offset = float(offset @ offset) / (ratio * variance)
        grasps -= 0.5 * (float(c @ c) / problem.amplitude**2 + known.log_det + of_offset)

    def one(k: int) -> tuple[Float[np.ndarray, " n"], float]:
        seen = np.asarray(weights[k].seen)
        even = float(weights[k].log_determinant()) * seen / max(seen.sum(), 1.0)
        squares, smooth = _squares(weights[k], every[k].innovation, likeliest[k].mean)
        return -0.5 * (np.asarray(squares) + even), tool[k] - 0.5 * float(smooth)

    found = parallel_map(one, weights)
    return LikelihoodSplit(
        particles=np.array([found[k][0] for k in weights]),
        shared=np.array([found[k][1] for k in weights]),
        grasps=grasps,
    )


@eqx.filter_jit
def _squares(
    likelihood: FrameLikelihood, i: Float[Array, "n 3"], c: Float[Array, " q"]
) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """Return the terms of z^T C^-1 z: of each particle, and |a|^2."""
    balance, frame = likelihood.balance, likelihood.frame
    weighted, a = likelihood.solved(i + likelihood.fields @ c)  # w f, and R^-1 d = H^T w f
    weight, pull = frame.weight, balance.transposed(frame.dr_dx, weighted)
    precision = balance.position_precision(frame.evidence)
    known = weight > 0
    of_forces = jnp.where(known, jnp.sum(weighted**2, axis=1) / jnp.where(known, weight, 1.0), 0.0)
    of_positions = jnp.einsum("ni,ni->n", pull, jnp.linalg.solve(precision, pull[:, :, None])[:, :, 0])
    return of_forces + of_positions, jnp.sum(a**2)
