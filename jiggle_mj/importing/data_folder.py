"""The folder of measured data, outside which an import reads nothing unless the user allows it."""

import re
from dataclasses import dataclass
from pathlib import Path

from ..errors import MAX_SHOWN, RecordingError

GLOB = re.compile(r"[*?\[]")
"""Characters that make a name a pattern."""


def quoted(text: object) -> str:
    """Return input for an error: on one line, at most `MAX_SHOWN` characters."""
    shown = str(text).encode("unicode_escape", "backslashreplace").decode("ascii")
    return shown if len(shown) <= MAX_SHOWN else shown[:MAX_SHOWN] + "..."


@dataclass(frozen=True, kw_only=True)
class DataFolder:
    """A folder whose files are named relative to it."""

    path: Path
    """The folder."""
    allow_outside: bool = False
    """Whether names may lead out of the folder: absolute, with `..`, or through a link."""

    def __truediv__(self, name: str) -> Path:
        """Return the path of a file that `recording.toml` names; the file need not exist.

        Raises:
            RecordingError: the name is none, or leads out of the folder.
        """
        if not name or "\0" in name:
            raise RecordingError(f"'{quoted(name)}' is no name of a file in {self.path}.")
        found = self.path / name
        try:
            inside = found.resolve().is_relative_to(self.path.resolve())
        except (OSError, RuntimeError, ValueError) as failure:
            raise RecordingError(f"{quoted(found)} cannot be reached: {quoted(failure)}.") from failure
        if not inside and not self.allow_outside:
            raise RecordingError(
                f"'{quoted(name)}' leads out of the folder {self.path}; an import reads only inside it: copy the file "
                "there, or allow it with --allow-outside."
            )
        return found

    def matching(self, pattern: str) -> list[Path]:
        """Return the files of a name or pattern, in no particular order.

        Raises:
            RecordingError: nothing matches, the pattern is malformed, or a file is outside the folder.
        """
        literal = self / pattern
        if not GLOB.search(pattern) or literal.exists():
            return [literal]
        if Path(pattern).is_absolute():
            raise RecordingError(f"'{quoted(pattern)}': a pattern must be relative to the folder {self.path}.")
        try:
            paths = list(self.path.glob(pattern))
        except (OSError, ValueError, NotImplementedError, IndexError, RuntimeError, re.error) as failure:
            raise RecordingError(f"'{quoted(pattern)}' is no pattern of names: {quoted(failure)}.") from failure
        if not paths:
            raise RecordingError(f"{self.path} holds no file that matches '{quoted(pattern)}'.")
        return [self / str(path.relative_to(self.path)) for path in paths]
