"""Output that appears complete or not at all: written in a hidden folder beside its place, and renamed at the end."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import OutputError


@contextmanager
def complete_files(recording: Path, truth: Path, *, overwrite: bool) -> Iterator[tuple[Path, Path]]:
    """Return paths to write a recording and its truth to; both get their names when the block ends without an error.

    A truth that is not written leaves none: an older one beside the recording is removed.

    Raises:
        OutputError: a file exists and `overwrite` is false, or the folder cannot be written.
    """
    if recording.is_dir():
        raise OutputError(f"{recording} is a folder; give a file, such as {recording / 'run.mcap'}.")
    for path in (recording, truth):
        if path.exists() and not overwrite:
            raise OutputError(f"{path} exists; choose another path, or allow the file to be replaced (--overwrite).")
    try:
        folder = Path(tempfile.mkdtemp(prefix=f".{recording.name[:50]}-", dir=recording.parent))
    except (OSError, ValueError) as failure:
        raise OutputError(f"{recording} cannot be written: {getattr(failure, 'strerror', failure)}.") from failure
    part, truth_part = folder / "run.mcap", folder / "run.truth.mcap"
    try:
        yield part, truth_part
        if truth_part.exists():
            os.replace(truth_part, truth)
        else:
            truth.unlink(missing_ok=True)
        os.replace(part, recording)
    except OSError as failure:
        raise OutputError(f"{recording} cannot be written: {failure.strerror}.") from failure
    finally:
        shutil.rmtree(folder, ignore_errors=True)
