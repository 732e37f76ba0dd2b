"""The autocorrelation of the errors and the sizes of the noise that are likeliest at a fit's point.

The innovation is linear in the forces of the residuals of two frames, and the smooth noise of a variance v enters by
few fields. So what the likelihood needs of a frame are inner products under N alone of both forces and of the smooth
force fields, less those with the eigenvectors of F^T H^T N^-1 H F. The variance of all errors together follows from the
sum of their squares.
"""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..parallel_map import parallel_map
from .frame_likelihood import N_FIELDS, FrameLikelihood
from .linear import Residuals, WeightedResiduals
from .noise_scales import LOG_RANGE, NoiseScales, likeliest_variance, minimum
from .problem import Problem

MAX_PERSISTENCE = 0.999
"""Largest autocorrelation of a frame and the next: beyond it, errors add up as those of a random walk do."""
TOLERANCE = 0.02
"""Tolerance of the logarithms of v and of 1 - rho."""


class _Products(eqx.Module):
    """Inner products of a frame's smooth force fields, and of the forces of its residual and of that before."""

    under: Float[Array, "k k"]
    """Under N^-1."""
    along: Float[Array, "c k"]
    """With the eigenvectors of the smooth noise, whitened."""
    values: Float[Array, " c"]
    """Eigenvalues of F^T H^T N^-1 H F."""


class _Frame(NamedTuple):
    """What the likelihood needs of a frame."""

    products: _Products
    """Its inner products."""
    since: int
    """Frames of the recording since the one before, or since rest."""
    observed: int
    """Number of its observed coordinates."""


def likeliest_noise(
    problem: Problem, weights: dict[int, FrameLikelihood], residuals: dict[int, WeightedResiduals]
) -> NoiseScales:
    """Return a problem's noise scales with the likeliest autocorrelation and variances of the noise."""
    products = parallel_map(lambda k: _products(weights[k], residuals[k].own, residuals[k].before), weights)
    grasps = [
        [
            _Frame(
                products=jax.tree.map(np.asarray, products[k]),
                since=problem.frames_since(k, problem.before(k, weights)),
                observed=3 * int(weights[k].seen.sum()),
            )
            for k in frames
        ]
        for frames in problem.by_grasp(weights).values()
    ]
    last = problem.scales

    def with_smooth(smooth: float) -> tuple[NoiseScales, float]:
        """Return the likeliest scales of a variance of the smooth noise, and minus their log posterior."""
        parts = [_eliminated(frames, smooth / last.smooth, problem.amplitude) for frames in grasps]
        observed = sum(float(part.observed.sum()) for part in parts)

        def of(log_rest: float) -> tuple[NoiseScales, float]:
            persistence = -float(np.expm1(log_rest))
            each = [part.misfit(persistence) for part in parts]
            squared, log_det = (sum(values) for values in zip(*each, strict=True))
            noise = None if last.noise is None else likeliest_variance(squared, observed)
            scales = replace(last, smooth=smooth, persistence=persistence, noise=noise)
            size = noise or 1.0
            return scales, 0.5 * (squared / size + observed * float(np.log(size)) + log_det) - scales.log_prior()

        least = float(np.log1p(-MAX_PERSISTENCE))
        log_rest = minimum(lambda log_rest: of(log_rest)[1], (least, 0.0), TOLERANCE)
        return min(of(0.0), of(log_rest), key=lambda one: one[1])

    if not problem.noise.size:
        return with_smooth(last.smooth)[0]
    log_smooth = minimum(lambda log: with_smooth(float(np.exp(log)))[1], LOG_RANGE, TOLERANCE)
    return with_smooth(float(np.exp(log_smooth)))[0]


@eqx.filter_jit
def _products(likelihood: FrameLikelihood, own: Residuals, before: Float[Array, "n 3"]) -> _Products:
    now = likelihood.forces(own.positions) + own.unbalanced
    forces = jnp.stack([now, likelihood.forces(before)], axis=2)
    columns = jnp.concatenate([likelihood.fields, forces], axis=2)
    white = jnp.concatenate([likelihood.white, likelihood.whitened(forces)], axis=2)
    values, vectors = jnp.linalg.eigh(likelihood.spread @ likelihood.spread.T - jnp.eye(len(likelihood.spread)))
    return _Products(
        under=jnp.einsum("nia,nib->ab", columns, white),
        along=vectors.T @ jnp.einsum("nic,nik->ck", likelihood.noise, columns),
        values=jnp.maximum(values, 0.0),
    )


class _Eliminated(NamedTuple):
    """A grasp's frames with the smooth noise and the smooth force fields eliminated, for any autocorrelation."""

    precision: Float[np.ndarray, "q q"]
    """Precision of c."""
    of_fields: Float[np.ndarray, "t q 2"]
    """Inner products of the fields and of the forces of each frame and of the one before it."""
    of_forces: Float[np.ndarray, "t 2 2"]
    """Inner products of these forces."""
    log_det: float
    """Log determinants, without those of the autocorrelation [nat, doubled]."""
    since: Float[np.ndarray, " t"]
    """Frames since the one before."""
    observed: Float[np.ndarray, " t"]
    """Numbers of observed coordinates."""

    def misfit(self, persistence: float) -> tuple[float, float]:
        """Return the squared innovations and the log determinant [nat, doubled], of noise of the assumed size."""
        rho = persistence**self.since
        by = np.stack([np.ones_like(rho), -rho], axis=1) / np.sqrt(1 - rho**2)[:, None]
        squared = float(np.einsum("ta,tab,tb->", by, self.of_forces, by))
        of_fields = np.einsum("tqa,ta->q", self.of_fields, by)
        taken = float(of_fields @ np.linalg.solve(self.precision, of_fields))
        return squared - taken, self.log_det + float(self.observed @ np.log1p(-(rho**2)))


def _eliminated(frames: list[_Frame], factor: float, amplitude: float) -> _Eliminated:
    """Return a grasp's frames with the smooth noise eliminated, of its present variance times a factor."""
    left, log_det = [], 0.0
    for frame in frames:
        values = factor * frame.products.values
        scaled = np.sqrt(factor / (1 + values))[:, None] * np.asarray(frame.products.along)
        left.append(np.asarray(frame.products.under) - scaled.T @ scaled)
        log_det += float(np.sum(np.log1p(values)))
    whole = np.array(left)
    precision = whole[:, :N_FIELDS, :N_FIELDS].sum(axis=0) + np.eye(N_FIELDS) / amplitude**2
    return _Eliminated(
        precision=precision,
        of_fields=whole[:, :N_FIELDS, N_FIELDS:],
        of_forces=whole[:, N_FIELDS:, N_FIELDS:],
        log_det=log_det + float(np.linalg.slogdet(amplitude**2 * precision)[1]),
        since=np.array([float(frame.since) for frame in frames]),
        observed=np.array([float(frame.observed) for frame in frames]),
    )
