"""How well frames are foretold that a fit never saw, from what the tool says alone."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.stats import norm

from ..belief.gaussian_information import GaussianInformation
from ..parallel_map import parallel_map
from .closed_frames import ClosedFrame
from .every_frame import weighed
from .fit import Fitted
from .linear import Metric
from .problem import Point, Problem
from .sheet import predict_all

ROUNDS = 2
"""Passes over a grasp, so that its frames know the states of those before."""
PINNED = 1e6
"""Stiffness that stands for what is held [N/m]."""


@dataclass(frozen=True, kw_only=True)
class HeldOut:
    """A grasp's frames, particles that were seen and not held."""

    off: Float[np.ndarray, "m 3"]
    """Seen less foretold [m]."""
    reckon: Callable[[], Float[np.ndarray, "m 3"]]
    """What makes `sd`, which costs more than all the rest."""

    @cached_property
    def sd(self) -> Float[np.ndarray, "m 3"]:
        """Of what is off, as the fit has it [m]."""
        return self.reckon()

    @property
    def rms(self) -> float:
        """Root mean square distance [m]."""
        return rms(self.off)

    @property
    def excess(self) -> float:
        """Mean square of the error in standard deviations: 1 where the fit knows how well it foretells."""
        return float(np.mean((self.off / self.sd) ** 2))

    @property
    def nll(self) -> float:
        """Mean negative log likelihood of a coordinate [nat, lengths in m]."""
        return float(np.mean(0.5 * (self.off / self.sd) ** 2 + np.log(self.sd) + 0.5 * np.log(2 * np.pi)))

    @property
    def coverage_90(self) -> float:
        """Share of coordinates within their 90 % intervals."""
        return float(np.mean(np.abs(self.off) <= norm.ppf(0.95) * self.sd))

    @staticmethod
    def together(parts: list["HeldOut"]) -> "HeldOut":
        """Several grasps."""
        return HeldOut(
            off=np.concatenate([one.off for one in parts]), reckon=lambda: np.concatenate([one.sd for one in parts])
        )


def held_out(problem: Problem, fits: dict[int, Fitted]) -> list[HeldOut]:
    """Each part by the fit without it."""
    return list(parallel_map(lambda part: predict_held_out(problem, fits[part], part), fits).values())


def predict_held_out(problem: Problem, fitted: Fitted, part: int) -> HeldOut:
    """One part that was not fitted to."""
    frames = problem.frames({part})
    anew, closed = from_rest(problem, fitted.point, frames, by_tool=True), problem.history.frames

    def sd() -> Float[np.ndarray, "m 3"]:
        weights, known = weighed(problem, anew, frames), _covariance(problem, fitted)

        def one(k: int) -> Float[np.ndarray, "n 3"]:
            return _sd(problem, weights[k], closed[k].frame, known, jnp.asarray(anew.states[k]))

        every = parallel_map(one, frames)
        return np.concatenate([every[k][np.asarray(closed[k].frame.counted)] for k in frames])

    return HeldOut(off=off(problem, anew, frames), reckon=sd)


def off(problem: Problem, point: Point, frames: list[int]) -> Float[np.ndarray, "m 3"]:
    """Seen less predicted of some frames, of the particles that are counted [m]."""
    closed = [(problem.history.frames[k].frame, point.seen[k]) for k in frames]
    return np.concatenate([(np.asarray(frame.y) - seen)[np.asarray(frame.counted)] for frame, seen in closed])


def rms(off: Float[np.ndarray, "m 3"]) -> float:
    """Root mean square distance [m]."""
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def from_rest(problem: Problem, point: Point, frames: list[int], *, by_tool: bool) -> Point:
    """Some frames predicted anew, searched from rest; what is held goes as the tool says, or as it was seen."""
    again = np.isin(np.arange(len(point.states)), frames)[:, None, None]
    states = np.where(again, np.asarray(problem.history.rest)[None], point.states)
    seen = states
    for _ in range(ROUNDS):
        states, seen = predict_all(
            problem.sheet, point.theta, point.s, problem.history, states, only=frames, by_tool=by_tool
        )
    return replace(point, states=states, seen=seen)


def _covariance(problem: Problem, fitted: Fitted) -> Float[np.ndarray, "n n"]:
    """Of a fit's s."""
    n, d = len(fitted.site_precision), len(fitted.free)
    joint = GaussianInformation.from_normal_equations(fitted.square, s=n, theta=d)
    joint = joint.with_independent("s", fitted.site_precision)
    return np.asarray(joint.with_independent("theta", problem.sd(fitted.named) ** -2).covariance("s"))


def _sd(
    problem: Problem, metric: Metric, seen: ClosedFrame, known: Float[np.ndarray, "n n"], x: Float[Array, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Of what is seen of each particle: the noise, the forces that the model gets wrong, and s."""
    n, frame, held = len(x), metric.frame, np.asarray(seen.held)
    rows = np.zeros((n + 1, 3, n + 1, 3))
    neighbours = np.asarray(metric.balance.neighbours)
    rows[np.arange(n)[:, None], :, neighbours] = np.moveaxis(np.asarray(frame.dr_dx), 2, 3).swapaxes(2, 3)
    H = rows[:n, :, :n].reshape(3 * n, 3 * n)
    H[np.repeat(held, 3)] = 0.0
    H[np.repeat(held, 3), np.repeat(held, 3)] = PINNED
    inverse = np.linalg.inv(H)
    force = np.where(held, 0.0, np.asarray(problem.sheet.balance.error(x)))
    wrong = np.sum((inverse.reshape(3 * n, n, 3) * force[None, :, None]) ** 2, axis=(1, 2))
    slope = np.where(held[:, None], 0.0, np.asarray(frame.dr_ds))
    response = np.einsum("ani,ni->an", inverse.reshape(3 * n, n, 3), slope)
    unsure = np.sum((response @ known) * response, axis=1)
    white = 1 / np.maximum(np.asarray(seen.precision)[:, 0, 0], 1.0)
    noise = white + np.sum(problem.noise**2, axis=1)
    return np.sqrt(wrong.reshape(n, 3) + np.maximum(unsure, 0).reshape(n, 3) + noise[:, None])
