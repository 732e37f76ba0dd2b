"""Starts of the fit of a hypothesis: where a wrong model has led the attachments astray, they are not those of its fit.

Around the states that the filter estimated, the forces that do not balance are linear in the bounded stiffnesses s, for
whatever s. So their normal equations give s and the parameters of any effects in one step, as the implicit filter does.
Noise of the states biases them, so they are starts alone. Another is a linear step from the fit without the effect.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from .every_frame import directions, linearised, residual, weighed
from .gauss_newton import (
    MAX_STIFFNESS,
    Fitted,
    detected,
    joint_information,
    likeliest_together,
    moved,
    posterior,
    start,
)
from .normal_equations import reduced
from .problem import Point, Problem
from .scores import Score

MAX_START_SDS = 2.0
"""Largest size of a parameter at the start of a fit [prior standard deviations]."""


@dataclass(frozen=True, kw_only=True)
class ObservedStates:
    """Normal equations around the filter's states."""

    problem: Problem
    """What is fitted to."""
    point: Point
    """The filter's states, with its stiffnesses and without effects."""
    frames: list[int]
    """Frames that are fitted to."""
    square: Float[np.ndarray, "k k"]
    """Normal equations over s, all parameters of the library and -1."""

    @classmethod
    def around(
        cls, problem: Problem, s: Float[np.ndarray, " n"], states: Float[np.ndarray, "frames n 3"], frames: list[int]
    ) -> "ObservedStates":
        """Return the normal equations around some states with bounded stiffnesses s."""
        size = problem.sheet.size
        point = Point(theta=np.zeros(size), s=s, states=states, seen=states)
        weights = weighed(problem, point, frames)
        every = residual(problem, weights, point)
        equations = linearised(problem, point, weights, every, directions(problem, np.arange(size)))
        return cls(problem=problem, point=point, frames=frames, square=reduced(problem, equations, size))

    def starts(self, named: np.ndarray) -> list[Point]:
        """Return starts of a fit of the parameters `named`: with the attachments one by one, and the likeliest set."""
        problem, point, n = self.problem, self.point, len(self.point.s)
        free, sd = problem.free(named), problem.sd(named)
        kept = np.concatenate([np.arange(n), n + free, [len(self.square) - 1]])
        square = self.square[np.ix_(kept, kept)]
        joint = joint_information(square, point, free, sd)
        found = []
        summary = posterior(problem, square, point, free, sd)
        for to in (detected(problem, summary), likeliest_together(summary)):
            to = np.clip(to, 0, MAX_STIFFNESS)
            step = np.asarray(joint.condition(s=to - point.s).mean())
            theta = np.zeros(problem.sheet.size)
            theta[free] = problem.bounded(free, step, MAX_START_SDS * sd)
            found.append(start(problem, theta, to, point.states, self.frames))
        return found


def stepped(before: Fitted, at: np.ndarray, score: Score) -> Point:
    """Return the point after a linear step of an effect, at the indices `at`, from a fit without it."""
    problem = before.problem
    to = problem.bounded(at, before.point.theta[at] + score.theta, MAX_START_SDS * problem.prior_sd[at])
    return moved(before, at, to)
