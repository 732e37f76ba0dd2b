"""Held-out prediction: predict frames that a fit never saw, from the tool's reports alone."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.stats import norm

from ..belief.gaussian_information import GaussianInformation
from ..parallel_map import parallel_map
from .every_frame import weighed
from .fit import Fitted
from .frame_likelihood import FrameLikelihood
from .grasped_frames import ClosedFrame
from .problem import Point, Problem
from .sheet import predict_all

N_PASSES = 2
"""Passes over a grasp, so that each frame's context has the predicted states of those before."""
HELD_STIFFNESS = 1e6
"""Stiffness that fixes what is held [N/m]."""


@dataclass(frozen=True, kw_only=True)
class Variances:
    """Variances of the residuals of a held-out prediction, by their causes [m^2]."""

    stiffness: Float[np.ndarray, "m 3"]
    """Variance by what the fit leaves open of the stiffnesses."""
    others: Float[np.ndarray, "m 3"]
    """Variance by force errors of the model and the noise of observed positions; or by the remainder instead."""


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
        return np.sqrt(self.variances.stiffness + self.variances.others)

    @property
    def rms(self) -> float:
        """Return the root mean square distance [m]."""
        return rms(self.residual)

    @property
    def excess(self) -> float:
        """Return the mean squared standardised residual: 1 if the fit states its errors correctly."""
        return float(np.mean((self.residual / self.sd) ** 2))

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
                stiffness=np.concatenate([part.variances.stiffness for part in parts]),
                others=np.concatenate([part.variances.others for part in parts]),
            ),
        )


def held_out(problem: Problem, fits: dict[int, Fitted]) -> list[HeldOut]:
    """Return the prediction of each part by the fit without it."""
    return list(parallel_map(lambda part: predict_held_out(problem, fits[part], part), fits).values())


def predict_held_out(problem: Problem, fitted: Fitted, part: int) -> HeldOut:
    """Return the prediction of one part that was not fitted to."""
    frames = problem.frames({part})
    predicted, closed = from_rest(problem, fitted.point, frames, by_tool=True), problem.history.frames

    def variances() -> Variances:
        weights, known = weighed(problem, predicted, frames), _covariance(problem, fitted)

        def one(k: int) -> Variances:
            return _variances(problem, weights[k], closed[k].frame, known, jnp.asarray(predicted.states[k]))

        every = parallel_map(one, frames)
        counted = {k: np.asarray(closed[k].frame.counted) for k in frames}
        return Variances(
            stiffness=np.concatenate([every[k].stiffness[counted[k]] for k in frames]),
            others=np.concatenate([every[k].others[counted[k]] for k in frames]),
        )

    return HeldOut(residual=residuals(problem, predicted, frames), compute_variances=variances)


def noise_variance(problem: Problem, frame: ClosedFrame) -> Float[np.ndarray, " n"]:
    """Return the variance of a coordinate of each particle by the noise of observed positions [m^2]."""
    white = 1 / np.maximum(np.asarray(frame.precision)[:, 0, 0], 1.0)
    return white + np.sum(problem.noise**2, axis=1)


def residuals(problem: Problem, point: Point, frames: list[int]) -> Float[np.ndarray, "m 3"]:
    """Return observed minus predicted positions of some frames, for observed particles that are not held [m]."""
    closed = [(problem.history.frames[k].frame, point.seen[k]) for k in frames]
    return np.concatenate([(np.asarray(frame.y) - seen)[np.asarray(frame.counted)] for frame, seen in closed])


def rms(residual: Float[np.ndarray, "m 3"]) -> float:
    """Return the root mean square length of residuals [m]."""
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


def _covariance(problem: Problem, fitted: Fitted) -> Float[np.ndarray, "n n"]:
    """Return the covariance of a fit's s."""
    n, d = len(fitted.site_precision), len(fitted.free)
    joint = GaussianInformation.from_normal_equations(fitted.square, s=n, theta=d)
    joint = joint.with_independent("s", fitted.site_precision)
    return np.asarray(joint.with_independent("theta", problem.sd(fitted.named) ** -2).covariance("s"))


def _variances(
    problem: Problem,
    likelihood: FrameLikelihood,
    seen: ClosedFrame,
    known: Float[np.ndarray, "n n"],
    x: Float[Array, "n 3"],
) -> Variances:
    """Return the variances of each observed coordinate; `known` is the covariance of s."""
    n, frame, held = len(x), likelihood.frame, np.asarray(seen.held)
    rows = np.zeros((n + 1, 3, n + 1, 3))
    neighbours = np.asarray(likelihood.balance.neighbours)
    rows[np.arange(n)[:, None], :, neighbours] = np.moveaxis(np.asarray(frame.dr_dx), 2, 3).swapaxes(2, 3)
    H = rows[:n, :, :n].reshape(3 * n, 3 * n)
    H[np.repeat(held, 3)] = 0.0
    H[np.repeat(held, 3), np.repeat(held, 3)] = HELD_STIFFNESS
    inverse = np.linalg.inv(H)
    force = np.where(held, 0.0, np.asarray(problem.sheet.balance.error(x)))
    wrong = np.sum((inverse.reshape(3 * n, n, 3) * force[None, :, None]) ** 2, axis=(1, 2))
    slope = np.where(held[:, None], 0.0, np.asarray(frame.dr_ds))
    response = np.einsum("ani,ni->an", inverse.reshape(3 * n, n, 3), slope)
    unsure = np.sum((response @ known) * response, axis=1)
    return Variances(
        stiffness=np.maximum(unsure, 0).reshape(n, 3),
        others=wrong.reshape(n, 3) + noise_variance(problem, seen)[:, None],
    )
