"""Predict the sheet with all effects of a library: its equilibria, and how they are observed."""

from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..effects.effect import Effect, with_effects
from ..effects.frame_history import CONVERGED, MAX_PREDICTIONS, FrameHistory
from ..effects.sheet_model import FrameContext, SheetModel, View, look, without_view
from ..filters.evidence import Evidence
from ..filters.force_balance import ForceBalance
from ..parallel_map import parallel_map
from .grasped_frames import ClosedFrame, Timed

GRIP_PRECISION = 1e6
"""Precision of the held particles' positions while a state is predicted [1/m^2]."""


class PredictedSheet(eqx.Module):
    """A declared sheet with the effects that it may lack."""

    balance: ForceBalance
    """Force balance of the declared sheet."""
    view: View
    """View without effects."""
    library: tuple[Effect, ...] = eqx.field(static=True)
    """Effects, which act on the model in this order."""
    declared: Mapping[str, Float[np.ndarray, " _p"] | Float[Array, " _p"]] = eqx.field(default_factory=dict)
    """Parameters of the declared effects, by name: parameters of the library are in addition to them."""

    @property
    def size(self) -> int:
        """Return the number of parameters of the library."""
        return sum(effect.size for effect in self.library)

    def effect(self, name: str) -> Effect:
        """Return the library's effect of a name."""
        return next(effect for effect in self.library if effect.name == name)

    def place(self, name: str, site: int | None = None) -> np.ndarray:
        """Return the indices of an effect's parameters, at one site or at all.

        Raises:
            ValueError: there is no such effect.
        """
        start = 0
        for effect in self.library:
            if effect.name == name:
                at = np.arange(start, start + effect.size)
                return at if site is None else at.reshape(effect.sites, -1)[site]
            start += effect.size
        raise ValueError(f"there is no effect {name!r}; there are {[effect.name for effect in self.library]}.")

    def plain(self, context: FrameContext, tool: Float[Array, " 3"]) -> SheetModel:
        """Return the model of one frame without effects; `tool` is the reported displacement [m]."""
        return SheetModel(energy=self.balance.energy, tool=tool, view=self.view, time=context.time)

    def model(self, theta: Float[Array, " p"], context: FrameContext, tool: Float[Array, " 3"]) -> SheetModel:
        """Return the model of one frame with effects of parameters theta; `tool` is the reported displacement [m]."""
        for name, declared in self.declared.items():
            theta = theta.at[self.place(name)].add(declared)
        return with_effects(self.plain(context, tool), self.library, theta, context)

    def depends_on_history(self, theta: Float[np.ndarray, " p"]) -> bool:
        """Return whether frames with these parameters depend on their own states."""
        return any(
            effect.history_dependent and (effect.name in self.declared or np.any(theta[self.place(effect.name)]))
            for effect in self.library
        )


def closed_on(
    sheet: PredictedSheet, theta: Float[Array, " p"], frame: ClosedFrame, context: FrameContext
) -> Float[Array, "n 3"]:
    """Return where the jaws closed on the held particles, with the view's errors of that time removed [m]."""
    at_closing = (context.time - context.closed, jnp.zeros_like(context.closed))
    model = sheet.model(theta, eqx.tree_at(lambda m: (m.time, m.closed), context, at_closing), frame.displacement)
    return without_view(model, context.rest, frame.rotated)


def tool_residual(
    sheet: PredictedSheet,
    model: SheetModel,
    theta: Float[Array, " p"],
    frame: ClosedFrame,
    context: FrameContext,
    x: Float[Array, "n 3"],
) -> Float[Array, " 3"]:
    """Return the displacement of the held particles minus that of the tool [m].

    It is 0 where the tool gives no information: if its report is derived from the points, or the jaws have just closed.
    """
    residual = held_displacement(model, frame, closed_on(sheet, theta, frame, context), x) - model.tool
    return jnp.where(frame.by_points | (context.closed <= 0), 0.0, residual)


def held_displacement(
    model: SheetModel, frame: ClosedFrame, closed: Float[Array, "n 3"], x: Float[Array, "n 3"]
) -> Float[Array, " 3"]:
    """Return the displacement of the held particles without the view's errors [m]; the tool's if none is observed."""
    displacement = mean_of_held(frame, x + frame.y - look(model, x) - closed)
    return jnp.where(jnp.any(frame.held & frame.visible), displacement, model.tool)


def gripped_forces(
    sheet: PredictedSheet,
    theta: Float[Array, " p"],
    s: Float[Array, " n"],
    frame: ClosedFrame,
    context: FrameContext,
    x: Float[Array, "n 3"],
) -> Float[Array, "n 3"]:
    """Return the forces r at x, those of the springs to where the grip is observed included [N].

    At a predicted state they are 0, so that their derivatives say how it changes.
    """
    model, closed = sheet.model(theta, context, frame.displacement), closed_on(sheet, theta, frame, context)
    grip = closed + held_displacement(model, frame, closed, x)[None]
    springs = jnp.where(frame.held, (1 - s) * sheet.balance.grip_stiffness, 0.0)
    return sheet.balance.with_energy(model.energy).unbalanced(x, s) + springs[:, None] * (x - grip)


def mean_of_held(frame: ClosedFrame, values: Float[Array, "n ..."]) -> Float[Array, "..."]:
    """Return the mean over the held particles that are observed; zero if there are none."""
    both = frame.held & frame.visible
    among = jnp.expand_dims(both, tuple(range(1, values.ndim)))
    return jnp.sum(jnp.where(among, values, 0.0), axis=0) / jnp.maximum(jnp.sum(both, dtype=float), 1.0)


class Predicted(eqx.Module):
    """Prediction of one frame."""

    x: Float[Array, "n 3"]
    """Positions [m]."""
    seen: Float[Array, "n 3"]
    """Observation of x [m]."""


@eqx.filter_jit
def predict(
    sheet: PredictedSheet,
    theta: Float[Array, " p"],
    s: Float[Array, " n"],
    frame: ClosedFrame,
    context: FrameContext,
    start: Float[Array, "n 3"],
    by_tool: Bool[Array, ""],
) -> Predicted:
    """Return the equilibrium, searched from `start`; what is held moves as observed, or as the tool reports."""
    model = sheet.model(theta, context, frame.displacement)
    closed = closed_on(sheet, theta, frame, context)
    use_tool = by_tool & ~frame.by_points
    to = closed + jnp.where(use_tool, model.tool, held_displacement(model, frame, closed, start))[None]
    precision = jnp.broadcast_to(GRIP_PRECISION * jnp.eye(3)[None], (len(s), 3, 3))
    grip = Evidence(y=to, precision=precision, held=frame.held, force_unknown=frame.force_unknown)
    begin = jnp.where(frame.held[:, None], to, start)
    x = sheet.balance.with_energy(model.energy).predict(begin, s, grip)
    return Predicted(x=x, seen=look(model, x))


def predict_all(
    sheet: PredictedSheet,
    theta: np.ndarray,
    s: np.ndarray,
    history: FrameHistory[Timed],
    states: Float[np.ndarray, "frames n 3"],
    *,
    only: list[int] | None = None,
    by_tool: bool = False,
    max_predictions: int = MAX_PREDICTIONS,
) -> tuple[Float[np.ndarray, "frames n 3"], Float[np.ndarray, "frames n 3"]]:
    """Return the predicted states of all frames [m], and their observations, NaN where not predicted.

    The frames of a grasp are predicted in order, each from the states so far. Grasps are predicted in parallel: for
    other grasps an effect has `states`, not the predictions of this call.

    Args:
        sheet: predicts each frame.
        theta: all parameters.
        s: bounded stiffnesses.
        history: all frames.
        states: states to search from, and those of frames that are not predicted [m].
        only: frames to predict; all if None.
        by_tool: whether what is held moves as the tool reports; if not, as observed.
        max_predictions: largest number of predictions of a frame with a history-dependent effect.
    """
    grasps = history.by(lambda one: one.grasp, range(len(history.frames)) if only is None else only)
    predicted, seen = states.copy(), np.full(states.shape, np.nan)
    rounds = max_predictions if sheet.depends_on_history(theta) else 1
    at, stiffnesses, use_tool = jnp.asarray(theta), jnp.asarray(s), jnp.asarray(by_tool)

    def predict_grasp(grasp: int) -> None:
        known = states.copy()
        for k in grasps[grasp]:
            frame = history.frames[k].frame
            for _ in range(rounds):
                context, start = history.context(k, known), jnp.asarray(known[k])
                prediction = predict(sheet, at, stiffnesses, frame, context, start, use_tool)
                x = np.asarray(prediction.x)
                converged = np.abs(x - known[k]).max() < CONVERGED
                known[k], predicted[k], seen[k] = x, x, np.asarray(prediction.seen)
                if converged:
                    break

    parallel_map(predict_grasp, grasps)
    return predicted, seen
