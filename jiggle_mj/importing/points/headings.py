"""What the heading of a column, or the name of an array, says: its name, its unit, and what it numbers."""

import re
from collections.abc import Iterable, Sequence

UNIT_WORDS = frozenset("m mm cm um µm μm px pix pixel pixels s ms n mn cn kn deg rad 1 - % none".split()) | {""}
"""What a line of units below a heading holds, without its brackets."""
PIXELS = "pixels"
"""The unit of coordinates in an image, which are no lengths."""
LENGTHS = {
    "m": ("m", "meter", "meters", "metre", "metres"),
    "cm": ("cm", "centimeters", "centimetres"),
    "mm": ("mm", "millimeters", "millimetres"),
    "um": ("um", "µm", "μm", "micron", "microns", "micrometers", "micrometres"),
    "inches": ("in", "inch", "inches"),
    PIXELS: ("px", "pix", "pixel", "pixels"),
}
"""Words for units of length, and for what is none."""
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


def stated_unit(name: str) -> str | None:
    """Return the unit of length that a heading or the name of an array states, a key of `LENGTHS`; None for none.

    A name that ends in `_m` states none: that may mean marker, mean or measured.
    """
    text = name.strip(' "').lower()
    match = IN_BRACKETS.match(text) or AFTER_NAME.match(text)
    if match is None or (match.re is AFTER_NAME and match["unit"] == "m"):
        return None
    return next((unit for unit, words in LENGTHS.items() if match["unit"].strip() in words), None)


def stated_units(names: Iterable[str]) -> frozenset[str]:
    """Return the units of length that names state."""
    return frozenset(unit for name in names if (unit := stated_unit(name)) is not None)


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
