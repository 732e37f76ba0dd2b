"""What the heading of a column, or the name of an array, says: its name, its unit, and what it numbers."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

UNIT_WORDS = frozenset("m mm cm um µm μm px pix pixel pixels s ms n mn cn kn deg rad 1 - % none".split()) | {""}
"""What a line of units below a heading holds, without its brackets."""
PIXELS = "pixels"
"""The unit of coordinates in an image, which are no lengths."""


@dataclass(frozen=True, kw_only=True)
class UnitWords:
    """How headings, and the names of arrays, state units of one quantity."""

    in_brackets: dict[str, tuple[str, ...]]
    """Words of each unit in brackets, in lower case."""
    at_the_end: frozenset[str]
    """Those that count without brackets at the end of a name as well."""


LENGTHS = UnitWords(
    in_brackets={
        "m": ("m", "meter", "meters", "metre", "metres"),
        "cm": ("cm", "centimeters", "centimetres"),
        "mm": ("mm", "millimeters", "millimetres"),
        "um": ("um", "µm", "μm", "micron", "microns", "micrometers", "micrometres"),
        "inches": ("in", "inch", "inches"),
        PIXELS: ("px", "pix", "pixel", "pixels"),
    },
    at_the_end=frozenset("um µm μm mm cm px pix pixel pixels".split()),
)
"""Units of length, and what is none. A name that ends in `_m` states none: that may mean marker, mean or measured."""
FORCES = UnitWords(
    in_brackets={unit: (unit.lower(),) for unit in ("N", "mN", "cN", "kN", "gf", "kgf", "lbf")},
    at_the_end=frozenset("mn cn kn gf kgf lbf".split()),
)
"""Units of force. A name that ends in `_n` states none: that may be a normal force."""
BRACKETED = re.compile(r"[\[(]\s*([^\])]*?)\s*[\])]")
"""What stands in brackets."""
IN_BRACKETS = re.compile(r"^(?P<name>.*?)\s*[\[(](?P<unit>[^\])]*)[\])]\s*$")
"""A name with a unit in brackets, as `X [mm]`."""
AFTER_NAME = re.compile(r"^(?P<name>.+?)[_ ](?P<unit>um|µm|μm|mm|cm|m|px|pix|pixels?)$", re.IGNORECASE)
"""A name that ends in a unit, as `x_mm`."""
FRAME = re.compile(r"(frame|image|scan|timestep|step)(id|no|nr|num|number|index|idx)?")
"""Headings of a number of a frame, in letters alone."""
TIME = re.compile(r"(time|timestamp|t)(s|ms|us|ns|sec)?")
"""Headings of a time, in letters alone."""
TRACK = re.compile(
    r"ids?|label|(track|point|marker|node|particle|vertex|feature|keypoint|landmark|subset|object)"
    r"(id|no|nr|num|number|index|idx|label|name)?"
)
"""Headings of what names a point in all frames, in letters alone."""


def plain_heading(name: str) -> str:
    """Return a heading in lower case, without its unit."""
    text = name.strip(' "').lower()
    match = IN_BRACKETS.match(text) or AFTER_NAME.match(text)
    return (match["name"] if match else "") or text.split("[")[0].split("(")[0].strip() or text


def stated_unit(name: str, kind: UnitWords = LENGTHS) -> str | None:
    """Return the unit that a heading or the name of an array states, a key of `kind.in_brackets`; None for none."""
    text = name.strip(' "').lower()
    *before, last = re.split(r"[_\s]", text)
    words = [*BRACKETED.findall(text), *([last] if before and last in kind.at_the_end else [])]
    return next((unit for word in words for unit, names in kind.in_brackets.items() if word in names), None)


def stated_units(names: Iterable[str], kind: UnitWords = LENGTHS) -> frozenset[str]:
    """Return the units that names state."""
    return frozenset(unit for name in names if (unit := stated_unit(name, kind)) is not None)


def frame_columns(names: Sequence[str]) -> list[int]:
    """Return the columns whose headings say that they number the frames."""
    return [column for column, _ in _matches(FRAME, names)]


def time_columns(names: Sequence[str]) -> list[int]:
    """Return the columns whose headings say that they give times."""
    return [column for column, _ in _matches(TIME, names)]


def track_column(names: Sequence[str]) -> int | None:
    """Return the column whose heading says that it names points; one that says `track` before others."""
    found = [(match[1] != "track", column) for column, match in _matches(TRACK, names)]
    return min(found)[1] if found else None


def are_units(cells: list[str]) -> bool:
    """Return whether a line holds the units of the columns."""
    return all(cell.strip("[]() ").lower() in UNIT_WORDS for cell in cells)


def _matches(pattern: re.Pattern[str], names: Sequence[str]) -> list[tuple[int, re.Match[str]]]:
    letters = [re.sub(r"[\W_]", "", plain_heading(name)) for name in names]
    return [(column, match) for column, each in enumerate(letters) if (match := pattern.fullmatch(each))]
