"""Imports that appear complete or not at all: written in a hidden folder beside their place, and renamed at the end.

A writer of recordings completes its file even where an error ends it, so that a crashed run can be read. Half an import
is of no use.
"""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import OutputError
from ..recording.mcap_files import truth_path
from ..recording.output_files import PartialFile


@contextmanager
def complete_files(recording: Path, *, overwrite: bool) -> Iterator[tuple[Path, Path]]:
    """Return paths to write a recording and its truth to; both get their names when the block ends without an error.

    Until then no other process can write that recording. A truth that is not written leaves none: an older one beside
    the recording is removed.

    Raises:
        OutputError: a file exists and `overwrite` is false, another process writes it, or it cannot be written.
    """
    if recording.exists() and not (recording.is_file() or recording.is_dir()):
        raise OutputError(f"{recording} is a device or a pipe; give a file, such as run.mcap.")
    claim = PartialFile(recording, overwrite=overwrite)
    folder: Path | None = None
    try:
        truth = truth_path(recording)
        if truth.exists() and not overwrite:
            raise OutputError(f"{truth} exists; choose another path, or allow the file to be replaced (--overwrite).")
        folder = Path(tempfile.mkdtemp(prefix=f".{recording.name[:50]}-", dir=recording.parent))
        part, truth_part = folder / "run.mcap", folder / "run.truth.mcap"
        yield part, truth_part
        if truth_part.exists():
            os.replace(truth_part, truth)
        else:
            truth.unlink(missing_ok=True)
        os.replace(part, claim.path)
    except OSError as failure:
        raise OutputError(f"{recording} cannot be written: {failure.strerror}.") from failure
    finally:
        claim.discard()
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)
