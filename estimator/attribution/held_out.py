"""Held-out prediction: predict frames that a fit never saw, from the tool's reports alone.

Where other frames of the same grasp were fitted before, their errors persist.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import norm

from ..belief.gaussian_information import GaussianInformation
from ..parallel_map import parallel_map
from .every_frame import directions, weighed
from .frame_likelihood import FrameLikelihood
from .gauss_newton import Fitted
from .linear import columns_of
from .persistence import carried
from .problem import Point, Problem
from .sheet import predict_all

N_PASSES = 2
"""Passes over a grasp, so that each frame's context has the predicted states of those before."""
HELD_STIFFNESS = 1e6
"""Stiffness that fixes what is held [N/m]."""


@dataclass(frozen=True, kw_only=True)
class Variances:
    """Variances of the residuals of a held-out prediction, by their causes [m^2]."""

    fit: Float[np.ndarray, "m 3"]
    """Variance by what the fit leaves open of the stiffnesses and the parameters."""
    others: Float[np.ndarray, "m 3"]
    """Variance by force errors of the model, its smooth fields and the noise of observed positions, of the sizes that
    were fitted, as far as they are new; or by the remainder instead."""


@dataclass(frozen=True, kw_only=True)
class HeldOut:
    """Held-out prediction of a part, for particles that are observed and not held."""

    residual: Float[np.ndarray, "m 3"]
    """Observed minus predicted positions [m]."""
    compute_variances: Callable[[], Variances]
    """Function that computes `variances`, which costs more than all the rest."""

    @cached_property
    def variances(self) -> Variances:
        """Return the variances of the residual under the fit."""
        return self.compute_variances()

    @property
    def sd(self) -> Float[np.ndarray, "m 3"]:
        """Return the standard deviation of the residual under the fit [m]."""
        return np.sqrt(self.variances.fit + self.variances.others)

    @property
    def rms(self) -> float:
        """Return the root mean square distance [m]."""
        return rms(self.residual)

    @property
    def nll(self) -> float:
        """Return the mean negative log likelihood of a coordinate [nat, lengths in m]."""
        return float(np.mean(0.5 * (self.residual / self.sd) ** 2 + np.log(self.sd) + 0.5 * np.log(2 * np.pi)))

    @property
    def coverage_90(self) -> float:
        """Return the share of coordinates within their 90 % intervals."""
        return float(np.mean(np.abs(self.residual) <= norm.ppf(0.95) * self.sd))

    def beyond(self, mean: Float[np.ndarray, "m 3"], variance: Float[np.ndarray, " m"]) -> "HeldOut":
        """Return the prediction with a remainder of this mean [m] and variance [m^2], noise included, in it."""
        return HeldOut(
            residual=self.residual - mean,
            compute_variances=lambda: replace(self.variances, others=np.repeat(variance[:, None], 3, axis=1)),
        )

    @staticmethod
    def together(parts: list["HeldOut"]) -> "HeldOut":
        """Return the predictions of several parts as one."""
        return HeldOut(
            residual=np.concatenate([part.residual for part in parts]),
            compute_variances=lambda: Variances(
                fit=np.concatenate([part.variances.fit for part in parts]),
                others=np.concatenate([part.variances.others for part in parts]),
            ),
        )


def held_out(fits: dict[int, Fitted]) -> list[HeldOut]:
    """Return the prediction of each part by the fit without it."""
    return list(parallel_map(lambda part: predict_held_out(fits[part], part), fits).values())


def predict_held_out(fitted: Fitted, part: int, *, persistent: bool = True) -> HeldOut:
    """Return the prediction of one part that was not fitted to.

    Args:
        fitted: the fit.
        part: number of the part.
        persistent: whether what persists of the errors of the last fitted frame is in it.
    """
    problem = fitted.problem
    frames, closed = problem.frames({part}), problem.history.frames
    known_errors = list(fitted.weights) if persistent else []
    last = {k: problem.last_seen(k, known_errors) for k in frames}
    lasts = sorted({int(j) for one in last.values() for j in one[one >= 0]})
    predicted = from_rest(problem, fitted.point, [*lasts, *frames], by_tool=True)
    error = {k: np.asarray(closed[k].frame.y) - predicted.seen[k] for k in [*lasts, *frames]}

    def residual(k: int) -> Float[np.ndarray, "m 3"]:
        rho = np.asarray(problem.persistence(k, known_errors).autocorrelation)
        found = error[k] - rho[:, None] * np.asarray(carried(last[k], error, error[k]))
        return found[closed[k].counted]

    def variances() -> Variances:
        known = _covariance(fitted)
        unseen = _as_predicted(problem, predicted, [*lasts, *frames])  # the last ones too, to be compared with
        weights = weighed(unseen, predicted, [*lasts, *frames], among=known_errors)
        by_fit = parallel_map(lambda j: _of_particles(responses(fitted, predicted, weights[j], j)[1]), lasts)

        def one(k: int) -> Variances:
            return _variances(fitted, predicted, weights[k], k, last[k], by_fit, known)

        every = parallel_map(one, frames)
        return Variances(
            fit=np.concatenate([every[k].fit[closed[k].counted] for k in frames]),
            others=np.concatenate([every[k].others[closed[k].counted] for k in frames]),
        )

    return HeldOut(residual=np.concatenate([residual(k) for k in frames]), compute_variances=variances)


def _as_predicted(problem: Problem, predicted: Point, frames: list[int]) -> Problem:
    """Return a problem that observes some frames as predicted: intervals must not depend on what is seen there."""
    every = list(problem.history.frames)
    for k in frames:
        every[k] = every[k].observing(jnp.asarray(predicted.seen[k]))
    return problem.with_frames(every)


def rms(residual: Float[np.ndarray, "m 3"]) -> float:
    """Return the root mean square length of residuals, in their unit."""
    return float(np.sqrt(np.mean(np.sum(residual**2, axis=1))))


def from_rest(problem: Problem, point: Point, frames: list[int], *, by_tool: bool) -> Point:
    """Return a point with some frames predicted again, searched from rest.

    Args:
        problem: has the frames.
        point: parameters and stiffnesses.
        frames: frames to predict.
        by_tool: whether what is held moves as the tool reports; if not, as observed.
    """
    again = np.isin(np.arange(len(point.states)), frames)[:, None, None]
    states = np.where(again, np.asarray(problem.history.rest)[None], point.states)
    seen = states
    for _ in range(N_PASSES):
        states, seen = predict_all(
            problem.sheet, point.theta, point.s, problem.history, states, only=frames, by_tool=by_tool
        )
    return replace(point, states=states, seen=seen)


def _covariance(fitted: Fitted) -> Float[np.ndarray, "k k"]:
    """Return the covariance of a fit's s and free parameters."""
    n, d = len(fitted.site_precision), len(fitted.free)
    joint = GaussianInformation.from_normal_equations(fitted.square, s=n, theta=d)
    joint = joint.with_independent("s", fitted.site_precision)
    return np.asarray(joint.with_independent("theta", fitted.problem.sd(fitted.named) ** -2).covariance())


def _variances(
    fitted: Fitted,
    predicted: Point,
    likelihood: FrameLikelihood,
    k: int,
    last: Int[np.ndarray, " n"],
    by_fit_before: dict[int, Float[np.ndarray, "n 3 k"]],
    known: Float[np.ndarray, "k k"],
) -> Variances:
    """Return the variances of each observed coordinate of frame k.

    Args:
        fitted: the fit.
        predicted: the prediction.
        likelihood: weights at the predicted state.
        k: the frame.
        last: the fitted frame that the error of each particle follows; -1 if none.
        by_fit_before: how the residuals of the last fitted frames move with s and theta.
        known: covariance of s and parameters.
    """
    problem, n = fitted.problem, len(likelihood.seen)
    closed = problem.history.frames[k].frame
    by_force, by_fit = responses(fitted, predicted, likelihood, k)
    by_fit = _of_particles(by_fit)
    rho, new = (np.asarray(one) for one in (likelihood.persistence.autocorrelation, likelihood.persistence.new))
    by_fit = by_fit - rho[:, None, None] * np.asarray(carried(last, by_fit_before, by_fit))
    error = np.asarray(problem.sheet.balance.error(jnp.asarray(predicted.states[k])))
    fields = np.einsum("ani,nij->aj", by_force, np.asarray(likelihood.fields)) * problem.amplitude
    wrong = np.sum((by_force * error[None, :, None]) ** 2, axis=(1, 2)) + np.sum(fields**2, axis=1)
    others = wrong.reshape(n, 3) + closed.noise_variance(problem.noise)[:, None]
    return Variances(fit=np.maximum(np.sum((by_fit @ known) * by_fit, axis=2), 0), others=new[:, None] * others)


def _of_particles(by_fit: Float[np.ndarray, "m k"]) -> Float[np.ndarray, "n 3 k"]:
    return by_fit.reshape(-1, 3, by_fit.shape[1])


def responses(
    fitted: Fitted, predicted: Point, likelihood: FrameLikelihood, k: int
) -> tuple[Float[np.ndarray, "m n 3"], Float[np.ndarray, "m j"]]:
    """Return how the residual of each coordinate of frame k moves with a force on each particle, and with s and theta.

    It is H^-1 times the forces, with what is held fixed.
    """
    problem, n = fitted.problem, len(likelihood.seen)
    closed, states = problem.history.frames[k].frame, jnp.asarray(predicted.states)
    held, H = np.asarray(closed.held), _with_held_fixed(likelihood, np.asarray(closed.held))
    by_force = np.where(held[None, :, None], 0.0, np.linalg.inv(H).reshape(3 * n, n, 3))
    columns = columns_of(
        problem.sheet,
        likelihood,
        jnp.asarray(predicted.theta),
        jnp.asarray(directions(problem, fitted.free)),
        closed,
        problem.history.context(k, states),
    )
    of_parameters = columns.sheet.of_theta(likelihood)[:, :, : len(fitted.free)]
    by_s = np.einsum("ani,ni->an", by_force, np.asarray(likelihood.frame.dr_ds))
    by_theta = np.einsum("ani,nij->aj", by_force, np.asarray(of_parameters))
    return by_force, np.concatenate([by_s, by_theta], axis=1)


def _with_held_fixed(likelihood: FrameLikelihood, held: Bool[np.ndarray, " n"]) -> Float[np.ndarray, "m m"]:
    """Return H with the equations of what is held replaced by stiff springs."""
    n = len(held)
    rows = np.zeros((n + 1, 3, n + 1, 3))
    neighbours = np.asarray(likelihood.balance.neighbours)
    slope = np.asarray(likelihood.frame.dr_dx)
    rows[np.arange(n)[:, None], :, neighbours] = np.moveaxis(slope, 2, 3).swapaxes(2, 3)
    H = rows[:n, :, :n].reshape(3 * n, 3 * n)
    H[np.repeat(held, 3)] = 0.0
    H[np.repeat(held, 3), np.repeat(held, 3)] = HELD_STIFFNESS
    return H
