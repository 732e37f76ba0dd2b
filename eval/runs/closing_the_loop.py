"""Closes the loop over a recording: files in, `discrepancy.json`, a page of pictures and the corrected model out.

A truth file, if given, is opened after everything is decided and written. It only adds the detection figures before and
after.
"""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool

from jiggle_mj.argument_checks import as_path
from jiggle_mj.episode import OnFrame, check_directory, clear_directory
from jiggle_mj.errors import RecordingError
from jiggle_mj.estimate import Sheet
from jiggle_mj.estimator import EstimatorConfig
from jiggle_mj.estimator.attribution.close_loop import UNEXPLAINED, close_the_loop
from jiggle_mj.estimator.attribution.corrected import corrected_declaration, corrected_parameters
from jiggle_mj.estimator.attribution.dataset import collect_dataset
from jiggle_mj.estimator.attribution.discrepancy import attachments, discrepancy, suggested
from jiggle_mj.estimator.attribution.kept_fits import KeptLoop
from jiggle_mj.estimator.attribution.suggestion import suggest
from jiggle_mj.estimator.blas import one_thread
from jiggle_mj.estimator.effects import LIBRARY, Effect
from jiggle_mj.estimator.perception import FrameMask, TissueMask
from jiggle_mj.recording.declaration import version_entry
from jiggle_mj.recording.output_files import fills_folder, write_text
from jiggle_mj.recording.reader import PAIRING_TOLERANCE_NS, Recording
from jiggle_mj.recording.truth import read_truth
from jiggle_mj.truth import Truth

from ..metrics.result import agreements
from ..metrics.result_file import Json
from ..metrics.truth_transfer import transfer
from ..report.discrepancy_page import write_page
from .check_before import check_before
from .corrected_estimate import corrected_detection
from .corrected_files import CORRECTED, PARAMETERS, write_corrected
from .kept_files import FITS, write_fits
from .settings_used import settings_used, with_declared

DISCREPANCY, PAGE = "discrepancy.json", "discrepancy.html"
OWN_FILES = (DISCREPANCY, PAGE, CORRECTED, PARAMETERS, FITS)
"""Files of a closed loop."""


@fills_folder
def close_loop(
    recording_path: Path,
    directory: Path,
    *,
    truth: Path | None = None,
    library: tuple[Effect, ...] = LIBRARY,
    suggestion: bool = False,
    keep_fits: bool = False,
    config: EstimatorConfig | None = None,
    declare: Mapping[str, Any] | None = None,
    mask: TissueMask | FrameMask | None = None,
    overwrite: bool = False,
    allow_truncated: bool = False,
    allow_implausible: bool = False,
    tolerance_ns: int = PAIRING_TOLERANCE_NS,
    on_frame: OnFrame = lambda observation, estimate: None,
    log: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Find the effects that the model lacks for a recording, add them, and report the error before and after.

    Args:
        recording_path: the MCAP file.
        directory: where discrepancy.json, discrepancy.html, corrected.toml and parameters.yaml go.
        truth: a truth file, to score the detected attachments before and after; opened after everything is decided.
        library: effects that are tested; `(*LIBRARY, mine)` adds one.
        suggestion: search the pull that best distinguishes the effects that these frames do not.
        keep_fits: write what `close_loops` needs to fit several recordings together, too.
        config: of the estimator.
        declare: properties of the tissue by name, over those of the recording; see `Declaration`.
        mask: see `Estimator`.
        overwrite: replace an earlier run's files.
        allow_truncated: use the complete part of a recording, and of a truth, that was cut off.
        allow_implausible: use a recording that `problems` refuses.
        tolerance_ns: largest difference between the stamps of one frame [ns].
        on_frame: called after each frame of the first estimate.
        log: gets a line for each doubt about the recording, and for each step of the work.

    Returns:
        The content of discrepancy.json.

    Raises:
        JiggleError: what any of the parts raises.
        ValueError: an effect of the library gives no finite derivative, or changes a shape.
    """
    recording_path, directory = as_path(recording_path, "the recording"), as_path(directory, "the folder")
    recording = Recording.open(recording_path, allow_truncated=allow_truncated, tolerance_ns=tolerance_ns)
    check_directory(directory, OWN_FILES, overwrite=overwrite)
    declaration = with_declared(recording.declaration, declare)
    check_before(recording, recording_path, declare, allow_implausible=allow_implausible, log=log)
    clear_directory(directory, OWN_FILES)
    dataset = collect_dataset(declaration, recording.camera, recording, config=config, mask=mask, on_frame=on_frame)
    used = settings_used(declaration, dataset.estimator.config, declare=declare, declared=recording.declared)
    with jax.enable_x64(True), one_thread():
        closed = close_the_loop(dataset, library=library, log=log)
        found: dict[str, Any] = {**version_entry(), **discrepancy(closed, dataset), "settings": used}
        if keep_fits:
            write_fits(directory / FITS, KeptLoop.of(closed))
    sheet, name = dataset.estimator.sheet, recording.metadata.get("name", recording_path.stem)

    def write() -> None:
        write_text(directory / DISCREPANCY, json.dumps(found, indent=1) + "\n")
        write_page(directory / PAGE, name=name, sheet=sheet, found=found)

    added = corrected_parameters(closed, declaration)
    write_corrected(directory, added, declaration, name=name)
    write()
    attached = {"before": closed.declared.fitted.attached, "after": closed.final.fitted.attached}
    if added and closed.verdict not in UNEXPLAINED:
        log("estimating under the corrected model")
        corrected = corrected_declaration(added, declaration)
        detection = corrected_detection(recording, corrected, config=config, mask=mask)
        found |= attachments(found, detection)
        attached["after"] = np.array(found["localisation_after"]["particles"]["attached"])
        write()
    if truth is not None:
        opened = read_truth(truth, allow_truncated=allow_truncated)
        if opened.identity != recording.metadata.get("identity", ""):
            raise RecordingError(f"{truth} is not the truth of {recording_path}; give the one written with it.")
        last = dataset.frames[-1].index
        for when, particles in attached.items():
            found[f"detection_{when}"] = _detection(sheet, particles, opened, last)
        write()
    if suggestion:
        with jax.enable_x64(True), one_thread():
            best = suggest(closed, dataset, log=log)
        found["suggestion"] = None if best is None else suggested(best)
        write()
    return found


def _detection(sheet: Sheet, detected: Bool[np.ndarray, " n"], truth: Truth, index: int) -> Json:
    transferred = transfer(sheet, truth, index)
    return {
        "n_detected": int(detected.sum()),
        "n_attached": int(transferred.attached.sum()),
        "by_dilation": agreements(sheet, detected, transferred),
    }
