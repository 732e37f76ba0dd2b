"""Closing the loop: find which effect the model lacks, and add it if held-out frames are predicted better with it.

Fit the declared model, score every effect by the residual, and refit with each of the likeliest. Some of these beat
larger unexplained errors, have a plausible size and predict the held-out parts better. Keep the one with the largest
log Bayes factor over the fourth root of its held-out error. Repeat for a second and a third effect.

Effects with which the part that chose none is predicted worse are taken out again. What stays unexplained becomes a
remainder without a name.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jiggle_mj.errors import RecordingError

from ..effects import LIBRARY, Effect
from .dataset import Dataset
from .fit import MAX_STIFFNESS, Fitted, discounted, fit, start
from .held_out import HeldOut, held_out, predict_held_out
from .hypotheses import MAX_UNEXPLAINED_GAIN, FitContext, Hypothesis, leave_one_out
from .problem import Problem
from .remainder import FittedRemainder, remainder_of_fit
from .search import MAX_EFFECTS, AddedHypothesis, Refused, following, revised
from .unexplained_residual import unexplained_residual
from .user_effects import check_effects

MAX_EXCESS = 5.0
"""Largest mean squared standardised residual of held-out parts with which the residual still counts as explained."""
UNEXPLAINED = ("unexplained", "effect-with-remainder")
"""Verdicts with an unexplained residual."""


class SearchStep(NamedTuple):
    """A state of the search."""

    added: list[AddedHypothesis]
    """Effects in the model."""
    context: FitContext
    """The fit with them."""


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
    """Predictions, before and after, of a part that chose no effect; None if there was only one part. The error after
    is never larger than before."""
    remainder: FittedRemainder
    """What the last fit does not explain."""
    with_remainder: HeldOut | None
    """Prediction of the same part with the remainder in it; None if there was only one part."""
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
        RecordingError: the declared model does not predict a frame; see `check_finite`.
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
    steps, refused = _search(problem, _declared(problem, dataset, used, log), used, log)
    predicted = list[HeldOut]()
    if spare is not None:
        predicted = [predict_held_out(problem, step.context.fitted, spare) for step in steps]
        steps, predicted, dropped = carried_over(steps, predicted)
        refused += dropped
        for one, why in dropped:
            log(f"{one.effect.name} taken out again: {why}")
    added, contexts = steps[-1].added, [step.context for step in steps]
    accepted, names = [one.hypothesis for one in added], {one.hypothesis.effect.name for one in added}
    rivals = [[one for one in group.rivals if one.effect.name not in names] for group in added]
    refused += [pair for group in added for pair in group.others]
    last_reasons = {one.effect.name: (one, why) for one, why in refused}
    named = names | {one.effect.name for group in rivals for one in group}
    last = contexts[-1]
    left = remainder_of_fit(problem, last.fitted)
    with_remainder = None if spare is None else predicted[-1].beyond(*left.of(problem.history.frames, spare))
    folds = [HeldOut.together(last.folds)] if last.folds else []
    too_large = any(one.excess > MAX_EXCESS for one in folds + predicted[-1:])
    unexplained = too_large or last.unexplained.gain > MAX_UNEXPLAINED_GAIN
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
        reported=(predicted[0], predicted[-1]) if predicted else None,
        remainder=left,
        with_remainder=with_remainder,
        problem=problem,
    )


def _search(
    problem: Problem, declared: FitContext, used: set[int], log: Callable[[str], None]
) -> tuple[list[SearchStep], Refused]:
    """Return the steps of the search, the first without effects, and the hypotheses that were refused beside them."""
    steps, refused = [SearchStep([], declared)], Refused()
    while len(steps[-1].added) < MAX_EFFECTS:
        found, more = following(problem, steps[-1].context, steps[-1].added, used, log)
        refused += more
        if found is steps[-1].added:
            break
        steps.append(SearchStep(found, found[-1].context))
        log(f"effects so far: {', '.join(one.hypothesis.effect.name for one in found)}")
    if len(steps[-1].added) > 1:
        added = revised(problem, steps[-1].added, used, log)
        steps.append(SearchStep(added, added[-1].context))
    return steps, refused


def carried_over(steps: list[SearchStep], predicted: list[HeldOut]) -> tuple[list[SearchStep], list[HeldOut], Refused]:
    """Return the steps up to the last one that predicts a part no worse than the first, and what is taken out again.

    Args:
        steps: effects in the model, and the fit with them.
        predicted: prediction of the part by each.
    """
    last = max(k for k, one in enumerate(predicted) if not one.rms > predicted[0].rms)
    kept = {one.hypothesis.effect.name for one in steps[last].added}
    errors = f"{1e3 * predicted[-1].rms:.2f} mm with it and {1e3 * predicted[0].rms:.2f} mm with what is declared"
    why = f"it did not carry over: the part that chose no effect is predicted to {errors}"
    dropped = [(one.hypothesis, why) for one in steps[-1].added if one.hypothesis.effect.name not in kept]
    return steps[: last + 1], predicted[: last + 1], dropped


def _declared(problem: Problem, dataset: Dataset, used: set[int], log: Callable[[str], None]) -> FitContext:
    """Return the fit without effects, started from the filter's estimate."""
    detection = dataset.detection
    b = jnp.asarray(np.where(detection.attached, detection.stiffness, 0.0))
    s = np.minimum(np.asarray(problem.prior.bounded(b)), MAX_STIFFNESS)
    states = np.array([timed.state for timed in dataset.frames])
    point = start(problem, np.zeros(problem.sheet.size), s, states, problem.frames(used))
    fitted = fit(problem, np.zeros(0, dtype=int), point, used, log=log)
    check_finite(problem, fitted)
    folds = held_out(problem, leave_one_out(problem, fitted, used))
    return FitContext(fitted=fitted, unexplained=unexplained_residual(problem, fitted), folds=folds, scores=[])


def check_finite(problem: Problem, fitted: Fitted) -> None:
    """Refuse a fit of the declared model that does not predict all of its frames.

    Raises:
        RecordingError: the normal equations of a frame are not finite.
    """
    found = [
        problem.history.frames[k].index
        for k, one in fitted.equations.items()
        if not np.isfinite(np.asarray(one.square)).all()
    ]
    if found:
        raise RecordingError(
            f"the declared model does not predict {len(found)} of the {len(fitted.equations)} frames that are fitted "
            f"to, the first is frame {found[0]}: the force balance has no finite solution there. Check the declared "
            "stiffnesses and the rest shape; a sheet that is seen in one plane alone needs a bending stiffness, a bed "
            "or gravity that keeps it there."
        )


def _verdict(accepted: list[Hypothesis], rivals: list[list[Hypothesis]], unexplained: bool) -> str:
    if not accepted:
        return "unexplained" if unexplained else "no-effect"
    if unexplained:
        return "effect-with-remainder"
    return "ambiguous" if any(rivals) else "effect"
