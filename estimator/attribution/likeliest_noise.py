"""The autocorrelation of the errors and the sizes of the noise that are likeliest at a fit's point.

The innovation is linear in the residuals of particles that were last observed equally many frames before, and the
smooth noise of a variance v enters by few fields. So what the likelihood needs of a frame are inner products under N
alone of the forces of those residuals, now and last, and of the smooth force fields, less those with the eigenvectors
of F^T H^T N^-1 H F. The variance of all errors together follows from the sum of their squares.
"""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.optimize import OptimizeResult, minimize

from ..parallel_map import parallel_map
from .frame_likelihood import N_FIELDS, FrameLikelihood
from .linear import SheetResiduals, WeightedResiduals
from .noise_scales import LOG_RANGE, NoiseScales, likeliest_variance
from .persistence import drive
from .problem import Problem

STARTS = (0.0, 0.5, 0.9, 0.99, 0.999)
"""Autocorrelations from which the search begins, beside the last one; the largest is the largest possible: beyond it,
errors add up as those of a random walk do."""
LOG_TOLERANCE, RELATIVE_TOLERANCE = 0.02, 1e-5
"""Tolerances of the logarithms of v and of 1 - rho, and of the log posterior, relative to itself."""


class _Products(eqx.Module):
    """Inner products of a frame's smooth force fields, and of the forces of residuals now and last."""

    under: Float[Array, "k k"]
    """Under N^-1."""
    along: Float[Array, "c k"]
    """With the eigenvectors of the smooth noise, whitened."""
    values: Float[Array, " c"]
    """Eigenvalues of F^T H^T N^-1 H F."""


class GraspProducts(NamedTuple):
    """What the likelihood needs of the frames of a grasp; particles of a frame are grouped by when they were last seen.

    Smooth force fields are those of a frame that follows the one before at once.
    """

    under: Float[np.ndarray, "t k k"]
    """Inner products under N^-1: of the fields, of each group's forces now, and of its last ones."""
    along: Float[np.ndarray, "t c k"]
    """Those with the eigenvectors of the smooth noise, whitened."""
    values: Float[np.ndarray, "t c"]
    """Eigenvalues of F^T H^T N^-1 H F."""
    since: Float[np.ndarray, "t g"]
    """Frames since each group was last observed."""
    observed: Float[np.ndarray, "t g"]
    """Numbers of their observed coordinates."""
    steps: tuple[tuple[int, ...], ...]
    """Frames from each frame of the grasp to the next, since the one before; see `Problem.steps`."""

    def misfit(self, factor: float, autocorrelation: float, amplitude: float) -> tuple[float, float]:
        """Return the squared innovations and the log determinant [nat, doubled], of noise of the assumed size.

        `factor` is of the variance of the smooth noise, `amplitude` the sd of the smooth force fields.
        """
        values = factor * self.values
        scaled = np.sqrt(factor / (1 + values))[:, :, None] * self.along
        left = self.under - scaled.swapaxes(1, 2) @ scaled
        rho = autocorrelation**self.since
        by = np.concatenate([np.ones_like(rho), -rho], axis=1) / np.tile(np.sqrt(1 - rho**2), 2)
        driven = np.array([drive(autocorrelation, steps) for steps in self.steps])
        of_forces = (left[:, :, N_FIELDS:] @ by[:, :, None])[:, :, 0]
        squared = float(np.sum(by * of_forces[:, N_FIELDS:]))
        of_fields = driven @ of_forces[:, :N_FIELDS]
        among = np.tensordot(driven**2, left[:, :N_FIELDS, :N_FIELDS], axes=1)
        precision = among + np.eye(N_FIELDS) / amplitude**2
        squared -= float(of_fields @ np.linalg.solve(precision, of_fields))
        log_det = float(np.sum(np.log1p(values)) + np.linalg.slogdet(amplitude**2 * precision)[1])
        return squared, log_det + float(np.sum(self.observed * np.log1p(-(rho**2))))


def likeliest_noise(
    problem: Problem, weights: dict[int, FrameLikelihood], residuals: dict[int, WeightedResiduals]
) -> NoiseScales:
    """Return a problem's noise scales with the likeliest autocorrelation and variances of the noise."""
    last, grasps = problem.scales, grasps_of(problem, weights, residuals)
    observed = sum(float(frames.observed.sum()) for frames in grasps)

    def at(smooth: float, autocorrelation: float) -> tuple[NoiseScales, float]:
        """Return the scales with the likeliest variance of all errors, and minus their log posterior [nat]."""
        every = [one.misfit(smooth / last.smooth, autocorrelation, problem.amplitude) for one in grasps]
        squared, log_det = (sum(values) for values in zip(*every, strict=True))
        noise = None if last.noise is None else likeliest_variance(squared, observed)
        scales = replace(last, smooth=smooth, autocorrelation=autocorrelation, noise=noise)
        size = noise or 1.0
        return scales, 0.5 * (squared / size + observed * float(np.log(size)) + log_det) - scales.log_prior()

    def of(place: Float[np.ndarray, " _d"]) -> tuple[NoiseScales, float]:
        smooth = float(np.exp(place[1])) if len(place) > 1 else last.smooth
        return at(smooth, max(-float(np.expm1(place[0])), 0.0))

    bounds = [(float(np.log1p(-STARTS[-1])), 0.0), LOG_RANGE][: 2 if problem.noise.size else 1]
    starts = [at(last.smooth, rho) for rho in dict.fromkeys((last.autocorrelation, *STARTS))]
    best = min(starts, key=lambda one: one[1])[0]
    begin = np.array([np.log1p(-best.autocorrelation), np.log(best.smooth)])[: len(bounds)]
    options = {"xtol": LOG_TOLERANCE, "ftol": RELATIVE_TOLERANCE}
    found: OptimizeResult = minimize(lambda place: of(place)[1], begin, bounds=bounds, method="Powell", options=options)
    return min(*starts, of(found["x"]), key=lambda one: one[1])[0]


def grasps_of(
    problem: Problem, weights: dict[int, FrameLikelihood], residuals: dict[int, WeightedResiduals]
) -> list[GraspProducts]:
    """Return what the likelihood needs of the frames of each grasp."""
    since = {k: problem.frames_since(k, problem.last_seen(k, weights)) for k in weights}
    every = {k: np.unique(one) for k, one in since.items()}
    width = 1 << (max(map(len, every.values())) - 1).bit_length()  # few numbers of columns, each compiled once
    times = {k: np.pad(one, (0, width - len(one)), constant_values=np.max(one)) for k, one in every.items()}

    def products(k: int) -> tuple[_Products, Int[np.ndarray, " g"]]:
        groups = since[k][:, None] == times[k]
        groups[:, len(every[k]) :] = False
        observed = 3 * (groups & (np.asarray(weights[k].seen) > 0)[:, None]).sum(axis=0)
        one = residuals[k]
        return _products(weights[k], one.own.sheet, one.before, jnp.asarray(groups.astype(float))), observed

    found = parallel_map(products, weights)
    return [
        GraspProducts(
            under=np.array([found[k][0].under for k in frames]),
            along=np.array([found[k][0].along for k in frames]),
            values=np.array([found[k][0].values for k in frames]),
            since=np.array([times[k] for k in frames], dtype=float),
            observed=np.array([found[k][1] for k in frames], dtype=float),
            steps=tuple(problem.steps(k, weights) for k in frames),
        )
        for frames in problem.by_grasp(weights).values()
    ]


@eqx.filter_jit
def _products(
    likelihood: FrameLikelihood, own: SheetResiduals, before: SheetResiduals, groups: Float[Array, "n g"]
) -> _Products:
    positions, unbalanced = (
        jnp.concatenate([now[:, :, None] * groups[:, None], last[:, :, None] * groups[:, None]], axis=2)
        for now, last in zip(own, before, strict=True)
    )
    forces = jax.vmap(likelihood.forces, 2, 2)(positions) + unbalanced
    unit = 1 / likelihood.persistence.drive
    columns = jnp.concatenate([unit * likelihood.fields, forces], axis=2)
    white = jnp.concatenate([unit * likelihood.white, likelihood.whitened(forces)], axis=2)
    values, vectors = jnp.linalg.eigh(likelihood.spread @ likelihood.spread.T - jnp.eye(len(likelihood.spread)))
    return _Products(
        under=jnp.einsum("nia,nib->ab", columns, white),
        along=vectors.T @ jnp.einsum("nic,nik->ck", likelihood.noise, columns),
        values=jnp.maximum(values, 0.0),
    )
