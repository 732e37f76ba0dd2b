"""The remainder: what neither the model nor a named effect explains, as a random process with a variance and no name.

The residual of each particle is a Student-t process [Shah, Wilson & Ghahramani 2014, arXiv:1402.4306] over the tool's
displacement u and the time t since the jaws closed, as a discrepancy is a Gaussian process of the inputs [Kennedy &
O'Hagan 2001, doi:10.1111/1467-9868.00294]. Within a grasp its covariance is

    offset + share u.u' / U^2 + drift t t' / T^2 + walk min(t, t') / T + (white + noise) [t = t'],

and 0 between grasps: what one pull leaves unexplained says how much another one may, not in which direction. The
predictions without a model are special cases: nothing moves, the last frame stays (`walk`), and each particle goes its
own linear share of the tool's displacement (`share`). Particles are independent, and each has a variance of its own:
the residual is larger near the grasp, and a tracker loses some points.

It is fitted after all effects and never before them, so it takes nothing that an effect explains.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.optimize import minimize

from ..map_rows import map_rows
from .gauss_newton import Fitted
from .grasped_frames import Timed
from .held_out import from_rest

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


class Observed(eqx.Module):
    """Observed residuals of a particle in some frames, or of many particles."""

    residual: Float[Array, "*n t 3"]
    """Residuals; 0 where not `seen`."""
    seen: Bool[Array, "*n t"]
    """Whether each was observed."""
    noise: Float[Array, "*n t"]
    """Variance of a coordinate by the noise of observed positions."""

    @property
    def count(self) -> Float[Array, ""]:
        """Return the number of observed coordinates of one particle."""
        return 3 * jnp.sum(self.seen.astype(self.residual.dtype))

    def at(self, frames: Int[np.ndarray, " k"] | Int[Array, " k"]) -> "Observed":
        """Return the residuals in some of the frames."""
        return Observed(
            residual=self.residual[..., frames, :], seen=self.seen[..., frames], noise=self.noise[..., frames]
        )

    def whitened(
        self, log_variances: Float[Array, " terms"], terms: Float[Array, "terms t t"]
    ) -> tuple[Float[Array, "t t"], Float[Array, "t 3"]]:
        """Return the Cholesky factor of one particle's covariance, and its uncorrelated residuals of unit variance."""
        common = jnp.einsum("k,kab->ab", jnp.exp(log_variances), terms)
        factor = jnp.linalg.cholesky(common + jnp.diag(jnp.where(self.seen, self.noise, UNSEEN_VARIANCE)))
        return factor, jax.scipy.linalg.solve_triangular(factor, self.residual, lower=True)


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


def remainder_of_fit(fitted: Fitted) -> FittedRemainder:
    """Return the remainder of a fit, given the frames that it was fitted to.

    These are predicted from the tool's reports, as held-out ones are.
    """
    problem = fitted.problem
    frames, known = problem.history.frames, sorted(fitted.equations)
    predicted = from_rest(problem, fitted.point, known, by_tool=True)
    return remainder(
        frames,
        np.array([np.asarray(timed.frame.y) for timed in frames]) - predicted.seen,
        np.isin(np.arange(len(frames)), known),
        noise=np.array([timed.frame.noise_variance(problem.assumed_noise) for timed in frames]),
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
    # everything below is over the mean square of the residual
    scale = max(float(np.mean(residual[seen] ** 2)), np.finfo(float).tiny)
    observed = Observed(
        residual=jnp.asarray(np.where(seen[:, :, None], residual, 0.0) / np.sqrt(scale)).swapaxes(0, 1),
        seen=jnp.asarray(seen.T),
        noise=jnp.asarray(noise.T / scale),
    )
    terms, known = jnp.asarray(_terms(frames)), np.flatnonzero(fitted)
    learned = known[np.unique(np.linspace(0, len(known) - 1, min(len(known), MAX_LEARNING_FRAMES)).astype(int))]
    parameters = _likeliest(terms[:, learned][:, :, learned], observed.at(learned))
    mean, variance = predicted_remainder(jnp.asarray(parameters), terms, jnp.asarray(known), observed)
    variances = scale * np.exp(parameters[:-1])
    return FittedRemainder(
        mean=np.sqrt(scale) * np.asarray(mean).swapaxes(0, 1),
        variance=scale * np.asarray(variance).T,
        variances=dict(zip(TERMS, map(float, variances), strict=True)),
        degrees=float(np.exp(parameters[-1])),
    )


def _terms(frames: list[Timed]) -> Float[np.ndarray, "terms frames frames"]:
    """Return the covariance between frames of each of `TERMS` of a variance of 1."""
    grasp, time = np.array([timed.grasp for timed in frames]), np.array([timed.closed for timed in frames])
    u = np.array([np.asarray(timed.frame.displacement) for timed in frames])
    same = (grasp[:, None] == grasp[None]).astype(float)
    longest, last = np.max(np.sum(u**2, axis=1)), max(float(time.max()), np.finfo(float).tiny)
    share = same * (u @ u.T) / max(float(longest), np.finfo(float).tiny)
    drift, walk = same * np.outer(time, time) / last**2, same * np.minimum(time[:, None], time[None]) / last
    return np.array([same, share, drift, walk, np.eye(len(frames))])


def _likeliest(terms: Float[Array, "terms t t"], observed: Observed) -> Float[np.ndarray, " parameters"]:
    """Return the logarithms of the variances, and of the degrees of freedom, of largest posterior."""
    objective = jax.jit(jax.value_and_grad(minus_log_posterior))
    bounds = [LOG_RANGE] * len(TERMS) + [tuple(np.log(DEGREES_RANGE))]

    def at(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = objective(jnp.asarray(parameters), terms, observed)
        return float(value), np.asarray(gradient)

    starts = [np.array([*[start] * len(TERMS), np.log(10.0)]) for start in STARTS]
    found = [minimize(at, start, jac=True, method="L-BFGS-B", bounds=bounds) for start in starts]
    return np.asarray(min(found, key=lambda one: one.fun).x)


def minus_log_posterior(
    parameters: Float[Array, " parameters"], terms: Float[Array, "terms t t"], observed: Observed
) -> Float[Array, ""]:
    """Return the negative logarithm of likelihood and prior [nat], up to a constant."""
    degrees, gammaln = jnp.exp(parameters[-1]), jax.scipy.special.gammaln

    def log_likelihood(one: Observed) -> Float[Array, ""]:
        factor, white = one.whitened(parameters[:-1], terms)
        squared, count = jnp.sum(white**2), one.count
        normaliser = gammaln((degrees + count) / 2) - gammaln(degrees / 2) - count / 2 * jnp.log(degrees - 2)
        log_det = 3 * jnp.sum(jnp.log(jnp.diagonal(factor)))
        return normaliser - (degrees + count) / 2 * jnp.log1p(squared / (degrees - 2)) - log_det

    prior = 0.5 * jnp.sum((parameters[:-1] / PRIOR_LOG_SD) ** 2)
    return prior - jnp.sum(map_rows(log_likelihood, observed))


@jax.jit
def predicted_remainder(
    parameters: Float[Array, " parameters"],
    terms: Float[Array, "terms frames frames"],
    known: Int[Array, " t"],
    observed: Observed,
) -> tuple[Float[Array, "n frames 3"], Float[Array, "n frames"]]:
    """Return mean and variance of each particle in all frames, as if each was observed anew, from the known ones."""
    variances, degrees = jnp.exp(parameters[:-1]), jnp.exp(parameters[-1])
    lasting = jnp.einsum("k,kfa->fa", variances[:-1], terms[:-1][:, :, known])
    own = jnp.einsum("k,kf->f", variances, jnp.diagonal(terms, axis1=1, axis2=2))

    def of_one(one: Observed) -> tuple[Float[Array, "frames 3"], Float[Array, " frames"]]:
        before = one.at(known)
        factor, white = before.whitened(parameters[:-1], terms[:, known][:, :, known])
        spread = jax.scipy.linalg.solve_triangular(factor, lasting.T, lower=True)
        # the posterior of the particle's own variance, and the variance of its t distribution
        ratio = (degrees - 2 + jnp.sum(white**2)) / (degrees - 2 + before.count)
        return spread.T @ white, ratio * (own - jnp.sum(spread**2, axis=0) + one.noise)

    return jax.lax.map(of_one, observed)
