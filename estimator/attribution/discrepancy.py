"""Content of `discrepancy.json`: the result of closing the loop."""

from typing import Any

import numpy as np

from jiggle_mj.estimate import Detection

from ..perception.still_noise import StillNoise
from .close_loop import Closed
from .dataset import Dataset
from .explain import explanation
from .force_report import force_report
from .hypotheses import Hypothesis
from .localisation import localisation
from .persistence import new_share
from .problem import Problem
from .reported_part import reported_part
from .suggestion import Suggestion


def discrepancy(closed: Closed, dataset: Dataset) -> dict[str, Any]:
    """Return the result as numbers, strings and lists; lengths in metres, log Bayes factors in nat.

    `suggestion` and the detections are None, to be filled in later.
    """
    noise, before = dataset.noise, localisation(closed.declared.fitted)
    accepted = closed.final.names
    return {
        "verdict": closed.verdict,
        "posterior": [_probability(*pair) for pair in closed.hypotheses],
        "effects": [_effect(closed, k) for k in range(len(accepted))],
        "ambiguous_with": _beside(closed.rivals, accepted),
        "refused": refused(closed),
        "tested": [effect.name for effect in closed.problem.sheet.library],
        "scores": [
            {
                "name": one.name,
                "log_bayes_factor": one.log_bayes_factor,
                "p_value": one.p_value,
                "information_kept": one.kept,
            }
            for one in closed.declared.scores
        ],
        "held_out": {
            "folds": [
                {"before_rms_m": before.rms, "after_rms_m": after.rms}
                for before, after in zip(*closed.folds, strict=True)
            ],
            **reported_part(closed, dataset),
        },
        "remainder": {
            "degrees": closed.remainder.degrees,
            **{f"{name}_sd_m": variance**0.5 for name, variance in closed.remainder.variances.items()},
        },
        "force": force_report(closed, dataset),
        "noise": {
            "sd_m": noise.sd,
            "smooth_sd_m": noise.smooth_sd,
            "smooth_length_m": noise.length,
            "still_frames": noise.frames,
            **_persistence(closed.final.fitted.problem, noise),
        },
        "frames": {"used": len(dataset.frames), "left_out": list(dataset.left_out)},
        "localisation": before,
        "localisation_after": before if closed.final is closed.declared else localisation(closed.final.fitted),
        "explanation": explanation(closed),
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


def refused(closed: Closed) -> list[dict[str, str]]:
    """Return the effects that were fitted and are not named, with the reason for each."""
    best, _ = closed.hypotheses[0]
    named = {*closed.final.names, *_beside(closed.rivals, ())}
    reasons = dict(closed.dropped)
    for one, probability in closed.hypotheses:
        for name in one.names:
            if name not in named:
                lead, others = best.log_evidence - one.log_evidence, [other for other in one.names if other != name]
                beside = f" beside {' and '.join(others)}" if others else ""
                why = f"its probability{beside} is {probability:.2g}; {best.title} {_led(lead)}"
                reasons.setdefault(name, why)
    return [{"name": name, "why": why} for name, why in reasons.items()]


def _led(lead: float) -> str:
    """Return by how much the likeliest hypothesis leads; with fewer effects it may be likelier by its prior alone."""
    if lead >= 0:
        return f"leads by {lead:.0f} nat"
    return f"is likelier by its prior, although these have {-lead:.0f} nat more"


def _probability(one: Hypothesis, probability: float) -> dict[str, Any]:
    scales = one.fitted.problem.scales
    return {
        "effects": list(one.names),
        "probability": probability,
        "log_evidence": one.log_evidence,
        "frames": len(one.fitted.equations),
        "variances": {
            "force": scales.force,
            "fields": scales.fields,
            "tool": scales.tool,
            "smooth": scales.smooth,
            "pull": scales.pull,
            "noise": scales.noise,
        },
        "larger_errors": scales.larger,
    }


def _persistence(problem: Problem, noise: StillNoise) -> dict[str, float]:
    """Return the autocorrelation of the errors, and the sd of what points err by in a frame's step and in all [m]."""
    scales = problem.scales
    size = np.hypot(noise.sd, noise.smooth_sd * scales.smooth**0.5) * (scales.noise or 1.0) ** 0.5
    step, whole = new_share(scales.autocorrelation, np.array([1, max(problem.history.frames[-1].index, 1)])) ** 0.5
    return {
        "autocorrelation": scales.autocorrelation,
        "step_sd_m": float(size * step),
        "whole_sd_m": float(size * whole),
    }


def _beside(rivals: list[Hypothesis], names: tuple[str, ...]) -> list[str]:
    """Return the effects of some hypotheses that are not among these names."""
    return list(dict.fromkeys(name for one in rivals for name in one.names if name not in names))


def _effect(closed: Closed, k: int) -> dict[str, Any]:
    """Return what is known of an added effect."""
    last, one = closed.final, closed.final.added[k]
    step = last.path[max(1, k + len(last.path) - len(last.added))]
    assert step.before is not None
    own = np.isin(last.fitted.named, one.at)
    rivals = [rival for rival in closed.rivals if one.effect.name not in rival.names]
    return {
        "name": one.effect.name,
        "site": one.score.site if one.effect.sites > 1 else None,
        "theta": last.theta(one).tolist(),
        "sd": reported_sd(closed, one.at, closed.sds[own]).tolist(),
        "units": list(one.effect.units),
        "log_bayes_factor": step.log_evidence - step.before.log_evidence,
        "p_value": one.score.p_value,
        "this_session_alone": one.effect.sensing,
        "indistinguishable_from": _beside(rivals, last.names),
        "often_confused_with": list(one.effect.confounded_with),
    }


def reported_sd(closed: Closed, at: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Return the standard deviation that is reported for an effect's parameters.

    The model's errors are partly the same in all grasps, and do not average out over them: so it is that of one part
    alone. The prior of the nuisance parameter of the same name is added, which may have either sign.
    """
    problem = closed.problem
    own = dict(zip(problem.own.tolist(), problem.own_sd.tolist(), strict=True))
    alone = np.sqrt(max(len(closed.folds[1]), 1)) * sd
    return np.hypot(alone, [own.get(k, 0.0) for k in at.tolist()])


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
