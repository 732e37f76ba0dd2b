"""The file `result.json`: written, read, and checked to belong to an estimate and a truth."""

import json
from pathlib import Path

from jiggle_mj.errors import OutputError, RecordingError
from jiggle_mj.recording.estimate import EstimateRecording, read_estimate
from jiggle_mj.recording.truth import read_truth
from jiggle_mj.truth import Truth

Json = dict[str, object]
RECORDED, IDENTITY = "recording", "recording.identity"
"""Metadata of an estimate: name and identity of the recording that was estimated."""


def write_result(path: Path, figures: Json) -> None:
    """Write `result.json`.

    Raises:
        ValueError: a figure is NaN or infinite; JSON has neither.
    """
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


def read_scorable(directory: Path, truth_path: Path) -> tuple[Json, EstimateRecording, Truth]:
    """Read DIR/result.json, DIR/estimate.mcap and the truth, and check that they belong together.

    Raises:
        OutputError: DIR has no readable `result.json`, or its estimate did not finish.
        RecordingError: a file is missing, damaged or of the wrong kind, or the truth is of another recording.
    """
    unscored = read_result(directory / "result.json")
    estimated = read_estimate(directory / "estimate.mcap")
    if estimated.belief is None or estimated.detection is None:
        raise OutputError(f"{directory / 'estimate.mcap'} ends before its belief; estimate the recording again.")
    truth = read_truth(truth_path)
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
