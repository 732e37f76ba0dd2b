"""The sheet with all effects of a library in it: where it goes and how that is seen."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..effects.effect import Effect
from ..effects.sheet_model import FrameContext, SheetModel, View, tangents
from ..filters.evidence import Evidence
from ..filters.force_balance import ForceBalance
from ..parallel_map import parallel_map
from ..physics.energy import SheetEnergy
from ..physics.membrane import TriangleMembrane
from .closed_frames import ClosedFrame, FrameHistory

GRIPPED = 1e6
"""Precision with which the grip carries what it holds while a state is predicted [1/m^2]."""

ROUNDS, STAYS = 4, 1e-5
"""How often a frame is predicted at most with an effect that lingers, and how little it moves when it stays [m]."""


class PredictedSheet(eqx.Module):
    """One sheet and what it may lack."""

    balance: ForceBalance
    view: View
    library: tuple[Effect, ...] = eqx.field(static=True)

    @property
    def size(self) -> int:
        """How many parameters the library has."""
        return sum(effect.size for effect in self.library)

    def effect(self, name: str) -> Effect:
        """The library's effect of a name."""
        return next(one for one in self.library if one.name == name)

    def place(self, name: str, site: int | None = None) -> np.ndarray:
        """Where an effect's parameters are, at one site or at all."""
        start = 0
        for effect in self.library:
            if effect.name == name:
                at = np.arange(start, start + effect.size)
                return at if site is None else at.reshape(effect.sites, -1)[site]
            start += effect.size
        raise ValueError(f"there is no effect {name!r}; there are {[one.name for one in self.library]}.")

    def plain(self, moment: FrameContext, way: Float[Array, " 3"]) -> SheetModel:
        """Of one frame, without any."""
        return SheetModel(energy=self.balance.energy, tool=way, view=self.view, time=moment.time)

    def model(self, theta: Float[Array, " p"], moment: FrameContext, way: Float[Array, " 3"]) -> SheetModel:
        """Of one frame, with effects of those sizes."""
        model, start = self.plain(moment, way), 0
        for effect in self.library:
            model = effect.acts(model, theta[start : start + effect.size], moment)
            start += effect.size
        return model

    def balance_of(self, energy: SheetEnergy) -> ForceBalance:
        """The balance of forces for a changed energy."""
        springs = self.balance.tethered.energy.terms[-1]
        changed = energy, energy.rest, (*energy.terms, springs)
        return eqx.tree_at(lambda b: (b.energy, b.tethered.energy.rest, b.tethered.energy.terms), self.balance, changed)


def look(model: SheetModel, x: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Where particles at x are seen."""
    return model.view(x, tangents=tangents(model.term(TriangleMembrane), x))


def closed_on(
    sheet: PredictedSheet, theta: Float[Array, " p"], frame: ClosedFrame, moment: FrameContext
) -> Float[Array, "n 3"]:
    """Where the jaws closed on the held particles, the errors that the view had then taken off [m]."""
    then = (moment.time - moment.closed, jnp.zeros_like(moment.closed))
    model = sheet.model(theta, eqx.tree_at(lambda m: (m.time, m.closed), moment, then), frame.way)
    along = tangents(model.term(TriangleMembrane), moment.rest)
    slid = model.view.followed(moment.rest, along) - moment.rest
    return 2 * frame.rotated - model.view.moved(frame.rotated + slid)


def beyond_tool(
    sheet: PredictedSheet,
    model: SheetModel,
    theta: Float[Array, " p"],
    frame: ClosedFrame,
    moment: FrameContext,
    x: Float[Array, "n 3"],
) -> Float[Array, " 3"]:
    """By how much the held particles have gone further than the tool [m].

    0 where it says nothing: of its own, or yet, as the jaws have just closed.
    """
    further = held_way(model, frame, closed_on(sheet, theta, frame, moment), x) - model.tool
    return jnp.where(frame.by_points | (moment.closed <= 0), 0.0, further)


def held_way(
    model: SheetModel, frame: ClosedFrame, closed: Float[Array, "n 3"], x: Float[Array, "n 3"]
) -> Float[Array, " 3"]:
    """How far the held particles have gone as seen, the view's errors taken off [m]; as the tool says if none is."""
    gone = mean_of_held(frame, x + frame.y - look(model, x) - closed)
    return jnp.where(jnp.any(frame.held & frame.visible), gone, model.tool)


def mean_of_held(frame: ClosedFrame, values: Float[Array, "n ..."]) -> Float[Array, "..."]:
    """Over the held particles that are seen; zero if there are none."""
    both = frame.held & frame.visible
    among = jnp.expand_dims(both, tuple(range(1, values.ndim)))
    return jnp.sum(jnp.where(among, values, 0.0), axis=0) / jnp.maximum(jnp.sum(both, dtype=float), 1.0)


class Predicted(eqx.Module):
    """One frame."""

    x: Float[Array, "n 3"]
    seen: Float[Array, "n 3"]
    """x as the camera shows it."""


@eqx.filter_jit
def predict(
    sheet: PredictedSheet,
    theta: Float[Array, " p"],
    s: Float[Array, " n"],
    frame: ClosedFrame,
    moment: FrameContext,
    start: Float[Array, "n 3"],
    by_tool: Bool[Array, ""],
) -> Predicted:
    """The equilibrium, searched from `start`; what is held goes where it was seen, or where the tool says."""
    model = sheet.model(theta, moment, frame.way)
    closed = closed_on(sheet, theta, frame, moment)
    told = by_tool & ~frame.by_points
    to = closed + jnp.where(told, model.tool, held_way(model, frame, closed, start))[None]
    precision = jnp.broadcast_to(GRIPPED * jnp.eye(3)[None], (len(s), 3, 3))
    gripped = Evidence(y=to, precision=precision, held=frame.held, force_unknown=frame.force_unknown)
    begun = jnp.where(frame.held[:, None], to, start)
    x = sheet.balance_of(model.energy).predict(begun, s, gripped)
    return Predicted(x=x, seen=look(model, x))


def predict_all(
    sheet: PredictedSheet,
    theta: np.ndarray,
    s: np.ndarray,
    history: FrameHistory,
    states: Float[np.ndarray, "frames n 3"],
    *,
    only: list[int] | None = None,
    by_tool: bool = False,
) -> tuple[Float[np.ndarray, "frames n 3"], Float[np.ndarray, "frames n 3"]]:
    """Every frame, and how it is seen, NaN where it was not predicted.

    Those of a grasp in turn, from the states known so far, and the grasps side by side: of other grasps an effect knows
    `states`, not what is found here.
    """
    grasps = history.by(lambda one: one.grasp, range(len(history.frames)) if only is None else only)
    found, seen = states.copy(), np.full(states.shape, np.nan)
    rounds = (
        ROUNDS if any(one.history_dependent and np.any(theta[sheet.place(one.name)]) for one in sheet.library) else 1
    )
    at, stiffnesses, told = jnp.asarray(theta), jnp.asarray(s), jnp.asarray(by_tool)

    def one(grasp: int) -> None:
        known = states.copy()
        for k in grasps[grasp]:
            frame = history.frames[k].frame
            for _ in range(rounds):
                there = predict(sheet, at, stiffnesses, frame, history.moment(k, known), jnp.asarray(known[k]), told)
                x = np.asarray(there.x)
                stays = np.abs(x - known[k]).max() < STAYS
                known[k], found[k], seen[k] = x, x, np.asarray(there.seen)
                if stays:
                    break

    parallel_map(one, grasps)
    return found, seen
