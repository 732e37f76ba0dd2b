"""Starts of the fit of a hypothesis: where a wrong model has led the attachments astray, they are not those of its fit.

Around the states that the filter estimated, the forces that do not balance are linear in the bounded stiffnesses s, for
whatever s. So their normal equations give s and the parameters of any effects in one step, as the implicit filter does.
Noise of the states biases them, so they are starts alone. Another is a linear step from the fit without the effect.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..belief.attachment_belief import AttachmentBelief
from ..belief.gaussian_information import GaussianInformation
from ..filters.implicit import likeliest, quick_summary
from .every_frame import directions, linearised, weighed
from .gauss_newton import MAX_STIFFNESS, Fitted, moved, start
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
        equations = linearised(problem, point, weighed(problem, point, frames), directions(problem, np.arange(size)))
        return cls(problem=problem, point=point, frames=frames, square=reduced(problem, equations, size))

    def starts(self, named: np.ndarray) -> list[Point]:
        """Return starts of a fit of the parameters `named`: with the attachments one by one, and the likeliest set."""
        problem, s, n = self.problem, self.point.s, len(self.point.s)
        free, sd = problem.free(named), problem.sd(named)
        kept = np.concatenate([np.arange(n), n + free, [len(self.square) - 1]])
        joint = GaussianInformation.from_normal_equations(self.square[np.ix_(kept, kept)], s=n, theta=len(free))
        joint = joint.with_independent("theta", sd**-2)
        of_s = joint.marginal("s")
        precision = np.asarray(of_s.precision)
        summary = quick_summary(problem.prior.add(jnp.asarray(precision), jnp.asarray(of_s.shift + precision @ s)))
        assert isinstance(summary.belief, AttachmentBelief)
        detected = problem.prior.bounded(jnp.where(summary.probability > 0.5, summary.b, 0.0))
        found = []
        for to in (np.asarray(detected), np.asarray(likeliest(summary.belief))):
            to = np.clip(to, 0, MAX_STIFFNESS)
            step = joint.condition(s=to - s).mean()
            theta = np.zeros(problem.sheet.size)
            lowest = np.maximum(problem.lower_bounds(free), -MAX_START_SDS * sd)
            theta[free] = np.clip(step, lowest, MAX_START_SDS * sd)
            found.append(start(problem, theta, to, self.point.states, self.frames))
        return found


def stepped(before: Fitted, at: np.ndarray, score: Score) -> Point:
    """Return the point after a linear step of an effect, at the indices `at`, from a fit without it."""
    problem, limit = before.problem, MAX_START_SDS * before.problem.prior_sd[at]
    step = np.clip(before.point.theta[at] + score.theta, np.maximum(problem.lower_bounds(at), -limit), limit)
    return moved(before, at, step)
