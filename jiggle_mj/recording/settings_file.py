"""Files of settings: TOML of a limited size."""

import tomllib
from pathlib import Path
from typing import Any

from ..errors import MAX_SHOWN, OptionError

MAX_FILE_BYTES = 2**20
"""Largest file of settings [bytes]."""


def read_table(path: Path, option: str) -> dict[str, Any]:
    """Return the content of a file of settings; `option` says what it was given for.

    Raises:
        OptionError: it cannot be read, is no TOML, or is larger than `MAX_FILE_BYTES`.
    """
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise OptionError(f"{option} {path} is larger than {MAX_FILE_BYTES} bytes; is it a file of settings?")
        return tomllib.loads(path.read_text())
    except OSError as failure:
        raise OptionError(f"{option} {path} cannot be read: {failure.strerror}.") from failure
    except (ValueError, RecursionError) as failure:
        raise OptionError(f"{option} {path} is no TOML: {str(failure)[:MAX_SHOWN]}.") from failure
