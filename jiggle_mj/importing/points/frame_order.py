"""Order in time of the files of frames: by the numbers in their names, 2 before 10."""

import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from ...errors import RecordingError
from ..data_folder import DataFolder, quoted

DIGITS = re.compile(r"(\d+)")
"""A number in a name."""
FRACTION = re.compile(r"\d+\.\d+")
"""A number with a decimal point in a name, as a time has."""


def frame_files(folder: DataFolder, patterns: Sequence[str]) -> tuple[list[Path], list[str]]:
    """Return the files in the order of time, and notes where that is not the order of their names.

    Names and patterns keep their order; the files of one pattern are ordered by the numbers in their names.

    Raises:
        RecordingError: a file is outside the folder or named twice, nothing matches, or the numbers give no order.
    """
    paths: list[Path] = []
    notes: list[str] = []
    for pattern in patterns:
        found = sorted(folder.matching(pattern))
        ordered = sorted(found, key=lambda path: (natural_key(_stem(path)), path.name))
        _refuse_unequal_fractions(ordered, pattern)
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


def _shown(before: Path, after: Path) -> str:
    """Return the order of two files in words, with their folders where they have one name."""
    if before.name == after.name:
        return f"{before.parent.name}/{before.name} before {after.parent.name}/{after.name}"
    return f"{before.name} before {after.name}"


def _are_out_of_order(before: Path, after: Path) -> bool:
    """Return whether two files that differ by numbers alone are in another order than their numbers."""
    same = DIGITS.sub("", str(before)) == DIGITS.sub("", str(after))
    return same and natural_key(_stem(before)) > natural_key(_stem(after))


def _stem(path: Path) -> str:
    """Return the path without its suffix, whose digits are no frame number."""
    return str(path.with_suffix("")) if path.suffix else str(path)


def natural_key(name: str) -> list[tuple[int, str]]:
    """Return a key that compares numbers by value; text and numbers alternate, so that like compares with like."""
    return [(int(part), "") if part.isdecimal() else (0, part) for part in DIGITS.split(name)]


def _refuse_unequal_fractions(paths: list[Path], pattern: str) -> None:
    """Refuse decimal numbers of several lengths: 1.10 comes after 1.9 as a version, before it as a time."""
    numbers = [match.group() for path in paths for match in FRACTION.finditer(path.stem)]
    lengths = {len(number.partition(".")[2]) for number in numbers}
    if len(lengths) > 1:
        raise RecordingError(
            f"the files of '{quoted(pattern)}' have decimal numbers of several lengths in their names, which give no "
            "clear order: list them in [points] files."
        )
