"""The remainder: what neither the model nor a named effect explains, as a random process with a variance and no name.

The residual of each particle is a Student-t process [Shah, Wilson & Ghahramani 2014, arXiv:1402.4306] over the tool's
displacement u and the time t, as a discrepancy is a Gaussian process of the inputs [Kennedy & O'Hagan 2001,
doi:10.1111/1467-9868.00294]. With g the grasp its covariance is

    [g = g'] (offset + share u.u' / U^2) + drift t t' / T^2 + walk min(t, t') / T + (white + noise) [t = t'],

so that the three predictions without a model are special cases of it: nothing moves, the last frame stays (`walk`), and
each particle goes its own linear share of the tool's displacement (`share`). Particles are independent, and each has a
variance of its own: the residual is larger near the grasp, and a tracker loses some points.

It is fitted after all effects and never before them, so it takes nothing that an effect explains.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.optimize import minimize

from .fit import Fitted
from .grasped_frames import Timed
from .held_out import from_rest, noise_variance
from .problem import Problem

TERMS = ("offset", "share", "drift", "walk", "white")
"""Names of the variances."""
PRIOR_LOG_SD = 4.0
"""Prior standard deviation of the logarithm of each variance, about the mean square of the residual [nat]."""
STARTS = (0.0, -3.0)
"""Logarithms of all variances, over the mean square of the residual, that the search begins at [nat]."""
LOG_RANGE = (-14.0, 8.0)
"""Range of these logarithms [nat]."""
DEGREES_RANGE = (4.0, 400.0)
"""Range of the degrees of freedom of the variances of the particles: from heavy tails with a finite kurtosis to nearly
the same variance for all."""
MAX_LEARNING_FRAMES = 60
"""Frames, spread evenly, that the variances are learned from; all fitted frames predict."""
UNSEEN_VARIANCE = 1e6
"""Variance of a residual that was not observed, over the mean square of the residual: it then does not count."""


@dataclass(frozen=True, kw_only=True)
class FittedRemainder:
    """The process given the residuals of the fitted frames, in all frames."""

    mean: Float[np.ndarray, "frames n 3"]
    """Expected residual [m]."""
    variance: Float[np.ndarray, "frames n"]
    """Variance of each coordinate of an observed residual, noise included [m^2]."""
    variances: dict[str, float]
    """Variance of each of `TERMS`, at the largest displacement and the last time [m^2]."""
    degrees: float
    """Degrees of freedom of the variances of the particles."""

    def of(self, frames: list[Timed], part: int) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, " m"]]:
        """Return mean [m] and variance [m^2] for the particles of a part's frames that are observed and not held."""
        counted = {k: np.asarray(timed.frame.counted) for k, timed in enumerate(frames) if timed.part == part}
        return (
            np.concatenate([self.mean[k][where] for k, where in counted.items()]),
            np.concatenate([self.variance[k][where] for k, where in counted.items()]),
        )


def remainder_of_fit(problem: Problem, fitted: Fitted) -> FittedRemainder:
    """Return the remainder of a fit, given the frames that it was fitted to.

    All frames are predicted from the tool's reports, as held-out ones are.
    """
    frames = problem.history.frames
    predicted = from_rest(problem, fitted.point, list(range(len(frames))), by_tool=True)
    return remainder(
        frames,
        np.array([np.asarray(timed.frame.y) for timed in frames]) - predicted.seen,
        np.isin(np.arange(len(frames)), list(fitted.equations)),
        noise=np.array([noise_variance(problem, timed.frame) for timed in frames]),
    )


def remainder(
    frames: list[Timed],
    residual: Float[np.ndarray, "frames n 3"],
    fitted: Bool[np.ndarray, " frames"],
    *,
    noise: Float[np.ndarray, "frames n"],
) -> FittedRemainder:
    """Return the remainder of residuals.

    Args:
        frames: all frames.
        residual: observed minus predicted positions in all frames, of any value where not observed [m].
        fitted: the frames that were fitted to; the residuals of the others are not used.
        noise: variance of a coordinate of each particle by the noise of observed positions, of any value where not
            observed [m^2].

    Raises:
        ValueError: no residual is observed in a fitted frame.
    """
    counted = np.array([np.asarray(timed.frame.counted) for timed in frames])
    seen = counted & fitted[:, None]
    if not seen.any():
        raise ValueError("remainder needs a particle that is observed in a frame that was fitted to.")
    scale = max(float(np.mean(residual[seen] ** 2)), np.finfo(float).tiny)
    terms = _terms(frames)
    known = np.flatnonzero(fitted)
    learned = known[np.unique(np.linspace(0, len(known) - 1, min(len(known), MAX_LEARNING_FRAMES)).astype(int))]
    parameters = _likeliest(terms[:, learned][:, :, learned], residual[learned], seen[learned], noise[learned], scale)
    log_variances, degrees = jnp.asarray(parameters[:-1]), float(np.exp(parameters[-1]))
    rows = jnp.asarray(terms[:, known][:, :, known]), jnp.asarray(terms[:, :, known]), jnp.asarray(terms)
    mean, variance = _predicted(
        log_variances,
        jnp.asarray(degrees),
        *rows,
        jnp.asarray(residual[known]),
        jnp.asarray(seen[known]),
        jnp.asarray(noise[known]),
        jnp.asarray(noise),
        jnp.asarray(scale),
    )
    variances = scale * np.exp(parameters[:-1])
    return FittedRemainder(
        mean=np.asarray(mean),
        variance=np.asarray(variance),
        variances=dict(zip(TERMS, map(float, variances), strict=True)),
        degrees=degrees,
    )


def _terms(frames: list[Timed]) -> Float[np.ndarray, "terms frames frames"]:
    """Return the covariance between frames of each of `TERMS` of a variance of 1."""
    grasp, time = np.array([timed.grasp for timed in frames]), np.array([timed.time for timed in frames])
    u = np.array([np.asarray(timed.frame.displacement) for timed in frames])
    same = (grasp[:, None] == grasp[None]).astype(float)
    longest, last = np.max(np.sum(u**2, axis=1)), max(float(time.max()), np.finfo(float).tiny)
    share = same * (u @ u.T) / max(float(longest), np.finfo(float).tiny)
    drift, walk = np.outer(time, time) / last**2, np.minimum(time[:, None], time[None]) / last
    return np.array([same, share, drift, walk, np.eye(len(frames))])


def _likeliest(
    terms: Float[np.ndarray, "terms t t"],
    residual: Float[np.ndarray, "t n 3"],
    seen: Bool[np.ndarray, "t n"],
    noise: Float[np.ndarray, "t n"],
    scale: float,
) -> Float[np.ndarray, " parameters"]:
    """Return the logarithms of the variances over `scale`, and of the degrees of freedom, of largest posterior."""
    given = tuple(map(jnp.asarray, (terms, residual, seen, noise, scale)))
    objective = jax.jit(jax.value_and_grad(_minus_log_posterior))
    bounds = [LOG_RANGE] * len(TERMS) + [tuple(np.log(DEGREES_RANGE))]

    def at(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = objective(jnp.asarray(parameters), *given)
        return float(value), np.asarray(gradient)

    starts = [np.array([*[start] * len(TERMS), np.log(10.0)]) for start in STARTS]
    found = [minimize(at, start, jac=True, method="L-BFGS-B", bounds=bounds) for start in starts]
    return np.asarray(min(found, key=lambda one: one.fun).x)


def _minus_log_posterior(
    parameters: Float[Array, " parameters"],
    terms: Float[Array, "terms t t"],
    residual: Float[Array, "t n 3"],
    seen: Bool[Array, "t n"],
    noise: Float[Array, "t n"],
    scale: Float[Array, ""],
) -> Float[Array, ""]:
    """Return the negative logarithm of likelihood and prior [nat], up to a constant."""
    degrees, count = jnp.exp(parameters[-1]), 3 * jnp.sum(seen.astype(residual.dtype), axis=0)
    factor = _factors(parameters[:-1], terms, seen, noise, scale)
    squared = jnp.sum(_whitened(factor, residual, seen, scale) ** 2, axis=(1, 2))
    log_det = 6 * jnp.sum(jnp.log(jnp.diagonal(factor, axis1=1, axis2=2)), axis=1)
    gammaln = jax.scipy.special.gammaln
    likelihood = gammaln((degrees + count) / 2) - gammaln(degrees / 2) - count / 2 * jnp.log(degrees - 2)
    likelihood = likelihood - (degrees + count) / 2 * jnp.log1p(squared / (degrees - 2)) - log_det / 2
    return -jnp.sum(likelihood) + 0.5 * jnp.sum((parameters[:-1] / PRIOR_LOG_SD) ** 2)


def _factors(
    log_variances: Float[Array, " terms"],
    terms: Float[Array, "terms t t"],
    seen: Bool[Array, "t n"],
    noise: Float[Array, "t n"],
    scale: Float[Array, ""],
) -> Float[Array, "n t t"]:
    """Return the Cholesky factor of each particle's covariance over `scale`."""
    common = jnp.einsum("k,kab->ab", jnp.exp(log_variances), terms)
    own = jnp.where(seen, noise / scale, UNSEEN_VARIANCE).T
    return jnp.linalg.cholesky(common[None] + own[:, :, None] * jnp.eye(len(common))[None])


def _whitened(
    factor: Float[Array, "n t t"],
    residual: Float[Array, "t n 3"],
    seen: Bool[Array, "t n"],
    scale: Float[Array, ""],
) -> Float[Array, "n t 3"]:
    """Return the residuals of each particle over `scale`'s root, uncorrelated and of unit variance."""
    observed = jnp.where(seen[:, :, None], residual, 0.0) / jnp.sqrt(scale)
    return jax.scipy.linalg.solve_triangular(factor, jnp.swapaxes(observed, 0, 1), lower=True)


@jax.jit
def _predicted(
    log_variances: Float[Array, " terms"],
    degrees: Float[Array, ""],
    among: Float[Array, "terms t t"],
    between: Float[Array, "terms frames t"],
    all_terms: Float[Array, "terms frames frames"],
    residual: Float[Array, "t n 3"],
    seen: Bool[Array, "t n"],
    known_noise: Float[Array, "t n"],
    noise: Float[Array, "frames n"],
    scale: Float[Array, ""],
) -> tuple[Float[Array, "frames n 3"], Float[Array, "frames n"]]:
    """Return mean and variance of the residual of each particle in all frames, as if each frame was observed anew."""
    variances = jnp.exp(log_variances)
    factor = _factors(log_variances, among, seen, known_noise, scale)
    white = _whitened(factor, residual, seen, scale)
    lasting = jnp.einsum("k,kfa->fa", variances[:-1], between[:-1])
    own = jnp.einsum("k,kf->f", variances, jnp.diagonal(all_terms, axis1=1, axis2=2))

    def one(
        factor: Float[Array, "t t"], white: Float[Array, "t 3"], noise: Float[Array, " frames"], count: Float[Array, ""]
    ) -> tuple[Float[Array, "frames 3"], Float[Array, " frames"]]:
        spread = jax.scipy.linalg.solve_triangular(factor, lasting.T, lower=True)
        # the posterior of the particle's own variance, and the variance of its t distribution
        ratio = (degrees - 2 + jnp.sum(white**2)) / (degrees - 2 + count)
        return spread.T @ white, ratio * (own - jnp.sum(spread**2, axis=0) + noise / scale)

    mean, variance = jax.vmap(one)(factor, white, noise.T, 3 * jnp.sum(seen.astype(residual.dtype), axis=0))
    return jnp.sqrt(scale) * jnp.swapaxes(mean, 0, 1), scale * variance.T
