"""The figures of one run, with the keys of `result.json`.

`result` makes all keys from what the estimator knows, with null for everything that needs the truth. `with_truth` fills
that in, and `score` does it for a folder on disk. Fractions, not per cent; null where undefined.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool

from jiggle_mj.argument_checks import as_path
from jiggle_mj.episode import Episode
from jiggle_mj.errors import RecordingError
from jiggle_mj.estimate import Belief, Detection, Estimate, ForceCheck, PointNoise, Sheet
from jiggle_mj.limits import Limits
from jiggle_mj.recording.estimate import EstimateRecording
from jiggle_mj.truth import Truth

from .calibration import Calibration, calibration
from .detection_metrics import DILATIONS, agreement, average_precision
from .result_file import Json, read_scorable, write_result
from .safety import attachment_loads
from .tracking import tracking
from .truth_transfer import TransferredTruth, transfer

if TYPE_CHECKING:
    from jiggle_mj.estimator.planning.policy import Decision

NO_AGREEMENT = {"pcd": None, "pug": None, "f1": None}


@dataclass(frozen=True, kw_only=True)
class Run:
    """One run before any truth is seen: what was run, and what came of it."""

    scene: str
    """Name of the scene or recording."""
    seed: int | None
    """Seed of the run; None for a secret scene, and for a recording that states none."""
    sensing: str
    """Sensing: stereo, points, particles or cloud."""
    estimator: str
    """Name of the filter."""
    policy: str
    """Name of what chooses the pulls."""
    episode: Episode
    """Sheet, estimates, belief and detection."""
    disturbances: str | None = None
    """Disturbances, as the recording's metadata has them; None where it has none."""
    simulation_s: float | None = None
    """Wall time of the reference tissue over all frames [s]; None for a recording."""
    limits: Limits | None = None
    """Limits of the attachment loads; None for a recording."""
    decisions: Sequence["Decision"] = ()
    """Actions that a policy planned, in order."""
    ended: str | None = None
    """Reason why a policy planned no more."""
    settings: Json | None = None
    """What was declared and set, and where it came from; see `settings_used`."""
    procedure: Json | None = None
    """Name of a procedure that cuts or sews, and what was seen of each act; see `acting.acts`."""


def result(run: Run) -> Json:
    """Return all keys of `result.json`, with null for everything that needs the truth."""
    episode, limits, decisions = run.episode, run.limits, run.decisions
    estimates, detection = episode.estimates, episode.detection
    update = np.array([estimate.update_s for estimate in estimates])
    perception = np.array([estimate.perception_s for estimate in estimates])
    return {
        "scene": run.scene,
        "seed": run.seed,
        "sensing": run.sensing,
        "estimator": run.estimator,
        "policy": run.policy,
        "disturbances": run.disturbances,
        "settings": run.settings,
        "n_particles": len(episode.sheet.rest),
        "n_frames": episode.n_frames,
        "detection": {
            "rule": detection.rule,
            "n_detected": int(detection.attached.sum()),
            "n_expected": float(detection.score.sum()) if detection.probabilistic else None,
            "n_attached": None,
            "n_observable": None,
            "by_dilation": {str(rings): dict(NO_AGREEMENT) for rings in DILATIONS},
            "average_precision": None,
            "observable": {"by_dilation": {str(rings): dict(NO_AGREEMENT) for rings in DILATIONS}},
            "converged": detection.converged,
        },
        "noise": {
            "force_sd_ratio": detection.force_sd_ratio,
            "position_sd_ratio": detection.position_sd_ratio,
            "points": _point_noise(episode.point_noise),
            "cloud_share": episode.cloud_share,
        },
        "force": _force(episode.force),
        "calibration": dict.fromkeys(field.name for field in fields(Calibration)),
        "tracking": {"rms_m": None},
        "safety": {
            "limit_j": None if limits is None else limits.energy,
            "max_mean_boundary_energy_j": None,
            "violations": None,
            "limit_n": None if limits is None else limits.force,
            "max_force_n": None,
            "force_violations": None,
        },
        "decisions": [
            {"does": decision.does, "why": decision.why, "plan_s": decision.plan_s} for decision in decisions
        ],
        "ended": run.ended,
        "procedure": run.procedure,
        "entropy": {
            "prior": _finite(episode.prior_entropy),
            "final": _finite(estimates[-1].entropy) if estimates else None,
        },
        "frames": {
            "used": len(estimates),
            "skipped": [{"index": index, "why": why} for index, why in episode.skipped],
            "not_converged": [estimate.index for estimate in estimates if not estimate.converged],
        },
        "timing": {
            "update_s": {
                "median": float(np.median(update)) if len(update) else None,
                "p95": float(np.percentile(update, 95)) if len(update) else None,
            },
            "perception_s": float(np.median(perception)) if len(perception) else None,
            "plan_s": float(np.median([decision.plan_s for decision in decisions])) if decisions else None,
            "simulation_s": _finite(run.simulation_s),
        },
    }


def with_truth(
    unscored: Json,
    *,
    sheet: Sheet,
    estimates: Sequence[Estimate],
    belief: Belief,
    detection: Detection,
    truth: Truth,
) -> Json:
    """Return a copy of `unscored` with all figures that need the truth, which is taken at the last used frame."""
    transferred = transfer(sheet, truth, estimates[-1].index if estimates else 0)
    probability = detection.score if detection.probabilistic else None
    calibrated = calibration(
        belief,
        transferred.stiffness,
        transferred.attached,
        observable=transferred.observable,
        probability=probability,
    )
    scored = copy.deepcopy(unscored)
    _section(scored, "detection").update(
        n_detected=int(detection.attached.sum()),
        n_attached=int(transferred.attached.sum()),
        by_dilation=agreements(sheet, detection.attached, transferred),
        average_precision=average_precision(detection.score, transferred.attached),
    )
    observable = transferred.observable
    if observable is not None:
        _section(scored, "detection").update(
            n_observable=int(observable.sum()),
            observable={"by_dilation": agreements(sheet, detection.attached, transferred, observable=observable)},
        )
    _section(scored, "calibration").update(vars(calibrated))
    _section(scored, "tracking").update(rms_m=tracking(sheet, estimates, truth).rms)
    _section(scored, "safety").update(_safety(_section(scored, "safety"), truth))
    if scored.get("procedure") is not None:
        _section(scored, "procedure").update(_success(_section(scored, "procedure"), truth))
    return scored


def score(directory: Path, truth_path: Path) -> Json:
    """Score DIR/estimate.mcap against a truth file, and write the figures into DIR/result.json; see `score_read`.

    Raises:
        JiggleError: what `read_scorable` raises.
    """
    directory, truth_path = as_path(directory, "the folder"), as_path(truth_path, "the truth file")
    return score_read(directory, *read_scorable(directory, truth_path))


def score_read(directory: Path, unscored: Json, estimated: EstimateRecording, truth: Truth) -> Json:
    """Score what was read, and write the figures into DIR/result.json.

    All figures of `result.json` that do not need the truth are kept, above all the timing.
    """
    assert estimated.belief is not None and estimated.detection is not None
    figures = with_truth(
        unscored,
        sheet=estimated.sheet,
        estimates=estimated.estimates,
        belief=estimated.belief,
        detection=estimated.detection,
        truth=truth,
    )
    write_result(directory / "result.json", figures)
    return figures


def agreements(
    sheet: Sheet,
    detected: Bool[np.ndarray, " n"],
    transferred: TransferredTruth,
    *,
    observable: Bool[np.ndarray, " n"] | None = None,
) -> Json:
    """Return PCD, PUG and F1 by rings of dilation; PUG over the attached particles in `observable`, all if None."""
    by_dilation: Json = {}
    for rings in DILATIONS:
        figures = agreement(detected, transferred.attached, sheet.faces, rings, observable=observable)
        by_dilation[str(rings)] = {"pcd": figures.pcd, "pug": figures.pug, "f1": figures.f1}
    return by_dilation


def _point_noise(noise: PointNoise | None) -> Json | None:
    """Return the noise of measured points that counted; None for images."""
    if noise is None:
        return None
    return {
        "from": noise.source,
        "point_sd_m": noise.sd,
        "smooth_sd_m": noise.smooth_sd,
        "smooth_length_m": noise.smooth_length,
        "stated_sd_m": noise.stated_sd,
        "still_frames": noise.still_frames,
    }


def _force(check: ForceCheck | None) -> Json | None:
    """Return the measured and predicted forces on the tool; None where none was measured."""
    if check is None:
        return None
    return {
        "used": check.used,
        "why_not": check.why_not,
        "nis": _finite(check.nis),
        "scaled_nis": _finite(check.scaled_nis),
        "stiffness_factor": check.stiffness_factor,
        "stiffness_factor_log_sd": check.stiffness_factor_log_sd,
        "frames": [
            {
                "index": int(index),
                "measured_n": check.measured[row].tolist(),
                "predicted_n": check.predicted[row].tolist(),
                "sd_n": check.sd[row].tolist(),
            }
            for row, index in enumerate(check.index)
        ],
    }


def _safety(limits: Json, truth: Truth) -> Json:
    """Return the largest true loads, and the number of frames over each limit."""
    loads = attachment_loads(truth)
    energy, force = loads.most
    limit_j, limit_n = limits.get("limit_j"), limits.get("limit_n")
    return {
        "max_mean_boundary_energy_j": energy,
        "violations": loads.violations(energy=limit_j) if isinstance(limit_j, float) else None,
        "max_force_n": force,
        "force_violations": loads.violations(force=limit_n) if isinstance(limit_n, float) else None,
    }


def _success(procedure: Json, truth: Truth) -> Json:
    """Say whether each act worked, and the procedure: the tissue is free, or the last suture is in place."""
    done = truth.details.get("events", [])
    planned = procedure["acts"]
    known = isinstance(done, list) and all(isinstance(each, dict) and "succeeded" in each for each in done)
    if not known or not isinstance(done, list) or not isinstance(planned, list) or len(done) != len(planned):
        raise RecordingError("the truth does not say of each act whether it succeeded: the run was interrupted?")
    acts = [act | {"succeeded": bool(event["succeeded"])} for act, event in zip(planned, done, strict=True)]
    if procedure["name"] == "detach":
        return {"acts": acts, "success": bool(truth.frames) and not (truth.frames[-1].stiffness != 0).any()}
    return {"acts": acts, "success": bool(acts) and acts[-1]["succeeded"]}


def _section(figures: Json, name: str) -> Json:
    section = figures[name]
    assert isinstance(section, dict)
    return section


def _finite(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(value)
