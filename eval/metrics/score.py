"""The figures of one run, with the keys of `result.json`, and their file.

`result` makes the whole skeleton from what the estimator knows, with null for all that needs the truth; `with_truth`
fills that in; `score` does it for a folder on disk. Fractions, not per cent; null where undefined.
"""

import copy
import json
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool

from jiggle_mj.errors import OutputError, RecordingError
from jiggle_mj.estimate import Belief, Detection, Estimate, Sheet
from jiggle_mj.limits import Limits
from jiggle_mj.recording.estimate import EstimateRecording, read_estimate
from jiggle_mj.recording.truth import read_truth
from jiggle_mj.truth import Truth

from .calibration import Calibration, calibration
from .detection import DILATIONS, agreement, average_precision
from .safety import borne
from .tracking import tracking
from .truth_transfer import TransferredTruth, carry

if TYPE_CHECKING:
    from jiggle_mj.estimator.planning.policy import Decision

Json = dict[str, object]
RECORDED, IDENTITY = "recording", "recording.identity"
"""Metadata of an estimate: name and identity of the recording that was estimated."""
NO_AGREEMENT = {"pcd": None, "pug": None, "f1": None}


def result(
    *,
    scene: str,
    seed: int,
    sensing: str,
    estimator: str,
    policy: str,
    disturbances: str | None = None,
    sheet: Sheet,
    estimates: Sequence[Estimate],
    detection: Detection,
    prior_entropy: float | None,
    n_frames: int,
    skipped: Sequence[tuple[int, str]] = (),
    simulation_s: float | None = None,
    limits: Limits | None = None,
    decisions: Sequence["Decision"] = (),
    ended: str | None = None,
    procedure: Json | None = None,
) -> Json:
    """All keys of `result.json`, before any truth is seen.

    Args:
        scene: name of the scene or recording.
        seed: of the run.
        sensing: stereo, points, particles or cloud.
        estimator: name of the filter.
        policy: who chose the pulls.
        disturbances: as the recording's metadata has them; None where it says nothing.
        sheet: the estimator's particles.
        estimates: one for each used frame.
        detection: what is called attached.
        prior_entropy: of the belief before any frame [nat]; None if not known.
        n_frames: of the recording: used, skipped and those with open jaws.
        skipped: index and reason of each frame that was left out.
        simulation_s: wall time of the reference tissue, all frames [s]; None for a recording.
        limits: of what the attachments may bear; None for a recording.
        decisions: what a policy planned, in order.
        ended: why a policy planned no more.
        procedure: of one that cuts or sews, its name and what was seen of each act; see `acting.acts`.
    """
    update = np.array([estimate.update_s for estimate in estimates])
    perception = np.array([estimate.perception_s for estimate in estimates])
    return {
        "scene": scene,
        "seed": seed,
        "sensing": sensing,
        "estimator": estimator,
        "policy": policy,
        "disturbances": disturbances,
        "n_particles": len(sheet.rest),
        "n_frames": n_frames,
        "detection": {
            "rule": detection.rule,
            "n_detected": int(detection.attached.sum()),
            "n_attached": None,
            "n_observable": None,
            "by_dilation": {str(rings): dict(NO_AGREEMENT) for rings in DILATIONS},
            "average_precision": None,
            "observable": {"by_dilation": {str(rings): dict(NO_AGREEMENT) for rings in DILATIONS}},
            "converged": detection.converged,
        },
        "noise": {"force_sd_ratio": detection.force_sd_ratio, "position_sd_ratio": detection.position_sd_ratio},
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
        "decisions": [{"does": one.does, "why": one.why, "plan_s": one.plan_s} for one in decisions],
        "ended": ended,
        "procedure": procedure,
        "entropy": {
            "prior": _number(prior_entropy),
            "final": _number(estimates[-1].entropy) if estimates else None,
        },
        "frames": {
            "used": len(estimates),
            "skipped": [{"index": index, "why": why} for index, why in skipped],
            "not_converged": [estimate.index for estimate in estimates if not estimate.converged],
        },
        "timing": {
            "update_s": {
                "median": float(np.median(update)) if len(update) else None,
                "p95": float(np.percentile(update, 95)) if len(update) else None,
            },
            "perception_s": float(np.median(perception)) if len(perception) else None,
            "plan_s": float(np.median([one.plan_s for one in decisions])) if decisions else None,
            "simulation_s": _number(simulation_s),
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
    """A copy of `unscored` with all that the truth decides; the truth is that at the last frame the estimator used."""
    transferred = carry(sheet, truth, estimates[-1].index if estimates else 0)
    probability = detection.score if detection.probabilistic else None
    refined = calibration(belief, transferred.stiffness, transferred.attached, probability=probability)
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
            observable={"by_dilation": agreements(sheet, detection.attached, transferred, knowable=observable)},
        )
    _section(scored, "calibration").update(vars(refined))
    _section(scored, "tracking").update(rms_m=tracking(sheet, estimates, truth).rms)
    _section(scored, "safety").update(_judged(_section(scored, "safety"), truth))
    if scored.get("procedure") is not None:
        _section(scored, "procedure").update(_succeeded(_section(scored, "procedure"), truth))
    return scored


def read_scorable(directory: Path, truth_path: Path) -> tuple[Json, EstimateRecording, Truth]:
    """DIR/result.json, DIR/estimate.mcap and the truth, once it is clear that they belong together.

    Raises:
        OutputError: DIR has no readable `result.json`, or its estimate did not finish.
        RecordingError: a file is missing, damaged or of the wrong kind, or the truth is of another recording.
    """
    unscored = read_result(directory / "result.json")
    found = read_estimate(directory / "estimate.mcap")
    if found.belief is None or found.detection is None:
        raise OutputError(f"{directory / 'estimate.mcap'} ends before its belief; estimate the recording again.")
    truth = read_truth(truth_path)
    if found.metadata.get(RECORDED, truth.scene) != truth.scene:
        raise RecordingError(
            f"{truth_path} is the truth of '{truth.scene}', and {directory} the estimate of "
            f"'{found.metadata[RECORDED]}'; give the truth of the same recording."
        )
    estimated = found.metadata.get(IDENTITY, "")
    if truth.identity and estimated and estimated != truth.identity:
        raise RecordingError(
            f"{truth_path} is the truth of another recording of '{truth.scene}' than {directory} estimates (another "
            "scene file, sensing or seed); give the truth that was written with it."
        )
    if truth.frames and not {f.index for f in truth.frames} & {e.index for e in found.estimates}:
        raise RecordingError(f"{truth_path} shares no frame with {directory}; give the truth of the same recording.")
    return unscored, found, truth


def score(directory: Path, truth_path: Path) -> Json:
    """Score DIR/estimate.mcap against a truth file, and write the figures into DIR/result.json; see `score_read`.

    Raises:
        JiggleError: what `read_scorable` raises.
    """
    return score_read(directory, *read_scorable(directory, truth_path))


def score_read(directory: Path, unscored: Json, found: EstimateRecording, truth: Truth) -> Json:
    """Score what was read, and write the figures into DIR/result.json.

    All that `result.json` said before and the truth does not decide, above all the timing, is kept.
    """
    assert found.belief is not None and found.detection is not None
    figures = with_truth(
        unscored,
        sheet=found.sheet,
        estimates=found.estimates,
        belief=found.belief,
        detection=found.detection,
        truth=truth,
    )
    write_result(directory / "result.json", figures)
    return figures


def write_result(path: Path, figures: Json) -> None:
    """Write `result.json`; NaN and infinity are refused, as JSON has neither."""
    path.write_text(json.dumps(figures, indent=1, allow_nan=False) + "\n")


def read_result(path: Path) -> Json:
    """Read `result.json`.

    Raises:
        OutputError: the file is missing or is no JSON object.
    """
    try:
        if not path.parent.is_dir():
            raise OutputError(f"{path.parent} is no folder; give the one that 'estimate' or 'run' filled.")
        figures = json.loads(path.read_text())
    except OSError as failure:
        raise OutputError(f"{path} cannot be read ({failure.strerror}); 'estimate' or 'run' writes it.") from failure
    except ValueError as failure:
        raise OutputError(f"{path} is not JSON ({failure}); estimate the recording again.") from failure
    if not isinstance(figures, dict) or not isinstance(figures.get("detection"), dict):
        raise OutputError(f"{path} is JSON but not a result of this program; give the folder that 'estimate' wrote.")
    return figures


def agreements(
    sheet: Sheet,
    detected: Bool[np.ndarray, " n"],
    transferred: TransferredTruth,
    *,
    knowable: Bool[np.ndarray, " n"] | None = None,
) -> Json:
    """PCD, PUG and F1 by rings of dilation."""
    by_dilation: Json = {}
    for rings in DILATIONS:
        one = agreement(detected, transferred.attached, sheet.faces, rings, knowable=knowable)
        by_dilation[str(rings)] = {"pcd": one.pcd, "pug": one.pug, "f1": one.f1}
    return by_dilation


def _judged(safety: Json, truth: Truth) -> Json:
    """What the attachments bore at most, and in how many frames it was too much."""
    loads = borne(truth)
    energy, force = loads.most
    limit_j, limit_n = safety.get("limit_j"), safety.get("limit_n")
    return {
        "max_mean_boundary_energy_j": energy,
        "violations": loads.violations(energy=limit_j) if isinstance(limit_j, float) else None,
        "max_force_n": force,
        "force_violations": loads.violations(force=limit_n) if isinstance(limit_n, float) else None,
    }


def _succeeded(procedure: Json, truth: Truth) -> Json:
    """Whether each act worked, and the procedure: is the tissue free, or its last suture in place?"""
    done = truth.details.get("events", [])
    acts = procedure["acts"]
    assert isinstance(done, list) and isinstance(acts, list)
    told = [one | {"succeeded": true["succeeded"]} for one, true in zip(acts, done, strict=True)]
    if procedure["name"] == "detach":
        return {"acts": told, "success": not (truth.frames[-1].stiffness != 0).any()}
    return {"acts": told, "success": bool(told) and told[-1]["succeeded"]}


def _section(figures: Json, name: str) -> Json:
    section = figures[name]
    assert isinstance(section, dict)
    return section


def _number(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(value)
