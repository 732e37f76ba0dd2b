"""The check before an estimate, the same from the command line and from Python."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from jiggle_mj.plausibility.check import refuse_implausible
from jiggle_mj.plausibility.survey import survey
from jiggle_mj.recording.reader import Recording

from .settings_used import assumed

CURE = " (--allow-implausible, or allow_implausible=True, goes on nevertheless)"


def check_before(
    recording: Recording,
    path: Path,
    declare: Mapping[str, Any] | None,
    *,
    allow_implausible: bool,
    log: Callable[[str], None],
) -> None:
    """Check a recording before it is estimated, and say what is assumed of its tissue and what takes long.

    Args:
        recording: an open recording.
        path: its file, for messages.
        declare: properties that the caller declares over those of the recording.
        allow_implausible: report what refuses the recording, and go on.
        log: gets a line for each doubt and assumption, and one on compilation.

    Raises:
        RecordingError: the recording is implausible.
    """
    refuse_implausible(survey(recording), path, log=log, allow=allow_implausible, cure=CURE)
    assumption = assumed(recording.declaration, declare=declare, declared=recording.declared)
    if assumption is not None:
        log(assumption)
    log("the first frames wait for compilation, about half a minute for a sheet of new size")
