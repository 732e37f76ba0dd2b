"""The next pull and hold that tells the surviving hypotheses apart, or the word that none does.

A pull from each of several places is foretold by every hypothesis. What one foretells is held against what another
shows, under the weights of the first: half the misfit is the log Bayes factor that the pull is expected to give in
favour of the right one, with the attachments and sizes that each was fitted with [Box and Hill 1967,
doi:10.1080/00401706.1967.10490441]. No pull goes further than the recording has gone.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise, permutations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..physics.mesh import far_apart
from ..planning.information_config import SLANTED, UP, InformationPolicyConfig
from .closed_frames import USUAL_GAP, ClosedFrame, FrameHistory, Timed
from .closing import Closed
from .dataset import Dataset
from .every_frame import cost_under, weighed
from .fit import Fitted
from .held_out import from_rest
from .problem import Point, Problem
from .sheet import look

BEST = 3
"""Places, best when lifted from, from which slanted pulls are tried."""
HOLD = 5.0
"""How long what was pulled is held still [s]."""
ENOUGH = 10.0
"""What a pull must be expected to say [nat]."""


@dataclass(frozen=True, kw_only=True)
class Suggestion:
    """A grasp, a pull and a hold."""

    grasp: Float[np.ndarray, " 3"]
    """Where the jaws close [m]."""
    pull: Float[np.ndarray, " 3"]
    """Where the tool goes from there [m]."""
    hold: float
    """How long it stays there [s]."""
    expected: float
    """Log Bayes factor for the right hypothesis against the wrong one that is told from it worst [nat]."""
    between: tuple[str, ...]
    """The hypotheses' effects."""

    @property
    def enough(self) -> bool:
        """Whether it is worth the pull."""
        return self.expected > ENOUGH


def suggest(closed: Closed, dataset: Dataset, *, log: Callable[[str], None] = lambda _: None) -> Suggestion | None:
    """Of the pulls that are tried, the one that is expected to tell most; None if there is nothing to tell apart."""
    open_ = [[best, *rivals] for best, rivals in zip(closed.accepted, closed.rivals, strict=True) if rivals]
    if not open_:
        return None
    hypotheses = open_[-1]
    fits, names = [one.fitted for one in hypotheses], tuple(one.effect.name for one in hypotheses)
    log(f"looking for a pull that tells {', '.join(names)} apart")
    rest, far, gap, radius = dataset.estimator.sheet.rest, *_usual(dataset)
    places = far_apart(rest, InformationPolicyConfig().n_places).tolist()

    def tried(place: int, direction: Float[np.ndarray, " 3"]) -> tuple[float, int, Float[np.ndarray, " 3"]]:
        frames = _frames(dataset, place, far * direction, gap=gap, radius=radius)
        return told_apart(closed.problem, fits, frames), place, far * direction

    best = sorted((tried(place, UP[0]) for place in places), key=lambda one: -one[0])
    best += [tried(place, direction) for _, place, _ in best[:BEST] for direction in SLANTED]
    expected, place, pull = max(best, key=lambda one: one[0])
    return Suggestion(grasp=rest[place], pull=pull, hold=HOLD, expected=expected, between=names)


def told_apart(problem: Problem, fits: list[Fitted], frames: list[Timed]) -> float:
    """What frames are expected to say for the right fit against the wrong one that comes closest to it [nat]."""
    shown = [_shown(problem, one, frames) for one in fits]
    return min(_against(problem, fits[k], shown[right]) for k, right in permutations(range(len(fits)), 2))


def _shown(problem: Problem, fitted: Fitted, frames: list[Timed]) -> list[Timed]:
    """The frames as they would be seen if a fit were right."""
    lying = _lying(_of(problem, frames), fitted)
    frames = [replace(one, frame=eqx.tree_at(lambda f: (f.y, f.rotated), one.frame, (lying, lying))) for one in frames]
    told = [replace(one, frame=eqx.tree_at(lambda f: f.by_points, one.frame, jnp.asarray(False))) for one in frames]
    seen = _predicted(_of(problem, told), fitted, by_tool=True).seen
    return [
        replace(one, frame=eqx.tree_at(lambda f: f.y, one.frame, jnp.asarray(y)))
        for one, y in zip(frames, seen, strict=True)
    ]


def _lying(problem: Problem, fitted: Fitted) -> Float[Array, "n 3"]:
    """Where a fit has the sheet seen as the jaws close."""
    moment = problem.history.moment(0, _at_rest(problem))
    model = problem.sheet.model(jnp.asarray(fitted.point.theta), moment, jnp.zeros(3))
    return look(model, problem.history.rest)


def _predicted(problem: Problem, fitted: Fitted, *, by_tool: bool) -> Point:
    every, rest = list(range(len(problem.history.frames))), _at_rest(problem)
    return from_rest(problem, replace(fitted.point, states=rest, seen=rest), every, by_tool=by_tool)


def _at_rest(problem: Problem) -> Float[np.ndarray, "frames n 3"]:
    return np.tile(np.asarray(problem.history.rest), (len(problem.history.frames), 1, 1))


def _against(problem: Problem, fitted: Fitted, frames: list[Timed]) -> float:
    """By how much frames speak against a fit [nat]."""
    there = _of(problem, frames)
    point = _predicted(there, fitted, by_tool=False)
    return 0.5 * cost_under(there, weighed(there, point, list(range(len(frames)))), point)


def _of(problem: Problem, frames: list[Timed]) -> Problem:
    return replace(problem, history=FrameHistory(frames, np.asarray(problem.history.rest)))


def _frames(dataset: Dataset, place: int, pull: Float[np.ndarray, " 3"], *, gap: float, radius: float) -> list[Timed]:
    """The jaws closed on a place, half of the pull, all of it, and after the hold; what is seen is left open."""
    rest = dataset.estimator.sheet.rest
    last, like = dataset.frames[-1], dataset.frames[-1].frame
    held = np.linalg.norm(rest - rest[place], axis=1) <= radius
    precision = jnp.broadcast_to(jnp.max(like.precision, axis=0)[None], like.precision.shape)
    grasp, began = last.grasp + 1, last.time + HOLD
    moves = [(0.0, 0.0), (gap, 0.5), (2 * gap, 1.0), (2 * gap + HOLD, 1.0)]
    return [
        Timed(
            frame=ClosedFrame(
                y=jnp.asarray(rest),
                visible=jnp.ones(len(rest), dtype=bool),
                precision=precision,
                held=jnp.asarray(held),
                force_unknown=jnp.asarray(dataset.estimator.force_unknown(held)),
                rotated=jnp.asarray(rest),
                way=jnp.asarray(share * pull),
                by_points=like.by_points,
                held_sd=like.held_sd,
            ),
            index=last.index + 1 + k,
            grasp=grasp,
            part=last.part + 1,
            time=began + since,
            closed=since,
            state=rest,
            reports=((began + since, share * pull),),
        )
        for k, (since, share) in enumerate(moves)
    ]


def _usual(dataset: Dataset) -> tuple[float, float, float]:
    """How far the tool goes at most [m], what lies between frames of a grasp [s], and how wide the jaws hold [m]."""
    rest, frames = dataset.estimator.sheet.rest, dataset.frames
    gaps = [b.time - a.time for a, b in pairwise(frames) if a.grasp == b.grasp]
    grips = [rest[np.asarray(one.frame.held)] for one in frames]
    return (
        max(float(np.linalg.norm(one.frame.way)) for one in frames),
        float(np.median(gaps or [USUAL_GAP])),
        max(float(np.linalg.norm(grip - grip.mean(axis=0), axis=1).max()) for grip in grips),
    )
