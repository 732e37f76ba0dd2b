"""Scoring an estimate that lies in a folder, once its truth may be opened."""

from collections.abc import Callable
from pathlib import Path

from jiggle_mj.episode import RECORDING
from jiggle_mj.errors import RecordingError
from jiggle_mj.recording.estimate import EstimateRecording
from jiggle_mj.recording.reader import Recording

from ..metrics.result import score_read
from ..metrics.result_file import IDENTITY, RECORDED, Json, pairing_tolerance, read_scorable
from .folder_report import write_folder_report


def score_directory(
    directory: Path,
    truth: Path,
    *,
    recording: Path | None = None,
    allow_truncated: bool = False,
    log: Callable[[str], None] = lambda _: None,
) -> Json:
    """Score an estimate in a folder, and write its report again with the truth.

    Args:
        directory: the folder.
        truth: the truth file.
        recording: what was estimated, for the report's pictures; if None, it is searched next to the truth file and in
            the folder.
        allow_truncated: use the complete frames of a truth that was cut off.
        log: gets a line if the report loses its pictures.

    Raises:
        RecordingError: the folder holds no estimate, the file no truth, or one of another recording.
        OutputError: the estimate did not finish.
    """
    unscored, estimated, opened = read_scorable(directory, truth, allow_truncated=allow_truncated)
    if recording is not None and not _is_of(estimated, recording):
        raise RecordingError(f"{recording} is not the recording that {directory} estimates; give that one, or none.")
    figures = score_read(directory, unscored, estimated, opened)
    if recording is None:
        sibling = truth.with_name(truth.name.replace(".truth.", "."))
        candidates = (path for path in (sibling, directory / RECORDING) if path != truth and path.exists())
        recording = next((path for path in candidates if _is_of(estimated, path)), None)
    if recording is None and figures["sensing"] == "stereo":
        log("the recording is not next to the truth: the report has no pictures; pass --recording for them")
    tolerance_ns = pairing_tolerance(estimated)
    write_folder_report(directory, estimated, figures, recording=recording, truth=opened, tolerance_ns=tolerance_ns)
    return figures


def _is_of(read: EstimateRecording, recording: Path) -> bool:
    """Say whether an estimate is of this recording, by name and identity."""
    tolerance_ns = pairing_tolerance(read)
    about = Recording.open(recording, allow_truncated=True, tolerance_ns=tolerance_ns).metadata
    same = about.get("name", recording.stem) == read.metadata.get(RECORDED)
    return same and about.get("identity", "") == read.metadata.get(IDENTITY, "")
