"""Content of `discrepancy.json`: the result of closing the loop."""

from typing import Any

import numpy as np
from jaxtyping import Float

from jiggle_mj.estimate import Detection

from .close_loop import Closed
from .dataset import Dataset
from .held_out import rms
from .hypotheses import Hypothesis, reported_sd
from .localisation import localisation
from .suggestion import Suggestion
from .trivial_predictions import TRIVIAL, trivial_predictions


def discrepancy(closed: Closed, dataset: Dataset) -> dict[str, Any]:
    """Return the result as numbers, strings and lists; lengths in metres, log Bayes factors in nat.

    `suggestion` and the detections are None, to be filled in later.
    """
    first, last = closed.contexts[0], closed.contexts[-1]
    noise, before = dataset.noise, localisation(closed.problem, first.fitted)
    return {
        "verdict": closed.verdict,
        "effects": [_effect(closed, *pair) for pair in zip(closed.accepted, closed.rivals, strict=True)],
        "ambiguous_with": list(dict.fromkeys(one.effect.name for rivals in closed.rivals for one in rivals)),
        "refused": [{"name": one.effect.name, "why": why} for one, why in closed.refused],
        "tested": [effect.name for effect in closed.problem.sheet.library],
        "scores": [
            {
                "name": one.name,
                "log_bayes_factor": one.log_bayes_factor,
                "p_value": one.p_value,
                "information_kept": one.kept,
            }
            for one in first.scores
        ],
        "unexplained_residual": [
            {
                "gain": context.unexplained.gain,
                "force_variance": context.unexplained.variance,
                "smooth_amplitude": context.unexplained.amplitude,
                "tool_variance": context.unexplained.tool_variance,
            }
            for context in closed.contexts
        ],
        "held_out": {
            "folds": [
                {"before_rms_m": before.rms, "after_rms_m": after.rms}
                for before, after in zip(first.folds, last.folds, strict=True)
            ],
            **_reported(closed, dataset),
        },
        "remainder": {
            "degrees": closed.remainder.degrees,
            **{f"{name}_sd_m": variance**0.5 for name, variance in closed.remainder.variances.items()},
        },
        "noise": {
            "sd_m": noise.sd,
            "smooth_sd_m": noise.smooth_sd,
            "smooth_length_m": noise.length,
            "still_frames": noise.frames,
        },
        "frames": {"used": len(dataset.frames), "left_out": list(dataset.left_out)},
        "localisation": before,
        "localisation_after": before if closed.final is first.fitted else localisation(closed.problem, closed.final),
        "attachments": {"from": "fit", "why": None},
        "suggestion": None,
        "detection_before": None,
        "detection_after": None,
    }


def attachments(found: dict[str, Any], detection: Detection | str) -> dict[str, Any]:
    """Return what changes in the result with an estimate under the corrected model, or with why there is none."""
    if isinstance(detection, str):
        return {"attachments": {"from": "fit", "why": detection}}
    after = found["localisation_after"]
    particles = {"p_attached": detection.score.tolist(), "attached": detection.attached.tolist()}
    return {
        "attachments": {"from": "estimate", "why": None},
        "localisation_after": after | {"particles": after["particles"] | particles},
    }


def _effect(closed: Closed, one: Hypothesis, rivals: list[Hypothesis]) -> dict[str, Any]:
    return {
        "name": one.effect.name,
        "site": one.score.site if one.effect.sites > 1 else None,
        "theta": one.theta.tolist(),
        "sd": reported_sd(closed.problem, one).tolist(),
        "units": list(one.effect.units),
        "log_bayes_factor": one.log_bayes_factor,
        "p_value": one.score.p_value,
        "this_session_alone": one.effect.sensing,
        "indistinguishable_from": [rival.effect.name for rival in rivals],
        "often_confused_with": list(one.effect.confounded_with),
    }


def suggested(found: Suggestion) -> dict[str, Any]:
    """Return the content of `suggestion`."""
    return {
        "grasp_m": found.grasp.tolist(),
        "pull_m": found.pull.tolist(),
        "hold_s": found.hold,
        "between": list(found.between),
        "expected_log_bayes_factor": found.expected,
        "enough": found.enough,
    }


def _reported(closed: Closed, dataset: Dataset) -> dict[str, Any]:
    """Return the figures of the part that chose no effect, and its error in each frame; None without one."""
    before, after = closed.reported or (None, None)
    predictions = {"before": before, "after": after, "with_remainder": closed.with_remainder}
    figures: dict[str, Any] = {}
    for when, found in predictions.items():
        figures[f"{when}_rms_m"] = None if found is None else found.rms
        figures[f"{when}_nll"] = None if found is None else found.nll
        figures[f"{when}_coverage_90"] = None if found is None else found.coverage_90
    if closed.reported is None:
        return figures | dict.fromkeys(f"{name}_rms_m" for name in TRIVIAL) | {"frames": []}
    of_part = [timed for timed in dataset.frames if timed.part == dataset.frames[-1].part]
    ends = np.cumsum([int(timed.frame.counted.sum()) for timed in of_part])[:-1]
    residuals = {when: np.split(found.residual, ends) for when, found in predictions.items() if found is not None}
    trivial = trivial_predictions(dataset.frames, of_part[0].part)
    figures |= {f"{name}_rms_m": rms(np.concatenate(trivial[name])) for name in TRIVIAL}
    residuals |= trivial
    figures["frames"] = [
        {"index": timed.index} | {f"{name}_rms_m": _rms(found[k]) for name, found in residuals.items()}
        for k, timed in enumerate(of_part)
    ]
    return figures


def _rms(residual: Float[np.ndarray, "m 3"]) -> float | None:
    return rms(residual) if len(residual) else None
