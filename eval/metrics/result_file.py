"""The file `result.json`: written, read, and checked to belong to an estimate and a truth."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from jiggle_mj.errors import OutputError, RecordingError
from jiggle_mj.recording.estimate import EstimateRecording, read_estimate
from jiggle_mj.recording.json_values import entry, optional, parse_object
from jiggle_mj.recording.output_files import write_text
from jiggle_mj.recording.reader import PAIRING_TOLERANCE_NS
from jiggle_mj.recording.truth import read_truth
from jiggle_mj.toml_kinds import count, counts, flag, number, positive, table, tables, text
from jiggle_mj.truth import Truth

Json = dict[str, object]
Kind = Callable[[Any], Any]
RECORDED, IDENTITY, TOLERANCE = "recording", "recording.identity", "recording.tolerance_ns"
"""Metadata of an estimate: name and identity of the recording that was estimated, and the tolerance of its pairs."""
MAX_DIGITS = 12
"""Longest tolerance that is read: a thousand seconds in ns."""
MADE_BY = "'jiggle-mj table' writes it; delete it, and it is made anew"
"""Origin of a file that a study keeps for one of its cells."""


def _seed(value: Any) -> int:
    """Return a seed, which may have any number of digits."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise TypeError("a whole number from 0")
    return value


KINDS: dict[str, Kind] = {
    "scene": text,
    "sensing": text,
    "estimator": text,
    "policy": text,
    "seed": optional(_seed),
    "disturbances": optional(text),
    "ended": optional(text),
    "n_particles": count,
    "n_frames": count,
    "detection": table,
    "noise": table,
    "calibration": table,
    "tracking": table,
    "safety": table,
    "entropy": table,
    "decisions": tables,
    "procedure": optional(table),
    "frames": table,
    "timing": table,
}
"""Keys of `result.json` and their kinds."""
KINDS_OF_TABLES: dict[str, dict[str, Kind]] = {
    "detection": {
        "rule": text,
        "n_detected": count,
        "n_attached": optional(count),
        "n_observable": optional(count),
        "by_dilation": table,
        "observable": table,
        "average_precision": optional(number),
        "converged": flag,
    },
    "safety": {"limit_j": optional(positive), "limit_n": optional(positive)},
    "frames": {"used": count, "skipped": tables, "not_converged": counts},
    "timing": {"update_s": table, "perception_s": optional(number), "plan_s": optional(number)},
}
"""Keys of its tables that scoring and the report use, and their kinds."""
KINDS_OF_ITEMS: dict[tuple[str, str], dict[str, Kind]] = {
    ("frames", "skipped"): {"index": count, "why": text},
    ("", "decisions"): {"does": text, "why": text, "plan_s": number},
    ("procedure", "acts"): {"kind": text, "frame": count, "log_bayes_factor": optional(number)},
}
"""Keys of the tables in its lists."""


def write_result(path: Path, figures: Json) -> None:
    """Write `result.json`, complete or not at all.

    Raises:
        ValueError: a figure is NaN or infinite; JSON has neither.
        OutputError: it cannot be written.
    """
    write_text(path, json.dumps(figures, indent=1, allow_nan=False) + "\n")


def read_result(path: Path) -> Json:
    """Read `result.json`.

    Raises:
        OutputError: the file is missing, or is no result of this program.
    """
    if not path.parent.is_dir():
        raise OutputError(f"{path.parent} is no folder; give the one that 'estimate' or 'run' filled.")
    figures = read_json(path, "'estimate' or 'run' writes it")
    try:
        _check(figures, path)
    except RecordingError as failure:
        raise OutputError(
            f"{failure} It is not a result of this program; give the folder that 'estimate' wrote."
        ) from failure
    return figures


def pairing_tolerance(estimated: EstimateRecording) -> int:
    """Return the tolerance with which an estimate paired the images of its recording [ns]."""
    given = estimated.metadata.get(TOLERANCE, "")
    return int(given) if given.isascii() and given.isdigit() and len(given) <= MAX_DIGITS else PAIRING_TOLERANCE_NS


def read_json(path: Path, origin: str) -> dict[str, Any]:
    """Read a file that holds one JSON object.

    Args:
        path: the file.
        origin: what writes it, for messages.

    Raises:
        OutputError: the file is missing, or holds no JSON object.
    """
    try:
        return parse_object(path.read_bytes(), str(path))
    except OSError as failure:
        raise OutputError(f"{path} cannot be read ({failure.strerror}); {origin}.") from failure
    except RecordingError as failure:
        raise OutputError(f"{failure} It is damaged; {origin}.") from failure


def _check(figures: Json, path: Path) -> None:
    """Refuse figures that lack a key, or have one of another kind."""
    for key, kind in KINDS.items():
        entry(figures, key, kind, str(path))
    for name, kinds in KINDS_OF_TABLES.items():
        for key, kind in kinds.items():
            entry(table(figures[name]), key, kind, f"{path}: {name}")
    procedure = figures["procedure"]
    if procedure is not None:
        entry(table(procedure), "name", text, f"{path}: procedure")
        entry(table(procedure), "acts", tables, f"{path}: procedure")
    for (section, name), kinds in KINDS_OF_ITEMS.items():
        holder = table(figures[section] or {}) if section else figures
        for item in tables(holder.get(name, [])):
            for key, kind in kinds.items():
                entry(item, key, kind, f"{path}: {name}")


def read_scorable(
    directory: Path, truth_path: Path, *, allow_truncated: bool = False
) -> tuple[Json, EstimateRecording, Truth]:
    """Read DIR/result.json, DIR/estimate.mcap and the truth, and check that they belong together.

    Args:
        directory: the folder of the estimate.
        truth_path: the truth file.
        allow_truncated: use the complete frames of a truth that was cut off.

    Raises:
        OutputError: DIR has no readable `result.json`, or its estimate did not finish.
        RecordingError: a file is missing, damaged or of the wrong kind, or the truth is of another recording.
    """
    unscored = read_result(directory / "result.json")
    estimated = read_estimate(directory / "estimate.mcap")
    if estimated.belief is None or estimated.detection is None:
        raise OutputError(f"{directory / 'estimate.mcap'} ends before its belief; estimate the recording again.")
    truth = read_truth(truth_path, allow_truncated=allow_truncated)
    refuse_other_figures(unscored, estimated, directory)
    if estimated.metadata.get(RECORDED, truth.scene) != truth.scene:
        raise RecordingError(
            f"{truth_path} is the truth of '{truth.scene}', and {directory} the estimate of "
            f"'{estimated.metadata[RECORDED]}'; give the truth of the same recording."
        )
    identity = estimated.metadata.get(IDENTITY, "")
    if truth.identity and identity and identity != truth.identity:
        raise RecordingError(
            f"{truth_path} is the truth of another recording of '{truth.scene}' than {directory} estimates (another "
            "scene file, sensing or seed); give the truth that was written with it."
        )
    if truth.frames and not {f.index for f in truth.frames} & {e.index for e in estimated.estimates}:
        raise RecordingError(f"{truth_path} shares no frame with {directory}; give the truth of the same recording.")
    return unscored, estimated, truth


def refuse_other_figures(figures: Json, estimated: EstimateRecording, directory: Path) -> None:
    """Refuse a result that is of another estimate than the one beside it.

    Raises:
        RecordingError: they differ in their number of particles.
    """
    n = len(estimated.sheet.rest)
    if figures["n_particles"] != n:
        raise RecordingError(
            f"{directory / 'result.json'} is of {figures['n_particles']} particles, and the estimate beside it of {n}; "
            "estimate the recording again."
        )
