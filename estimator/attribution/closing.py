"""Closing the loop: which effect the model lacks, added if frames that it never saw are foretold better with it.

Fit with what is declared, score every effect at what is left, fit again with each of the likeliest; of those that beat
larger errors without a cause, make sense by their size and foretell what is left out of the fit better, keep the one
with most nats over the fourth root of the error to which it foretells them. Again for a second and a third.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from ..effects import LIBRARY, Effect
from .dataset import Dataset
from .fit import STIFFEST, Fitted, doubted, fit, start
from .held_out import HeldOut, held_out, predict_held_out
from .hypotheses import REMAINDER, FitContext, Hypothesis, left_out
from .problem import Problem
from .search import MOST, AddedHypothesis, Refused, following, revised
from .unexplained_residual import unexplained_residual
from .users_effects import check_effects

EXCESS = 5.0
"""How many times the stated variance parts left out may be missed before something is said to be left over."""
UNEXPLAINED = ("unexplained", "effect-with-remainder")
"""Verdicts that say so."""


@dataclass(frozen=True, kw_only=True)
class Closed:
    """What came of it."""

    verdict: str
    """no-effect, effect, ambiguous, effect-with-remainder or unexplained."""
    accepted: list[Hypothesis]
    rivals: list[list[Hypothesis]]
    """Of each of those accepted: effects that it could not be told from."""
    refused: Refused
    stages: list[FitContext]
    """The first with what is declared alone."""
    final: Fitted
    """The last stage's fit; where something is left over, doubted as much as its parts are missed by fits without them,
    so that less is called attached for a cause that has no name."""
    reported: tuple[HeldOut, HeldOut] | None
    """A part that chose no effect, foretold before and after; None if there was none to spare."""
    problem: Problem


def close_the_loop(
    dataset: Dataset, *, library: tuple[Effect, ...] = LIBRARY, log: Callable[[str], None] = lambda _: None
) -> Closed:
    """Over a recording that was followed.

    Args:
        dataset: what was seen.
        library: effects that the model may lack.
        log: told what is being done.

    Raises:
        ValueError: an effect that is not of the library cannot be used; see `check_effects`.
    """
    problem = Problem.build(dataset, library)
    check_effects(problem)
    parts = list(dict.fromkeys(one.part for one in dataset.frames))
    spare = parts[-1] if len(parts) > 1 else None
    used = set(parts) - {spare}
    if dataset.left_out:
        log(f"{len(dataset.left_out)} frames left out: what is held is seen in another shape there")
    log(f"fitting {len(problem.frames(used))} frames in {len(used)} parts with what is declared")
    stages, added, refused, at_last = (
        [_declared(problem, dataset, used, log)],
        list[AddedHypothesis](),
        Refused(),
        Refused(),
    )
    while len(added) < MOST:
        found, more = following(problem, stages[-1], added, used, log)
        if found is added:
            at_last = more
            break
        refused += more
        added = found
        stages.append(added[-1].context)
        log(f"added by now: {', '.join(one.hypothesis.effect.name for one in added)}")
    if len(added) > 1:
        added = revised(problem, added, used, log)
        stages.append(added[-1].context)
    accepted, names = [one.hypothesis for one in added], {one.hypothesis.effect.name for one in added}
    rivals = [[one for one in group.rivals if one.effect.name not in names] for group in added]
    refused += [pair for group in added for pair in group.others] + at_last
    last_said = {one.effect.name: (one, why) for one, why in refused}
    named = names | {one.effect.name for group in rivals for one in group}
    reported = None
    if spare is not None:
        before = predict_held_out(problem, stages[0].fitted, spare)
        reported = before, predict_held_out(problem, stages[-1].fitted, spare) if accepted else before
    last = stages[-1]
    folds = [HeldOut.together(last.folds)] if last.folds else []
    residual = folds + ([] if reported is None else [reported[1]])
    unexplained = last.left.gain > REMAINDER or any(one.excess > EXCESS for one in residual)
    verdict, final = _verdict(accepted, rivals, unexplained), last.fitted
    if verdict in UNEXPLAINED and folds:
        doubt = max(folds[0].excess, 1.0)
        log(f"what frames say counts {doubt:.1f} times less, as each of the parts is missed by that without it")
        final = doubted(problem, final, doubt)
    return Closed(
        verdict=verdict,
        accepted=accepted,
        rivals=rivals,
        refused=[pair for name, pair in last_said.items() if name not in named],
        stages=stages,
        final=final,
        reported=reported,
        problem=problem,
    )


def _declared(problem: Problem, dataset: Dataset, used: set[int], log: Callable[[str], None]) -> FitContext:
    """The fit with no effect, from what the filter says."""
    found = dataset.detection
    b = jnp.asarray(np.where(found.attached, found.stiffness, 0.0))
    s = np.minimum(np.asarray(problem.prior.bounded(b)), STIFFEST)
    states = np.array([one.state for one in dataset.frames])
    point = start(problem, np.zeros(problem.sheet.size), s, states, problem.frames(used))
    fitted = fit(problem, np.zeros(0, dtype=int), point, used, log=log)
    folds = held_out(problem, left_out(problem, fitted, used))
    return FitContext(fitted=fitted, left=unexplained_residual(problem, fitted), folds=folds, scores=[])


def _verdict(accepted: list[Hypothesis], rivals: list[list[Hypothesis]], unexplained: bool) -> str:
    if not accepted:
        return "unexplained" if unexplained else "no-effect"
    if unexplained:
        return "effect-with-remainder"
    return "ambiguous" if any(rivals) else "effect"
