"""One recording of many to close the loop over: what is done with it, where, and whether it has been done.

`job.json` in the folder says what the loop was closed over and with which settings. Its `seconds` are null until all
files are there; a folder in which they are null is done again.
"""

import hashlib
import json
import time
import traceback
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jiggle_mj.episode import check_directory, clear_directory
from jiggle_mj.errors import JiggleError, OutputError
from jiggle_mj.estimator import EstimatorConfig
from jiggle_mj.nested_settings import dotted
from jiggle_mj.observation import Declaration
from jiggle_mj.recording.declaration import identity, version_entry
from jiggle_mj.recording.output_files import write_text
from jiggle_mj.recording.reader import Recording

from ..metrics.result_file import Json, read_json
from .closing_the_loop import DISCREPANCY, OWN_FILES, close_loop
from .compiled_functions import drop_many_compiled
from .corrected_files import CORRECTED_JOINT
from .kept_files import FITS
from .mask_files import mask_shown
from .settings_used import with_declared

JOB, LOG = "job.json", "log.txt"
"""Files in the folder of a recording: what was done, and the lines that a single run prints."""
MADE_BY = "'jiggle-mj close-loop' of several recordings writes it; delete its folder, and it is made anew"
"""Origin of the files that are kept for a recording."""
PLAIN_OPTIONS = ("suggestion", "allow_truncated", "allow_implausible", "tolerance_ns")
"""Options whose values are flags and numbers."""


@dataclass(frozen=True, kw_only=True)
class ClosingOrder:
    """One recording to close the loop over."""

    recording: Path
    folder: Path
    """Folder of its results."""
    job: Json
    """What `job.json` holds beside the time: version, digests of the recording and of the settings."""
    options: Mapping[str, Any] = field(repr=False)
    """Arguments of `close_loop` beside recording and folder."""
    keep_fits: bool = False
    """Whether the fits are kept, too."""

    @classmethod
    def of(
        cls, recording: Path, folder: Path, options: Mapping[str, Any], *, keep_fits: bool = False
    ) -> "ClosingOrder":
        """Return the order for a recording, with digests of what the results depend on.

        Args:
            recording: the MCAP file.
            folder: for its results.
            options: all arguments of `close_loop` that change a result.
            keep_fits: whether the fits are kept, too.
        """
        digests = {"recording": _digest_of_file(recording), "settings": _digest_of(options)}
        job: Json = {**version_entry(), **digests}
        return cls(
            recording=recording.absolute(), folder=folder.absolute(), job=job, options=options, keep_fits=keep_fits
        )

    def is_complete(self) -> bool:
        """Return whether the results exist.

        Raises:
            OutputError: the folder holds the results of something else.
        """
        path = self.folder / JOB
        if not path.exists():
            check_directory(self.folder, OWN_FILES, overwrite=False)
            return False
        kept = read_json(path, MADE_BY)
        if changed := [name for name, value in self.job.items() if kept.get(name) != value]:
            what = "another recording" if "recording" in changed else "other settings, or of another version"
            raise OutputError(f"{self.folder} holds results of {what}; choose another folder or pass --overwrite.")
        files = (DISCREPANCY, FITS) if self.keep_fits else (DISCREPANCY,)
        return kept.get("seconds") is not None and all((self.folder / file).exists() for file in files)

    def opened(self) -> tuple[Recording, Declaration]:
        """Return the recording and what is declared of it.

        Raises:
            JiggleError: it cannot be read.
        """
        recording = Recording.open(
            self.recording,
            allow_truncated=self.options["allow_truncated"],
            tolerance_ns=self.options["tolerance_ns"],
        )
        return recording, with_declared(recording.declaration, self.options["declare"])

    def found(self) -> dict[str, Any]:
        """Return the content of discrepancy.json."""
        return read_json(self.folder / DISCREPANCY, MADE_BY)

    def seconds(self) -> float:
        """Return how long it took [s]."""
        return read_json(self.folder / JOB, MADE_BY)["seconds"]

    def execute(self) -> None:
        """Close the loop, with its log beside the results.

        Raises:
            JiggleError: what `close_loop` raises.
            RuntimeError: it raised anything else, which another process may not be able to send; the log has all of it.
        """
        clear_directory(self.folder, (*OWN_FILES, CORRECTED_JOINT, JOB, LOG))
        drop_many_compiled()
        self._write_job(seconds=None)
        began = time.perf_counter()
        with open(self.folder / LOG, "w", encoding="utf-8") as file:

            def log(text: str) -> None:
                print(text, file=file, flush=True)

            try:
                with mask_shown(self.folder):
                    close_loop(
                        self.recording,
                        self.folder,
                        **self.options,
                        keep_fits=self.keep_fits,
                        overwrite=True,
                        log=log,
                    )
            except JiggleError as refusal:
                log(str(refusal))
                raise
            except Exception as failure:
                traceback.print_exc(file=file)
                why = " ".join(f"{type(failure).__name__}: {failure}".split())
                raise RuntimeError(f"{why}; {self.folder / LOG} has all of it.") from None
        self._write_job(seconds=time.perf_counter() - began)

    def _write_job(self, *, seconds: float | None) -> None:
        write_text(self.folder / JOB, json.dumps({**self.job, "seconds": seconds}, indent=1) + "\n")


def _digest_of_file(path: Path) -> str | None:
    """Return the SHA-256 of a file; None where it cannot be read."""
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return None


def _digest_of(options: Mapping[str, Any]) -> str:
    mask = options["mask"]
    of_mask = () if mask is None else (type(mask).__name__, *getattr(mask, "__dict__", {}).values())
    return identity(
        {name: options[name] for name in PLAIN_OPTIONS},
        dict(dotted(options["config"] or EstimatorConfig())),
        repr(sorted((options["declare"] or {}).items())),
        [(effect.name, effect.prior_sds) for effect in options["library"]],
        *(value if isinstance(value, np.ndarray) else repr(value) for value in of_mask),
    )
