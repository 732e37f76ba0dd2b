"""The table `[points]` of recording.toml: which files hold the tracked points, and how they are to be read.

Checks kinds of values only; the readers compare them with the files.
"""

import re
from dataclasses import dataclass
from typing import Any

from ... import toml_kinds as kinds
from ...argument_checks import quoted
from ...errors import RecordingError
from ...toml_kinds import StrictTable
from .dic_formats import DIC_FORMATS, OTHER_DIC_PROGRAMS
from .layouts import FRAMES_FIRST, Layout, read_layout
from .missing_rule import MissingRule, read_missing

NONE = "none"
"""Value of `visibility` and `missing` that says: every finite position was seen."""
ARCHIVE = re.compile(r"\.(npz|mat)$", re.IGNORECASE)
"""Names of archives, whose arrays have keys."""
SEPARATORS = {",": ",", ";": ";", "|": "|", ":": ":", "\t": "\t", "tab": "\t", " ": " ", "blanks": " "}
"""Values of `separator`, and the character each stands for."""
DEFAULT_VISIBILITY_THRESHOLD = 0.5
"""Probability of being visible from which a point counts as seen: likelier seen than not."""


@dataclass(frozen=True, kw_only=True)
class PointFiles:
    """The files that hold the tracked points."""

    files: tuple[str, ...]
    """Names or patterns of the files, in the order of time."""
    key: str | tuple[str, ...] | None = None
    """Name of the positions in an archive, shape (frames, points, 3) in the order of `layout`, or the names of x, y and
    z, each (frames, points); None for other files."""
    layout: Layout | None = None
    """Order of the positions' axes; None for frames, points, xyz, which is then checked for plausibility."""
    times: str | None = None
    """Name of the frames' times in the archive, shape (frames,), or heading of their column in a text file; None for
    frames at a constant period."""
    runs: str | None = None
    """Name of an array in the archive, shape (frames,): integers that change where another grasp begins; None for one
    grasp."""
    columns: tuple[int | str, ...] | None = None
    """Columns of x, y, z in a text file, by number from 0 or by heading; None for those that the heading names, or the
    first three. Two columns are points of a plane."""
    frame_column: int | str | None = None
    """Column that numbers the frames of a single text file, `NONE`, or None for the one that the heading names."""
    track_column: int | str | None = None
    """Column that names the points in text files, `NONE`, or None for the one that the heading names."""
    separator: str | None = None
    """Character between the cells of a text file; a blank stands for blanks and tabs; None to find it."""
    decimal: str | None = None
    """Decimal mark of a text file, a point or a comma; None to find it."""
    displacements: tuple[int | str, ...] | None = None
    """Columns, or arrays of the archive, of displacements that are added to the positions; None for none."""
    format: str | None = None
    """Program whose export the files are, in `DIC_FORMATS`; None for none."""
    visibility: str | None = None
    """Name of an array in the archive that says which points are seen, `NONE`, or None where nothing is given."""
    visibility_threshold: float = DEFAULT_VISIBILITY_THRESHOLD
    """Probability from which a point counts as seen, where the array holds probabilities."""
    missing: MissingRule | None = None
    """Rule for points that are unseen though their coordinates are finite; None for none given."""
    rest: int = 0
    """Number of the rest frame, from 0; it is written first."""


def read_points_table(table: StrictTable) -> PointFiles:
    """Return the contents of `[points]`.

    Raises:
        RecordingError: a key is unknown or missing, a value is of the wrong kind, or two keys contradict each other.
    """
    layout, missing = table.take("layout", kinds.text, None), table.take("missing", _anything, None)
    separator = table.take("separator", _separator, None)
    points = PointFiles(
        files=table.take("files", kinds.texts),
        key=table.take("key", _text_or_texts, None),
        layout=None if layout is None else read_layout(layout, table.where),
        columns=table.take("columns", _columns, None),
        frame_column=table.take("frame_column", _column, None),
        track_column=table.take("track_column", _column, None),
        separator=separator,
        decimal=table.take("decimal", _decimal, None),
        displacements=table.take("displacements", _names, None),
        format=table.take("format", kinds.text, None),
        visibility=table.take("visibility", kinds.text, None),
        visibility_threshold=table.take("visibility_threshold", _probability, DEFAULT_VISIBILITY_THRESHOLD),
        missing=None if missing is None else read_missing(missing, table.where),
        times=table.take("times", kinds.text, None),
        runs=table.take("runs", kinds.text, None),
        rest=table.take("rest", kinds.count, 0),
    )
    table.refuse_unknown()
    _refuse_contradictions(points, table.where)
    return points


def _refuse_contradictions(points: PointFiles, where: str) -> None:
    archive = bool(points.files) and ARCHIVE.search(points.files[0]) is not None
    if not points.files:
        raise RecordingError(f"{where} needs at least one file.")
    if points.key is not None and not archive:
        raise RecordingError(
            f"{where} key names the array of an .npz or .mat, and only that; files are {quoted(points.files)}."
        )
    if not archive and (points.runs or points.visibility):
        raise RecordingError(f"{where} runs and visibility name arrays of an .npz; files are {quoted(points.files)}.")
    if points.times and points.rest:
        raise RecordingError(f"{where} rest must be 0 where frames have times; got {points.rest}.")
    if points.runs and not points.times:
        raise RecordingError(f"{where} runs needs times.")
    if points.columns is not None and points.displacements is not None:
        if len(points.columns) != len(points.displacements):
            raise RecordingError(
                f"{where} displacements must name as many columns as columns; got {len(points.displacements)} and "
                f"{len(points.columns)}."
            )
    if points.separator is not None and points.separator == points.decimal:
        raise RecordingError(f"{where} separator and decimal are both '{points.separator}'; they must differ.")
    if points.layout not in (None, FRAMES_FIRST) and not archive and not points.files[0].endswith(".npy"):
        raise RecordingError(f"{where} layout is for arrays (.npz, .npy, .mat); files are {quoted(points.files)}.")
    if points.format is not None and points.format not in DIC_FORMATS:
        hint = OTHER_DIC_PROGRAMS.get(points.format)
        known = ", ".join(DIC_FORMATS)
        raise RecordingError(f"{where} format must be one of {known}; got '{points.format[:50]}'{hint or '.'}")
    if points.format is not None and (points.columns is not None or points.displacements is not None):
        raise RecordingError(f"{where} format says which columns are read; leave out columns and displacements.")


def _anything(value: Any) -> Any:
    return value


def _separator(value: Any) -> str:
    if value not in SEPARATORS:
        raise TypeError('one of ",", ";", "|", ":", "tab", "blanks"')
    return SEPARATORS[value]


def _decimal(value: Any) -> str:
    if value not in (".", ","):
        raise TypeError('"." or ","')
    return value


def _probability(value: Any) -> float:
    number = kinds.number(value)
    if not 0 < number < 1:
        raise TypeError("a number between 0 and 1")
    return number


def _text_or_texts(value: Any) -> str | tuple[str, ...]:
    if isinstance(value, str):
        return value
    names = kinds.texts(value)
    if len(names) not in (2, 3):
        raise TypeError("a text, or the names of x, y and z")
    return names


def _columns(value: Any) -> tuple[int | str, ...]:
    """Return two or three different columns, by number or by heading."""
    kind = "three columns, or two of a plane, each a whole number from 0 or a heading"
    if not isinstance(value, list) or len(value) not in (2, 3):
        raise TypeError(kind)
    if not all(_is_column(item) for item in value):
        raise TypeError(kind)
    if len(set(value)) != len(value):
        raise TypeError(f"different columns, for x, y and z: {kind}")
    return tuple(value)


def _column(value: Any) -> int | str:
    """Return a column, by number or by heading."""
    if not _is_column(value):
        raise TypeError(f'a column, as a whole number from 0 or a heading, or "{NONE}"')
    return value


def _is_column(value: Any) -> bool:
    return isinstance(value, str) or (type(value) is int and value >= 0)


def _names(value: Any) -> tuple[int | str, ...]:
    """Return the name of one array, or two or three columns."""
    return (value,) if isinstance(value, str) else _columns(value)
