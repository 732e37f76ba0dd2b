"""Closing the loop: find which effect the model lacks, and add it unless held-out frames are predicted worse with it.

Fit the declared model, search for hypotheses with more evidence (`hypotheses`), and let all evidences decide
(`verdict`). Effects with which the part that chose none is predicted worse are taken out again. What stays unexplained
becomes a remainder without a name.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from jiggle_mj.errors import RecordingError

from ..effects import LIBRARY, Effect
from .dataset import Dataset
from .fit import fit
from .gauss_newton import MAX_STIFFNESS, Fitted, start
from .held_out import HeldOut, held_out, predict_held_out
from .held_out_force import held_out_force_rms
from .hypotheses import Hypothesis, hypothesis_of, leave_one_out, of_all_frames, search, searched_frames
from .problem import Problem
from .remainder import FittedRemainder, remainder_of_fit
from .scores import parameters_sd
from .starts import ObservedStates
from .user_effects import check_effects
from .verdict import EvidenceVerdict, decide

UNEXPLAINED = ("unexplained", "effect-with-remainder")
"""Verdicts with an unexplained residual."""


@dataclass(frozen=True, kw_only=True)
class Closed:
    """Result of closing the loop."""

    verdict: str
    """Verdict: no-effect, effect, ambiguous, effect-with-remainder or unexplained."""
    declared: Hypothesis
    """The declared model."""
    final: Hypothesis
    """The declared model with the effects that were added."""
    rivals: list[Hypothesis]
    """Hypotheses with effects that these frames do not distinguish from the last one; see `EvidenceVerdict.rivals`. The
    likeliest is among them if effects of it were taken out again."""
    hypotheses: list[tuple[Hypothesis, float]]
    """All hypotheses that were fitted, with their probabilities, the likeliest first."""
    dropped: dict[str, str]
    """Effects that were taken out again, with the reason."""
    folds: tuple[list[HeldOut], list[HeldOut]]
    """Predictions of each part by fits without it, of the declared model and of the last one."""
    sds: np.ndarray
    """Standard deviation of the added effects' parameters: by their covariance, or by how much they change without one
    part, whichever is larger."""
    reported: tuple[HeldOut, HeldOut] | None
    """Predictions, before and after, of a part that chose no effect; None if there was only one part. The error after
    is never larger than before."""
    remainder: FittedRemainder
    """What the last fit does not explain."""
    with_remainder: HeldOut | None
    """Prediction of the same part with the remainder in it; None if there was only one part."""
    problem: Problem
    """What was fitted to."""

    @property
    def fitted_to_all(self) -> list[Hypothesis]:
        """Return the hypotheses that were fitted to all frames, the likeliest first."""
        frames = self.declared.fitted.weights.keys()
        return [one for one, _ in self.hypotheses if one.fitted.weights.keys() == frames]


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
    used, spare = dataset.parts
    if dataset.left_out:
        log(f"{len(dataset.left_out)} frames excluded: the held particles are observed in another shape there")
    frames = problem.frames(used)
    few = searched_frames(problem, frames)
    log(f"fitting {len(few)} of {len(frames)} frames in {len(used)} parts with the declared model")
    observed = filter_states(problem, dataset, few)
    begun = start(problem, observed.point.theta, observed.point.s, observed.point.states, few)
    fits = fit(problem, np.zeros(0, dtype=int), [begun, *observed.starts(np.zeros(0, dtype=int))], few, log=log)
    check_finite(fits.likeliest)
    found = of_all_frames(search(hypothesis_of(fits), observed, log), frames, log)
    declared = found[0]
    check_finite(declared.fitted)
    decision = decide([one.evidence for one in found], len(problem.sheet.library))
    path = found[decision.best].path
    predicted = list[HeldOut]()
    if spare is not None:
        predicted = [predict_held_out(one.fitted, spare) for one in path]
    forces = [] if spare is None else [held_out_force_rms(one.fitted, spare) for one in path]
    path, predicted, dropped = upheld(path, predicted, forces)
    for name, why in dropped.items():
        log(f"{name} taken out again: {why}")
    last = path[-1]
    left = remainder_of_fit(last.fitted)
    before = leave_one_out(declared.fitted, used)
    folds_before = held_out(before)
    after = before if last is declared else leave_one_out(last.fitted, used)
    thetas = [one.point.theta[last.fitted.named] for one in after.values()]
    return Closed(
        verdict=_verdict(decision, last, dropped),
        declared=declared,
        final=last,
        rivals=[found[k] for k in ((decision.best,) if dropped else ()) + decision.rivals if found[k].added],
        hypotheses=[(found[k], float(decision.probabilities[k])) for k in np.argsort(-decision.probabilities)],
        dropped=dropped,
        folds=(folds_before, folds_before if last is declared else held_out(after)),
        sds=np.maximum(parameters_sd(last.fitted), jackknife_sd(thetas, len(last.fitted.named))),
        reported=(predicted[0], predicted[-1]) if predicted else None,
        remainder=left,
        with_remainder=None
        if spare is None
        else predict_held_out(last.fitted, spare, persistent=False).beyond(*left.of(problem.history.frames, spare)),
        problem=problem,
    )


def upheld(
    path: list[Hypothesis], predicted: list[HeldOut], forces: Sequence[float | None] = ()
) -> tuple[list[Hypothesis], list[HeldOut], dict[str, str]]:
    """Return the path up to the last hypothesis that is upheld, and what is taken out.

    It predicts a part that chose no effect no worse than those before, and no parameter is as large as it may be: the
    size of an effect with one is unknown, and it may stand for something else.

    Args:
        path: hypotheses, each with one effect more.
        predicted: prediction of the part by each; empty if there is no such part.
        forces: error of the tool's force in the part by each [N]. It decides for effects that show in nothing else.
    """
    rms, whole = [one.rms for one in predicted], path[-1]
    last = max(k for k, one in enumerate(path) if not one.at_bound and _carries_over(path, rms, forces, k))

    def why(name: str) -> str:
        if name in whole.at_bound:
            return "its size is as large as it may be, so that there is more of it, or something else"
        if _carries_over(path, rms, forces, len(path) - 1):
            return f"it is found beside {' and '.join(whole.at_bound)}, of the largest size that may be"
        errors = f"{1e3 * rms[-1]:.2f} mm with it and {1e3 * rms[last]:.2f} mm without"
        return f"it did not carry over: the part that chose no effect is predicted to {errors}"

    dropped = {name: why(name) for name in whole.names if name not in path[last].names}
    return path[: last + 1], predicted[: last + 1], dropped


def _carries_over(path: list[Hypothesis], rms: list[float], forces: Sequence[float | None], k: int) -> bool:
    """Return whether hypothesis k of a path predicts a part no worse than those before; True if there is no part."""
    if not rms:
        return True
    if path[k].added and path[k].added[-1].effect.needs_force:
        error, before = forces[k], forces[k - 1]
        worse = error is not None and before is not None and error > before
        return not worse and _carries_over(path, rms, forces, k - 1)
    return not rms[k] > min(rms[: k + 1])


def _verdict(decision: EvidenceVerdict, last: Hypothesis, dropped: dict[str, str]) -> str:
    """Return the verdict of the evidences; where effects were taken out again, that something stays unexplained."""
    if not dropped:
        return decision.kind
    return "effect-with-remainder" if last.added else "unexplained"


def filter_states(problem: Problem, dataset: Dataset, frames: list[int]) -> ObservedStates:
    """Return the filter's states and stiffnesses, with the normal equations of some frames there."""
    detection = dataset.detection
    b = jnp.asarray(np.where(detection.attached, detection.stiffness / dataset.stiffness_factor, 0.0))
    s = np.minimum(np.asarray(problem.prior.bounded(b)), MAX_STIFFNESS)
    return ObservedStates.around(problem, s, np.array([timed.state for timed in dataset.frames]), frames)


def check_finite(fitted: Fitted) -> None:
    """Refuse a fit of the declared model that does not predict all of its frames.

    Raises:
        RecordingError: the normal equations of a frame are not finite.
    """
    found = [
        fitted.problem.history.frames[k].index
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


def jackknife_sd(thetas: list[np.ndarray], size: int) -> np.ndarray:
    """Return the jackknife standard error of parameters from fits without one part each; zero if there is none.

    Grasps disagree by more than their noise where the model is wrong in other ways too [Miller 1974,
    doi:10.1093/biomet/61.1.1]. Each fit is one step from that to all parts, so that this is a lower bound.
    """
    if not thetas:
        return np.zeros(size)
    deviation = np.array(thetas) - np.mean(thetas, axis=0)
    return np.sqrt((len(thetas) - 1) / len(thetas) * np.sum(deviation**2, axis=0))
