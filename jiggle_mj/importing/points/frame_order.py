"""Order in time of the files of frames: by the numbers in their names, 2 before 10.

Names have an order where they are the same text around numbers that all rise together, or around an ISO date and time.
Whatever else they say (signs, exponents, units, words, copies) is not guessed: the user lists the files.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from itertools import pairwise
from pathlib import Path

from ...errors import RecordingError
from ..data_folder import DataFolder, quoted

PART = re.compile(
    r"(?P<text>\d[\d.]*e[-+]?\d+|\d+\s?[ap]\.?m(?![a-z]))"
    r"|(?P<date>(?<!\d)(?:\d{4}([-_.])(?:0[1-9]|1[0-2])\3(?:[0-2]\d|3[01])|(?:19|20)\d{6}(?=[-_T ]\d{4}))"
    r"(?:[-_.T ]\d\d[-_.:h]?\d\d(?:[-_.:m]?\d\d(?:[.,]\d+)?)?)?(?!\d))"
    r"|(?P<number>\d+(?:\.\d+)?)",
    re.IGNORECASE | re.ASCII,
)
"""What a name holds beside text: a date with an optional time of 24 hours, or a number. Exponents and times of 12 hours
are text: their digits give no order."""
DIGITS = re.compile(r"(\d+)")
"""A whole number in a name."""


@dataclass(frozen=True, kw_only=True)
class NumberedName:
    """A name, split into text and numbers."""

    text: str
    """The name with a sign in place of each number."""
    numbers: tuple[Decimal, ...]
    """Its numbers, and the digits of its dates as numbers."""
    decimals: tuple[int, ...]
    """Count of decimals of each number, 0 for dates."""

    @classmethod
    def of(cls, path: Path) -> "NumberedName":
        """Return the split name of a file, without its suffix, whose digits are no number unless it is one."""
        name = str(path.with_suffix("")) if path.suffix and not path.suffix[1:].isdecimal() else str(path)
        text, numbers, decimals = name, list[Decimal](), list[int]()
        for match in reversed([match for match in PART.finditer(name) if match["text"] is None]):
            digits = re.sub(r"\D", "", match[0]) if match["date"] else match[0]
            kind = f"<date of {len(digits)} digits>" if match["date"] else "<number>"
            text = text[: match.start()] + kind + text[match.end() :]
            numbers.insert(0, Decimal(digits))
            decimals.insert(0, len(digits.partition(".")[2]))
        return cls(text=text, numbers=tuple(numbers), decimals=tuple(decimals))


def frame_files(folder: DataFolder, patterns: Sequence[str]) -> tuple[list[Path], list[str]]:
    """Return the files in the order of time, and notes where that is not the order of their names.

    Names and patterns keep their order; the files of one pattern are ordered by the numbers in their names.

    Raises:
        RecordingError: a file is outside the folder or named twice, nothing matches, or the names give no order.
    """
    paths: list[Path] = []
    notes: list[str] = []
    for pattern in patterns:
        found = sorted(folder.matching(pattern))
        ordered = _ordered(found, pattern, folder.path)
        if ordered != found:
            before, after = next((a, b) for a, b in pairwise(ordered) if found.index(a) > found.index(b))
            notes.append(f"frames are in the order of their numbers: {_shown(before, after)}")
        paths += ordered
    if len(paths) == len(patterns):
        swapped = next(((a, b) for a, b in pairwise(paths) if _are_out_of_order(a, b)), None)
        notes += [f"the order of [points] files is kept: {_shown(*swapped)}"] if swapped else []
    twice = next((path for path in paths if paths.count(path) > 1), None) if len(set(paths)) < len(paths) else None
    if twice is not None:
        raise RecordingError(f"[points] files names {twice.name} twice; each file is one frame.")
    return paths, notes


def _ordered(paths: list[Path], pattern: str, folder: Path) -> list[Path]:
    """Return the matches of a pattern in the order of time.

    Raises:
        RecordingError: the names differ in more than numbers, or their numbers contradict each other.
    """
    if len(paths) < 2:
        return paths
    names = {path: NumberedName.of(path.relative_to(folder)) for path in paths}
    ordered = sorted(paths, key=lambda path: (names[path].text, names[path].numbers))
    for before, after in pairwise(ordered):
        first, second = names[before], names[after]
        if first.text != second.text:
            why = "differ in more than a number"
        elif first.numbers == second.numbers:
            why = "have the same number"
        elif any(a > b for a, b in zip(first.numbers, second.numbers, strict=True)):
            why = "have several numbers, which give different orders"
        elif any(a and b and a != b for a, b in zip(names[ordered[0]].decimals, second.decimals, strict=True)):
            why = "have numbers with different counts of decimals"
        else:
            continue
        raise RecordingError(
            f"the files of '{quoted(pattern)}' have no clear order in time: {quoted(_shown(before, after, ' and '))} "
            f"{why}. Name them by one number, as f_1 and f_2, or list them in the order of time in [points] files."
        )
    return ordered


def _shown(before: Path, after: Path, between: str = " before ") -> str:
    """Return two files in words, with their folders where they have one name."""
    if before.name == after.name:
        return f"{before.parent.name}/{before.name}{between}{after.parent.name}/{after.name}"
    return f"{before.name}{between}{after.name}"


def _are_out_of_order(before: Path, after: Path) -> bool:
    """Return whether two files that differ by numbers alone are in another order than their numbers."""
    first, second = NumberedName.of(before), NumberedName.of(after)
    return first.text == second.text and first.numbers > second.numbers


def natural_key(name: str) -> list[tuple[int, str]]:
    """Return a key that compares numbers by value; text and numbers alternate, so that like compares with like."""
    return [(int(part), "") if part.isdecimal() else (0, part) for part in DIGITS.split(name)]
