"""Closing the loop: find which effect the model lacks, and add it if held-out frames are predicted better with it.

Fit the declared model, score every effect by the residual, and refit with each of the likeliest. Some of these beat
larger unexplained errors, have a plausible size and predict the held-out parts better. Keep the one with the largest
log Bayes factor over the fourth root of its held-out error. Repeat for a second and a third effect.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from ..effects import LIBRARY, Effect
from .dataset import Dataset
from .fit import MAX_STIFFNESS, Fitted, discounted, fit, start
from .held_out import HeldOut, held_out, predict_held_out
from .hypotheses import MAX_UNEXPLAINED_GAIN, FitContext, Hypothesis, leave_one_out
from .problem import Problem
from .search import MAX_EFFECTS, AddedHypothesis, Refused, following, revised
from .unexplained_residual import unexplained_residual
from .user_effects import check_effects

MAX_EXCESS = 5.0
"""Largest mean squared standardised residual of held-out parts with which the residual still counts as explained."""
UNEXPLAINED = ("unexplained", "effect-with-remainder")
"""Verdicts with an unexplained residual."""


@dataclass(frozen=True, kw_only=True)
class Closed:
    """Result of closing the loop."""

    verdict: str
    """Verdict: no-effect, effect, ambiguous, effect-with-remainder or unexplained."""
    accepted: list[Hypothesis]
    """Effects that were added, in order."""
    rivals: list[list[Hypothesis]]
    """Effects that are indistinguishable from each of the accepted ones."""
    refused: Refused
    """Effects that were fitted and not added, with the reason."""
    contexts: list[FitContext]
    """Fits after each addition; the first is of the declared model."""
    final: Fitted
    """The last fit. Where a residual is unexplained, its information is discounted by the mean squared standardised
    residual of held-out parts, so that fewer particles count as attached because of a cause without a name."""
    reported: tuple[HeldOut, HeldOut] | None
    """Predictions, before and after, of a part that chose no effect; None if there was only one part."""
    problem: Problem
    """What was fitted to."""


def close_the_loop(
    dataset: Dataset, *, library: tuple[Effect, ...] = LIBRARY, log: Callable[[str], None] = lambda _: None
) -> Closed:
    """Return which effects the model of a recording lacks, and the fits that show it.

    Args:
        dataset: the recording's frames with closed jaws.
        library: effects that the model may lack.
        log: receives progress messages.

    Raises:
        ValueError: an effect that is not of the library cannot be used; see `check_effects`.
    """
    problem = Problem.build(dataset, library)
    check_effects(problem)
    parts = list(dict.fromkeys(timed.part for timed in dataset.frames))
    spare = parts[-1] if len(parts) > 1 else None
    used = set(parts) - {spare}
    if dataset.left_out:
        log(f"{len(dataset.left_out)} frames excluded: the held particles are observed in another shape there")
    log(f"fitting {len(problem.frames(used))} frames in {len(used)} parts with the declared model")
    contexts, added, refused, last_refused = (
        [_declared(problem, dataset, used, log)],
        list[AddedHypothesis](),
        Refused(),
        Refused(),
    )
    while len(added) < MAX_EFFECTS:
        found, more = following(problem, contexts[-1], added, used, log)
        if found is added:
            last_refused = more
            break
        refused += more
        added = found
        contexts.append(added[-1].context)
        log(f"effects so far: {', '.join(one.hypothesis.effect.name for one in added)}")
    if len(added) > 1:
        added = revised(problem, added, used, log)
        contexts.append(added[-1].context)
    accepted, names = [one.hypothesis for one in added], {one.hypothesis.effect.name for one in added}
    rivals = [[one for one in group.rivals if one.effect.name not in names] for group in added]
    refused += [pair for group in added for pair in group.others] + last_refused
    last_reasons = {one.effect.name: (one, why) for one, why in refused}
    named = names | {one.effect.name for group in rivals for one in group}
    reported = None
    if spare is not None:
        before = predict_held_out(problem, contexts[0].fitted, spare)
        reported = before, predict_held_out(problem, contexts[-1].fitted, spare) if accepted else before
    last = contexts[-1]
    folds = [HeldOut.together(last.folds)] if last.folds else []
    predicted = folds + ([] if reported is None else [reported[1]])
    unexplained = last.unexplained.gain > MAX_UNEXPLAINED_GAIN or any(one.excess > MAX_EXCESS for one in predicted)
    verdict, final = _verdict(accepted, rivals, unexplained), last.fitted
    if verdict in UNEXPLAINED and folds:
        excess = max(folds[0].excess, 1.0)
        log(f"information divided by {excess:.1f}, the mean squared standardised residual of held-out parts")
        final = discounted(problem, final, excess)
    return Closed(
        verdict=verdict,
        accepted=accepted,
        rivals=rivals,
        refused=[pair for name, pair in last_reasons.items() if name not in named],
        contexts=contexts,
        final=final,
        reported=reported,
        problem=problem,
    )


def _declared(problem: Problem, dataset: Dataset, used: set[int], log: Callable[[str], None]) -> FitContext:
    """Return the fit without effects, started from the filter's estimate."""
    detection = dataset.detection
    b = jnp.asarray(np.where(detection.attached, detection.stiffness, 0.0))
    s = np.minimum(np.asarray(problem.prior.bounded(b)), MAX_STIFFNESS)
    states = np.array([timed.state for timed in dataset.frames])
    point = start(problem, np.zeros(problem.sheet.size), s, states, problem.frames(used))
    fitted = fit(problem, np.zeros(0, dtype=int), point, used, log=log)
    folds = held_out(problem, leave_one_out(problem, fitted, used))
    return FitContext(fitted=fitted, unexplained=unexplained_residual(problem, fitted), folds=folds, scores=[])


def _verdict(accepted: list[Hypothesis], rivals: list[list[Hypothesis]], unexplained: bool) -> str:
    if not accepted:
        return "unexplained" if unexplained else "no-effect"
    if unexplained:
        return "effect-with-remainder"
    return "ambiguous" if any(rivals) else "effect"
