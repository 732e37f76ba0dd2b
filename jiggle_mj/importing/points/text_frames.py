"""Frames of tracked points in text tables: one file a frame, or one file with a column that numbers the frames."""

from pathlib import Path

import numpy as np

from ...errors import RecordingError
from ..data_folder import quoted
from .dic_formats import DIC_FORMATS, DISPLACEMENT_HEADINGS
from .file_kinds import refuse_many
from .headings import plain_heading, stated_units
from .measured import Measured
from .missing_rule import AXES, MissingRule
from .points_table import NONE, PointFiles
from .position_columns import guessed_columns, refuse_row_numbers
from .rating_names import marks_hidden, rates_points
from .row_keys import Column, RowKeys
from .text_format import TextFormat, column_numbers
from .text_lines import read_lines
from .text_table import TextTable
from .tracks import FrameRows, joined_tracks
from .visibility import refuse_low_ratings


def read_text_frames(paths: list[Path], points: PointFiles) -> Measured:
    """Return the contents of text files, which all have the format and the columns of the first.

    A file is one frame, unless it is the only one and a column numbers its frames.

    Raises:
        RecordingError: a file is no table, lacks a column, or the frames differ in their points.
    """
    first = _open(paths[0], points, None)
    keys = RowKeys.of(first, points)
    columns, notes = _position_columns(first, points, keys)
    displacements = _displacement_columns(first, points)
    rule = missing_rule(points)
    rule_column = _rule_column(first, rule, columns, by_format=points.missing is None)
    wanted = [*columns, *displacements, *([] if rule_column is None else [rule_column])]
    ratings = [] if points.missing is not None or points.format is not None else _rating_columns(first, keys, wanted)
    refuse_many(len(paths), len(first.text.lines) - first.sample.first)
    frames: list[FrameRows] = []
    for number, path in enumerate(paths):
        table = first if number == 0 else _open_alike(path, points, first)
        frames += keys.frames(table, keys.rows(table, [*wanted, *ratings]), alone=len(paths) == 1)
    if len(frames) == 1:
        notes.append("one text file is one frame; where it holds several, give frame_column in [points]")
    values, matched = joined_tracks(frames, keys.track_name)
    n = len(columns)
    if points.columns is None and points.format is None:
        refuse_row_numbers(values[0, :, 0], first)
    finite = np.asarray(np.isfinite(values[:, :, :n]).all(axis=2))
    for number, column in enumerate(ratings, start=len(wanted)):
        name = first.sample.names[column]
        suggested = f"{name} {'>=' if marks_hidden(name) else '<'} 0.5"
        refuse_low_ratings(
            values[:, :, number],
            finite,
            key=name,
            where=f"{first.text.path} has a column '{quoted(name)}'",
            cure=f'missing = "{quoted(suggested)}" in [points], or missing = "{NONE}"',
            none="missing",
        )
    return Measured(
        positions=values[:, :, :n],
        times=keys.split_times(frames),
        time_heading=keys.time_heading,
        units=_units(first, [*columns, *displacements]),
        displacements=values[:, :, n : 2 * n] if displacements else None,
        by_format=points.format is not None,
        rule_values=None if rule_column is None else values[:, :, len(wanted) - 1],
        unused_displacements=() if displacements else _unused_displacements(first, columns),
        headings=tuple(first.sample.names),
        names=[frame.name for frame in frames],
        notes=[*notes, *matched],
    )


def missing_rule(points: PointFiles) -> MissingRule | None:
    """Return the rule that the user gives, or that of the format."""
    if points.missing is None and points.format is not None:
        return DIC_FORMATS[points.format].missing
    return points.missing


def _open(path: Path, points: PointFiles, known: TextFormat | None) -> TextTable:
    columns = DIC_FORMATS[points.format].columns if points.format is not None else points.columns
    return TextTable.open(read_lines(path), columns=columns, given=(points.separator, points.decimal), known=known)


def _open_alike(path: Path, points: PointFiles, first: TextTable) -> TextTable:
    """Return a further file; its heading must be that of the first."""
    table = _open(path, points, first.sample.format)
    by_comment = table.sample.commented and first.sample.commented
    if table.sample.names != first.sample.names and not by_comment:
        raise RecordingError(
            f"{path} has the heading '{quoted(', '.join(table.sample.names)) or 'none'}', {first.text.path.name} has "
            f"'{quoted(', '.join(first.sample.names)) or 'none'}': the columns of all frames must be the same."
        )
    return table


def _units(table: TextTable, columns: list[Column]) -> frozenset[str]:
    """Return the units of length that the headings of columns, or the line below, state."""
    sample = table.sample
    numbers = column_numbers(sample, columns, str(table.text.path))
    below = [f"x [{sample.units[number].strip('[]() ')}]" for number in numbers] if sample.units else []
    return stated_units([*(sample.names[number] for number in numbers if sample.names), *below])


def _position_columns(table: TextTable, points: PointFiles, keys: RowKeys) -> tuple[list[Column], list[str]]:
    """Return the columns of x, y and z, and notes where the heading decided it."""
    if points.format is not None:
        return list(DIC_FORMATS[points.format].columns), []
    if points.columns is not None:
        return list(points.columns), []
    columns, notes = guessed_columns(table, keys)
    return [*columns], notes


def _rating_columns(table: TextTable, keys: RowKeys, used: list[Column]) -> list[int]:
    """Return the columns of numbers whose headings may say which points are seen, and which nothing uses."""
    sample = table.sample
    taken = {*keys.columns, *column_numbers(sample, used, str(table.text.path))}
    likely = [number for number, name in enumerate(sample.names) if number not in taken and rates_points(name)]
    readable = sample.format.readable
    return [number for number in likely if all(readable(row[number]) for row in sample.rows if len(row) > number)]


def _displacement_columns(table: TextTable, points: PointFiles) -> list[Column]:
    if points.format is None:
        return list(points.displacements or ())
    plain = {plain_heading(name) for name in table.sample.names}
    columns = DIC_FORMATS[points.format].displacements
    return list(columns) if {plain_heading(column) for column in columns} <= plain else []


def _rule_column(
    table: TextTable, rule: MissingRule | None, columns: list[Column], *, by_format: bool
) -> Column | None:
    """Return the column of the rule: a number, a heading, or x, y or z; None for none."""
    if rule is None or rule.column is None:
        return None
    plain = [plain_heading(name) for name in table.sample.names]
    if plain_heading(rule.column) in plain:
        return rule.column
    if by_format:
        return None
    if rule.column in AXES[: len(columns)]:
        return columns[AXES.index(rule.column)]
    return int(rule.column) if rule.column.isdecimal() and rule.column.isascii() else rule.column


def _unused_displacements(table: TextTable, columns: list[Column]) -> tuple[str, ...]:
    plain = [plain_heading(name) for name in table.sample.names]
    axes = AXES[: len(columns)]
    named = [
        [name for name in table.sample.names if "disp" in name.lower() and plain_heading(name).endswith(axis)]
        for axis in axes
    ]
    for headings in DISPLACEMENT_HEADINGS:
        wanted = [plain_heading(heading) for heading in headings[: len(columns)]]
        if all(plain.count(name) == 1 for name in wanted):
            return tuple(table.sample.names[plain.index(name)] for name in wanted)
    return tuple(names[0] for names in named) if all(len(names) == 1 for names in named) else ()
