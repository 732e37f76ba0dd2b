"""Units that recording.toml may name, and the likely one where the stated one is implausible."""

from typing import TypeVar

from .. import toml_kinds as kinds
from ..errors import RecordingError
from ..toml_kinds import REQUIRED, StrictTable

LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6}
"""Metres in one unit of length."""
PREFERRED_UNITS = ("m", "mm", "cm", "um")
"""Units of length in the order in which they are tried: cm are rare in exports, and um fit any place near 0."""
LIKELY_EXTENT = (0.01, 0.5)
"""Extents of usual pieces of tissue and cloth, by which a unit is guessed, or offered as a cure [m]."""
PIXELS_ARE_NO_LENGTH = (
    "pixels are no length: give points in space from stereo or a depth camera, or, of a flat sheet seen from above, "
    "pixels times the mm of one"
)
"""What to do with points of an image."""
TIME_UNITS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
"""Nanoseconds in one unit of time."""

Factor = TypeVar("Factor", int, float)


def unit_of(table: StrictTable, key: str, units: dict[str, Factor], default: object = REQUIRED) -> Factor:
    """Return the factor of the unit under a key.

    Raises:
        RecordingError: the key is missing without a default, or is no such unit.
    """
    unit = table.take(key, kinds.text, default)
    if unit not in units:
        raise RecordingError(f"{table.where} {key} must be one of {', '.join(units)}; got '{unit[:50]}'.")
    return units[unit]


def likely_unit(number: float, units: dict[str, Factor], low: float, high: float) -> str | None:
    """Return the unit in which a number of the data lies within limits; None where none or several do.

    Args:
        number: in the unit of the data.
        units: factor of each unit.
        low: lower limit, in the factors' unit.
        high: upper limit.
    """
    fitting = [unit for unit, factor in units.items() if low <= number * factor <= high]
    return fitting[0] if len(fitting) == 1 else None
