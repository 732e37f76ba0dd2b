"""Writes a run as one HTML page that needs no network: verdict, maps, pictures, the moving sheet, curves, settings.

The page holds plotly.js, its own script and all numbers, and its policy forbids every connection. Without truth nothing
is scored, and without images there are no pictures. The same input gives the same bytes.

Numbers are rounded for the page (0.01 mm, four digits); the exact figures are in `result.json`.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from jiggle_mj.camera import StereoCamera
from jiggle_mj.estimate import Belief, Detection, Estimate, Sheet
from jiggle_mj.observation import StereoPair
from jiggle_mj.recording.output_files import write_text
from jiggle_mj.truth import Truth

from ..metrics.calibration import reliability
from ..metrics.detection_metrics import DILATIONS, GATE_VARIANCE, agreement, distances
from ..metrics.flat_map import grid_of, outline, plane_of, spacing
from ..metrics.tracking import tracking
from ..metrics.truth_transfer import TransferredTruth, frame_at, stiffness_at, transfer
from .pictures import pictures, state_of
from .verdict import against_truth, doubts, found, stiffness_sums

MAX_SHOWN_STEPS = 60
"""Most frames on the slider."""
MAX_PARTICLE_STEPS = 120_000
"""Most particles times frames on the slider, for each of estimate and truth: about 4 MB of numbers."""
MAX_COLOUR_SHARE = 9.0
"""Largest stiffness on the colour scale [reference of the belief]; stiffer particles get its colour."""
OPENING_SHARE = 0.9
"""Share of the largest displacement that the frame at which the page opens has at least."""
UNDEFINED = "\N{EN DASH}"
"""Text of a figure that is not defined."""


def write_report(
    path: Path,
    *,
    sheet: Sheet,
    estimates: Sequence[Estimate],
    belief: Belief,
    detection: Detection,
    result: Mapping[str, Any],
    settings: Mapping[str, object],
    truth: Truth | None = None,
    images: Callable[[int], StereoPair | None] | None = None,
    camera: StereoCamera | None = None,
) -> None:
    """Write the page.

    Args:
        path: the HTML file.
        sheet: the estimator's particles.
        estimates: one for each used frame, in order. Those read from a file have no wall times, and no curve of the
            times is drawn then.
        belief: the belief at the end.
        detection: the particles that are reported attached.
        result: as in `result.json`, scored if there is truth.
        settings: settings and versions, nested at will; printed as a table.
        truth: None for real data.
        images: gives the raw stereo pair of an observation's index, or None.
        camera: the camera that took the images; needed with them.

    Raises:
        OutputError: the file cannot be written.
        ValueError: no estimates, or images without a camera.
    """
    if not estimates:
        raise ValueError("write_report needs at least one Estimate; got none (every frame was skipped?).")
    if images is not None and camera is None:
        raise ValueError("write_report got images without their camera; pass camera=StereoCamera(...).")
    transferred = None if truth is None else transfer(sheet, truth, estimates[-1].index)
    kept = shown_steps(estimates, sheet.rest)
    pairs = [] if images is None or camera is None else pictures(estimates, images, camera, kept)
    payload = _payload(sheet, estimates, belief, detection, truth, transferred)
    payload["opening"] = _opening(estimates, kept, sheet.rest)
    payload["pictures"] = [
        {
            "step": pair.step,
            "left": pair.left,
            "right": pair.right,
            "size": pair.size,
            "uv_left": _fixed(pair.uv_left, 1),
            "uv_right": _fixed(pair.uv_right, 1),
            "state": state_of(estimates[pair.step]).tolist(),
        }
        for pair in pairs
    ]
    here = files("jiggle_mj.eval.report") / "templates"
    page = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    page.filters.update(number=_text, percent=_percent, milli=_milli)
    comparison = None
    sentences = [found(sheet, detection, plane_of(sheet.rest))]
    if skipped := result["frames"]["skipped"]:
        sentences.append(f"{len(skipped)} of {result['n_frames']} frames are left out.")
    if truth is not None and transferred is not None:
        comparison = _comparison(sheet, estimates, detection, truth, transferred)
        sentences += [
            against_truth(sheet, detection, transferred),
            stiffness_sums(sheet, belief, detection, transferred),
        ]
    sentences += doubts(result)
    text = page.from_string((here / "report.html").read_text("utf-8")).render(
        result=result,
        sentences=sentences,
        comparison=comparison,
        ring_mm=spacing(sheet.rest, sheet.faces) * 1e3,
        gate_variance=GATE_VARIANCE,
        has_pictures=bool(pairs),
        has_probability=detection.probabilistic,
        n_steps=len(kept),
        opening=payload["opening"],
        settings=list(_rows(settings)),
        style=Markup((here / "report.css").read_text("utf-8")),
        script=Markup((here / "report.js").read_text("utf-8")),
        plotly=Markup(get_plotlyjs()),
        payload=Markup(json.dumps(payload, allow_nan=False, separators=(",", ":")).replace("</", "<\\/")),
    )
    write_text(path, text)


def _payload(
    sheet: Sheet,
    estimates: Sequence[Estimate],
    belief: Belief,
    detection: Detection,
    truth: Truth | None,
    transferred: TransferredTruth | None,
) -> dict[str, object]:
    plane, last = plane_of(sheet.rest), estimates[-1]
    flat = plane.flatten(sheet.rest) * 1e3
    true_b = None if truth is None else stiffness_at(truth, frame_at(truth, last.index))
    most = math.inf if belief.reference is None else MAX_COLOUR_SHARE * belief.reference
    finite = [] if transferred is None else transferred.stiffness[np.isfinite(transferred.stiffness)].tolist()
    top = max([min(float(detection.stiffness.max()), most), *finite]) or 1.0
    x, y, corners, weights = grid_of(flat, sheet.faces)
    grids = {"x": _fixed(x, 2), "y": _fixed(y, 2)}
    fields = {"mean": detection.stiffness, "sd": detection.stiffness_sd}
    if detection.probabilistic:
        fields["probability"] = detection.score
    if transferred is not None:
        fields["truth"] = np.where(np.isfinite(transferred.stiffness), transferred.stiffness, top)
    for name, values in fields.items():
        grids[name] = _significant(np.sum(values[corners] * weights, axis=-1))
    kept = shown_steps(estimates, sheet.rest)
    return {
        "axes": list(plane.names),
        "flat": _fixed(flat, 2),
        "top_b": top,
        "top_sd": max(float(np.nan_to_num(estimate.sd).max()) for estimate in estimates),
        "grids": grids,
        "detected": detection.attached.astype(int).tolist(),
        "score": _significant(detection.score),
        "mean": _significant(detection.stiffness),
        "sd": _significant(detection.stiffness_sd),
        "interval": None
        if belief.lower is None or belief.upper is None
        else [_significant(belief.lower), _significant(belief.upper)],
        "faces": sheet.faces.T.tolist(),
        "series": _series(sheet, estimates, truth),
        "grasps": _grasps(estimates),
        "paths": [
            {"xyz": _fixed(path.T * 1e3, 2), "flat": _fixed(plane.flatten(path).T * 1e3, 2)}
            for path in _paths(estimates)
        ],
        "steps": [
            {
                "frame": step,
                "xyz": _fixed(estimates[step].positions.T * 1e3, 2),
                "mean": _significant(estimates[step].mean),
                "sd": _significant(estimates[step].sd),
            }
            for step in kept
        ],
        "truth": None
        if truth is None or true_b is None or transferred is None
        else {
            "attached": transferred.attached.astype(int).tolist(),
            "stiffness": _significant(transferred.stiffness),
            "welded": np.isinf(transferred.stiffness).astype(int).tolist(),
            "outline": _fixed(outline(plane.flatten(truth.rest) * 1e3, truth.faces, ~(true_b == 0)), 2),
            "faces": truth.faces.T.tolist(),
            "steps": _truth_steps(truth, estimates, kept, top),
        },
    }


def _series(sheet: Sheet, estimates: Sequence[Estimate], truth: Truth | None) -> dict[str, object]:
    series: dict[str, object] = {
        "index": [estimate.index for estimate in estimates],
        "time": [round(estimate.time * 1e-9, 6) for estimate in estimates],
        "entropy": _significant(np.array([estimate.entropy for estimate in estimates]), 6),
        "nis": _significant(np.array([estimate.nis for estimate in estimates])),
        "energy": _significant(np.array([estimate.boundary_energy for estimate in estimates])),
        "seen": _fixed(np.array([np.isfinite(e.observed).all(axis=1).mean() for e in estimates]), 4),
    }
    if any(estimate.update_s or estimate.perception_s for estimate in estimates):
        series["update"] = _significant(np.array([estimate.update_s for estimate in estimates]))
        series["perception"] = _significant(np.array([estimate.perception_s for estimate in estimates]))
    if truth is not None:
        errors = tracking(sheet, estimates, truth)
        series["measured_mm"] = _significant(errors.per_frame * 1e3)
        series["estimated_mm"] = _significant(errors.per_frame_estimate * 1e3)
    return series


def _truth_steps(truth: Truth, estimates: Sequence[Estimate], kept: Sequence[int], top: float) -> list[object]:
    frames, most = {frame.index: frame for frame in truth.frames}, MAX_PARTICLE_STEPS // max(1, len(truth.rest))
    every = math.ceil(len(kept) / max(1, most))
    steps: list[object] = []
    for place, step in enumerate(kept):
        frame = frames.get(estimates[step].index)
        if frame is None or (place % every and place + 1 < len(kept)):
            steps.append(None)
            continue
        stiffness = stiffness_at(truth, frame)
        shown = np.where(np.isfinite(stiffness), np.minimum(stiffness, top), top)
        steps.append({"xyz": _fixed(frame.positions.T * 1e3, 2), "b": _significant(shown)})
    return steps


def _comparison(
    sheet: Sheet,
    estimates: Sequence[Estimate],
    detection: Detection,
    truth: Truth,
    transferred: TransferredTruth,
) -> dict[str, object]:
    """Return the figures against the truth that `result.json` has no key for."""
    certain = detection.stiffness_sd**2 <= GATE_VARIANCE
    true_b = stiffness_at(truth, frame_at(truth, estimates[-1].index))
    detected, attached = sheet.rest[detection.attached], truth.rest[~(true_b == 0)]
    return {
        "gated": {
            str(rings): agreement(detection.attached, transferred.attached, sheet.faces, rings, certain=certain)
            for rings in DILATIONS
        },
        "uncertain": int((~certain).sum()),
        "to_truth": distances(detected, attached),
        "to_detection": distances(attached, detected),
        "reliability": reliability(detection.score, transferred.attached) if detection.probabilistic else [],
        "rms_estimate": tracking(sheet, estimates, truth).rms_estimate,
    }


def _grasps(estimates: Sequence[Estimate]) -> list[dict[str, int]]:
    """Return the runs of frames, by position, in which one set of particles is held."""
    runs: list[dict[str, int]] = []
    for step, estimate in enumerate(estimates):
        if not estimate.held.any():
            continue
        before = estimates[step - 1].held if step else np.zeros_like(estimate.held)
        if np.array_equal(before, estimate.held):
            runs[-1]["last"] = step
        else:
            runs.append({"first": step, "last": step})
    return runs


def _paths(estimates: Sequence[Estimate]) -> list[np.ndarray]:
    """Return the path of the centre of the held particles in each grasp [m]."""
    return [
        np.array([e.positions[e.held].mean(axis=0) for e in estimates[grasp["first"] : grasp["last"] + 1]])
        for grasp in _grasps(estimates)
    ]


def shown_steps(estimates: Sequence[Estimate], rest: np.ndarray) -> list[int]:
    """Return the positions in `estimates` of the frames on the slider, thinned evenly."""
    count = min(len(estimates), MAX_SHOWN_STEPS, max(2, MAX_PARTICLE_STEPS // len(rest)))
    return np.unique(np.linspace(0, len(estimates) - 1, count).round().astype(int)).tolist()


def _opening(estimates: Sequence[Estimate], kept: Sequence[int], rest: np.ndarray) -> int:
    """Return the place on the slider at which the page opens: the last frame that is lifted about as far as any."""
    motion = np.array([np.abs(estimates[step].positions - rest).max() for step in kept])
    return int(np.flatnonzero(motion >= OPENING_SHARE * motion.max())[-1])


def _rows(settings: Mapping[str, object], prefix: str = "") -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for name, value in settings.items():
        if isinstance(value, Mapping):
            rows += _rows(value, f"{prefix}{name}.")
        else:
            rows.append((f"{prefix}{name}", f"{value:.6g}" if isinstance(value, float) else str(value)))
    return rows


def _fixed(values: np.ndarray, digits: int) -> list[object]:
    return _without_nan(np.round(values, digits))


def _significant(values: np.ndarray, digits: int = 4) -> list[object]:
    flat = [float(f"{value:.{digits}g}") for value in np.ravel(values)]
    return _without_nan(np.reshape(flat, np.shape(values)))


def _without_nan(values: np.ndarray) -> list[object]:
    plain = np.asarray(values).astype(object)
    plain[~np.isfinite(values)] = None
    return plain.tolist()


def _text(value: float | None, unit: str = "", digits: int = 3) -> str:
    if value is None:
        return UNDEFINED
    return (f"{value:.{digits}g}" if abs(value) < 10**digits else f"{value:.0f}") + f" {unit}".rstrip()


def _percent(value: float | None, unit: str = "") -> str:
    return UNDEFINED if value is None else f"{100 * value:.1f}" + f" {unit}".rstrip()


def _milli(value: float | None, unit: str = "", digits: int = 3) -> str:
    return _text(None if value is None else value * 1e3, unit, digits)
