"""Options that several verbs share, as tyro reads them."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from ..errors import OptionError

PathArgument = Annotated[Path, tyro.conf.Positional]
Name = Annotated[str, tyro.conf.Positional]
RowsName = Literal["inside", "together", "images", "outside", "nothing"]
Out = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
AsJson = Annotated[bool, tyro.conf.arg(name="json")]
PairingTolerance = Annotated[float, tyro.conf.arg(name="pairing-tolerance", metavar="MS")]
"""Largest difference between the stamps of one frame [ms]."""
Disturb = tyro.conf.UseAppendAction[Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME[=MAGNITUDE]")]]
PAIRING_TOLERANCE_MS = 5.0
"""Default of `PairingTolerance`; the sensors of a robot stamp the same instant a few ms apart."""
MAX_PAIRING_TOLERANCE_MS = 1000.0
"""Largest one: in a second, every tissue has moved."""


def in_ns(tolerance_ms: float) -> int:
    """Return a pairing tolerance [ns].

    Raises:
        OptionError: below 0, or above `MAX_PAIRING_TOLERANCE_MS`.
    """
    if not 0 <= tolerance_ms <= MAX_PAIRING_TOLERANCE_MS:
        raise OptionError(
            f"--pairing-tolerance {tolerance_ms:g}: must be from 0 to {MAX_PAIRING_TOLERANCE_MS:g} milliseconds."
        )
    return round(tolerance_ms * 1e6)
