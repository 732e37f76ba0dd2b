"""Columns of x, y and z in a text table where the user names none: those of the heading, or the first three."""

import re

import numpy as np
from jaxtyping import Float

from ...errors import RecordingError
from ..data_folder import quoted
from ..units import PIXELS_ARE_NO_LENGTH
from .dic_formats import DIC_FORMATS
from .headings import plain_heading
from .missing_rule import AXES
from .row_keys import RowKeys
from .text_format import column_numbers
from .text_table import TextTable


def guessed_columns(table: TextTable, keys: RowKeys) -> tuple[list[int], list[str]]:
    """Return the columns of x, y and z, and notes where the heading decided it.

    Raises:
        RecordingError: the heading is that of a DIC export, names x and y alone, names them in other columns than the
            first three, or names what the first three are.
    """
    path, names = str(table.text.path), table.sample.names
    columns = column_numbers(table.sample, None, path)
    plain = [plain_heading(name) for name in names]
    if plain and [plain[column] for column in columns] == list(AXES):
        return columns, [] if columns == [0, 1, 2] else [f"x, y and z are columns {columns}, by the heading"]
    for name, known in DIC_FORMATS.items():
        if {plain_heading(column) for column in known.columns} <= set(plain):
            raise RecordingError(f'{path} has the headings of a DIC export: give format = "{name}".')
    flat = [names[plain.index(axis)] for axis in AXES[:2] if plain.count(axis) == 1]
    if len(flat) == 2 or table.width == 2:
        given = ", ".join(f'"{quoted(name)}"' for name in flat) if len(flat) == 2 else "0, 1"
        raise RecordingError(
            f"{path} has two coordinates, and no z: for a flat sheet, in the plane z = 0, give columns = [{given}] in "
            f"[points]; {PIXELS_ARE_NO_LENGTH}."
        )
    named = [] if table.sample.commented else _axis_columns(names)
    listed = quoted(", ".join(names))
    if named not in ([], [0, 1, 2]):
        given = ", ".join(f'"{quoted(names[column])}"' for column in named)
        raise RecordingError(
            f"{path} has the heading '{listed}', whose first three are not x, y and z: give columns = [{given}] in "
            "[points], or those that are."
        )
    if keys.columns & {0, 1, 2}:
        raise RecordingError(f"{path} has the heading '{listed}', which names no x, y and z: give columns in [points].")
    return [0, 1, 2], []


def refuse_row_numbers(first_column: Float[np.ndarray, " n"], table: TextTable) -> None:
    """Refuse a first column that counts the rows, where there are more than three and the user named none.

    Raises:
        RecordingError: it does.
    """
    count = np.arange(len(first_column))
    if table.width > 3 and len(count) > 2 and np.array_equal(first_column - first_column[0], count):
        raise RecordingError(
            f"{table.text.path}: the first of {table.width} columns counts the rows, and would be x: give columns = "
            "[1, 2, 3] in [points], or those of x, y and z."
        )


def _axis_columns(names: list[str]) -> list[int]:
    """Return the columns whose headings have x, y and z as a word, as `X-Achse`; empty where not one each has."""
    words = [set(re.findall(r"[^\W\d_]+", name.lower())) for name in names]
    found = [[column for column, each in enumerate(words) if axis in each] for axis in AXES]
    return [columns[0] for columns in found] if all(len(columns) == 1 for columns in found) else []
