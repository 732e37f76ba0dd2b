"""Predict the force of the tool by a fit: in fitted frames, and in frames that it never saw."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .gauss_newton import Fitted
from .held_out import from_rest, rms
from .tool_pull import predicted_pull


def predicted_forces(fitted: Fitted, frames: list[int]) -> Float[np.ndarray, "t 3"]:
    """Return the force on the tool in frames [N]; those that were not fitted are predicted from the tool's reports."""
    problem, found = fitted.problem, []
    new = [k for k in frames if k not in fitted.equations]
    point = from_rest(problem, fitted.point, new, by_tool=True) if new else fitted.point
    theta, s, states = jnp.asarray(point.theta), jnp.asarray(point.s), jnp.asarray(point.states)
    for k in frames:
        frame, context = problem.history.frames[k].frame, problem.history.context(k, states)
        model = problem.sheet.model(theta, context, frame.displacement)
        found.append(-np.asarray(predicted_pull(problem.sheet.balance, model, frame, s, states[k])))
    return np.array(found)


def measured_forces(fitted: Fitted, frames: list[int]) -> Float[np.ndarray, "t 3"]:
    """Return the measured force on the tool in frames that have one [N]."""
    pulls = [fitted.problem.history.frames[k].frame.pull for k in frames]
    return np.array([-np.asarray(pull.force) for pull in pulls if pull is not None])


def held_out_force_rms(fitted: Fitted, part: int) -> float | None:
    """Return the root mean square error of the force in a part that was not fitted to [N]; None where none is known."""
    frames = [k for k in fitted.problem.frames({part}) if fitted.problem.with_force([k])]
    return rms(measured_forces(fitted, frames) - predicted_forces(fitted, frames)) if frames else None
