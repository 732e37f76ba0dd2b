"""Suggest the next pull and hold that distinguishes the remaining hypotheses.

Every hypothesis predicts a pull from each of several places. The prediction of one is compared with the observation
that another predicts, under the weights of the first. Half the squared residual is the expected log Bayes factor in
favour of the right one, with the attachments and sizes that each was fitted with [Box and Hill 1967,
doi:10.1080/00401706.1967.10490441]. No pull goes further than the recording did.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise, permutations

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..effects.frame_history import USUAL_GAP
from ..effects.sheet_model import look
from ..physics.mesh import farthest_points
from ..planning.information_config import SLANTED, UP, InformationPolicyConfig
from .close_loop import Closed
from .dataset import Dataset
from .every_frame import misfit_under, weighed
from .gauss_newton import Fitted
from .grasped_frames import ClosedFrame, Timed
from .held_out import from_rest
from .problem import Point, Problem

N_SLANTED_PLACES = 3
"""Number of places from which slanted pulls are tried, the best by their lifts."""
HOLD = 5.0
"""Time for which the tool rests after the pull [s]."""
MIN_EXPECTED = 10.0
"""Expected log Bayes factor with which a pull is worth making [nat]."""


@dataclass(frozen=True, kw_only=True)
class Suggestion:
    """A suggested grasp, pull and hold."""

    grasp: Float[np.ndarray, " 3"]
    """Position where the jaws close [m]."""
    pull: Float[np.ndarray, " 3"]
    """Displacement of the tool from there [m]."""
    hold: float
    """Time for which it stays there [s]."""
    expected: float
    """Expected log Bayes factor of the right hypothesis against the wrong one that is hardest to distinguish [nat]."""
    between: tuple[str, ...]
    """Names of the hypotheses' effects."""

    @property
    def enough(self) -> bool:
        """Return whether the pull is worth making."""
        return self.expected > MIN_EXPECTED


def suggest(closed: Closed, dataset: Dataset, *, log: Callable[[str], None] = lambda _: None) -> Suggestion | None:
    """Return the tried pull with the largest expected log Bayes factor; None if no effects are indistinguishable.

    Args:
        closed: result of closing the loop.
        dataset: what it was closed over.
        log: receives progress messages.
    """
    if not closed.rivals:
        return None
    hypotheses = [closed.final, *closed.rivals]
    fits, names = [one.fitted for one in hypotheses], tuple(" + ".join(one.names) for one in hypotheses)
    log(f"searching for a pull that distinguishes {', '.join(names)}")
    rest, length, gap, radius = dataset.estimator.sheet.rest, *_typical_grasp(dataset)
    places = farthest_points(rest, InformationPolicyConfig().n_places).tolist()

    def evaluate(place: int, direction: Float[np.ndarray, " 3"]) -> tuple[float, int, Float[np.ndarray, " 3"]]:
        frames = _frames(dataset, place, length * direction, gap=gap, radius=radius)
        return expected_log_bayes_factor(closed.problem, fits, frames), place, length * direction

    best = sorted((evaluate(place, UP[0]) for place in places), key=lambda one: -one[0])
    best += [evaluate(place, direction) for _, place, _ in best[:N_SLANTED_PLACES] for direction in SLANTED]
    expected, place, pull = max(best, key=lambda one: one[0])
    return Suggestion(grasp=rest[place], pull=pull, hold=HOLD, expected=expected, between=names)


def expected_log_bayes_factor(problem: Problem, fits: list[Fitted], frames: list[Timed]) -> float:
    """Return the log Bayes factor expected from frames for the right fit against the closest wrong one [nat]."""
    observed = [_simulated(problem, one, frames) for one in fits]
    return min(_cost(problem, fits[k], observed[right]) for k, right in permutations(range(len(fits)), 2))


def _simulated(problem: Problem, fitted: Fitted, frames: list[Timed]) -> list[Timed]:
    """Return the frames as they would be observed if a fit were right."""
    at_rest = _observed_at_rest(problem.with_frames(frames), fitted)
    frames = [
        replace(one, frame=eqx.tree_at(lambda f: (f.y, f.rotated), one.frame, (at_rest, at_rest))) for one in frames
    ]
    with_reports = [
        replace(one, frame=eqx.tree_at(lambda f: f.by_points, one.frame, jnp.asarray(False))) for one in frames
    ]
    seen = _predicted(problem.with_frames(with_reports), fitted, by_tool=True).seen
    return [one.observing(jnp.asarray(y)) for one, y in zip(frames, seen, strict=True)]


def _observed_at_rest(problem: Problem, fitted: Fitted) -> Float[Array, "n 3"]:
    """Return where a fit predicts that the sheet is observed as the jaws close [m]."""
    context = problem.history.context(0, _at_rest(problem))
    model = problem.sheet.model(jnp.asarray(fitted.point.theta), context, jnp.zeros(3))
    return look(model, problem.history.rest)


def _predicted(problem: Problem, fitted: Fitted, *, by_tool: bool) -> Point:
    every, rest = list(range(len(problem.history.frames))), _at_rest(problem)
    return from_rest(problem, replace(fitted.point, states=rest, seen=rest), every, by_tool=by_tool)


def _at_rest(problem: Problem) -> Float[np.ndarray, "frames n 3"]:
    return np.tile(np.asarray(problem.history.rest), (len(problem.history.frames), 1, 1))


def _cost(problem: Problem, fitted: Fitted, frames: list[Timed]) -> float:
    """Return the negative log likelihood of frames under a fit, without constants [nat]."""
    problem = problem.with_scales(fitted.problem.scales).with_frames(frames)
    point = _predicted(problem, fitted, by_tool=False)
    return 0.5 * misfit_under(problem, weighed(problem, point, list(range(len(frames)))), point)


def _frames(dataset: Dataset, place: int, pull: Float[np.ndarray, " 3"], *, gap: float, radius: float) -> list[Timed]:
    """Return frames of a pull: jaws closed, half of it, all of it, and after the hold; observations are not set yet."""
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
                displacement=jnp.asarray(share * pull),
                by_points=like.by_points,
                held_sd=like.held_sd,
            ),
            index=last.index + 1 + round(since / gap),
            grasp=grasp,
            part=last.part + 1,
            time=began + since,
            closed=since,
            state=rest,
            reports=((began + since, share * pull),),
        )
        for since, share in moves
    ]


def _typical_grasp(dataset: Dataset) -> tuple[float, float, float]:
    """Return the tool's largest displacement [m], the median time between frames [s] and the grip's radius [m]."""
    rest, frames = dataset.estimator.sheet.rest, dataset.frames
    gaps = [b.time - a.time for a, b in pairwise(frames) if a.grasp == b.grasp]
    grips = [rest[np.asarray(one.frame.held)] for one in frames]
    return (
        max(float(np.linalg.norm(one.frame.displacement)) for one in frames),
        float(np.median(gaps or [USUAL_GAP])),
        max(float(np.linalg.norm(grip - grip.mean(axis=0), axis=1).max()) for grip in grips),
    )
