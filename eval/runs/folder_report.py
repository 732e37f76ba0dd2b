"""The report of an estimate's folder: figures and settings, with pictures from the recording."""

import platform
from importlib.metadata import version
from pathlib import Path

from jiggle_mj.episode import ESTIMATE, REPORT, Episode
from jiggle_mj.errors import OutputError
from jiggle_mj.observation import StereoPair
from jiggle_mj.recording.estimate import EstimateRecording, read_estimate
from jiggle_mj.recording.reader import PAIRING_TOLERANCE_NS, Recording
from jiggle_mj.truth import Truth

from ..metrics.result_file import Json
from ..report.run_page import shown_steps, write_report

REPORTED_PACKAGES = ("jiggle-mj", "mujoco", "jax", "numpy", "scipy", "opencv-python-headless")
"""Packages whose versions are in the report: those that can change a figure."""


def write_folder_report(
    directory: Path,
    estimated: Episode | EstimateRecording,
    figures: Json,
    *,
    recording: Path | None,
    truth: Truth | None = None,
    tolerance_ns: int = PAIRING_TOLERANCE_NS,
) -> None:
    """Write report.html; the pictures come from the recording, if there is one with images.

    Args:
        directory: the folder, which holds the estimate.
        estimated: what is in it.
        figures: the content of result.json.
        recording: what was estimated; None for a report without pictures.
        truth: the true attachments, where they are known.
        tolerance_ns: largest difference between the stamps of one frame [ns].

    Raises:
        OutputError: the estimate did not finish.
        RecordingError: the recording cannot be read.
    """
    if estimated.belief is None or estimated.detection is None:
        raise OutputError(f"{directory / ESTIMATE} ends before its belief; estimate the recording again.")
    opened = None if recording is None else Recording.open(recording, allow_truncated=True, tolerance_ns=tolerance_ns)
    settings: dict[str, object] = {"estimate": dict(read_estimate(directory / ESTIMATE).metadata)}
    used = figures.get("settings")
    if isinstance(used, dict):
        settings["declared"] = {
            name: f"{entry['value']} ({entry['from']})" for name, entry in used["declaration"].items()
        }
    settings["versions"] = {name: version(name) for name in REPORTED_PACKAGES} | {"python": platform.python_version()}
    pairs: dict[int, StereoPair] = {}
    if opened is not None and opened.camera is not None:
        steps = shown_steps(estimated.estimates, estimated.sheet.rest)
        shown = {estimated.estimates[step].index for step in steps}
        pairs = {frame.index: frame.images for frame in opened if frame.index in shown and frame.images is not None}
    write_report(
        directory / REPORT,
        sheet=estimated.sheet,
        estimates=estimated.estimates,
        belief=estimated.belief,
        detection=estimated.detection,
        result=figures,
        settings=settings,
        truth=truth,
        images=pairs.get if pairs else None,
        camera=None if opened is None else opened.camera,
    )
