"""Separator and decimal mark of a text table: those that a user gives, or the only ones that make it a table.

Every separator is tried with every decimal mark. One that gives rows of one length, with numbers in the columns that
are needed, is a reading of the file. A file of two readings is refused: no guess decides what a coordinate is.
"""

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace

from ...errors import RecordingError
from ..data_folder import quoted
from .cells import THOUSANDS, is_number, is_unseen, parse_cell
from .headings import are_units, plain_heading
from .missing_rule import AXES
from .text_lines import TextLines

BLANKS = " "
"""Separator that stands for any blanks and tabs."""
MARKS = (";", "\t", "|", ":", ",")
"""Separators that are a character of their own; blanks are tried where none of them is."""
SAMPLE_LINES = 1000
"""Lines by which a format is found; the reader then checks all of them."""
MIN_COLUMNS = 2
"""Columns of a table of points: those of a plane."""


@dataclass(frozen=True, kw_only=True)
class TextFormat:
    """How a line of a table is split, and its cells are read."""

    separator: str
    """Character between cells; a blank stands for blanks and tabs."""
    decimal: str
    """Decimal mark."""

    def split(self, line: str) -> list[str]:
        """Return the cells of a line; a quoted cell may hold the separator."""
        if '"' in line:
            single = line.replace("\t", " ") if self.separator == BLANKS else line
            reader = csv.reader([single.strip()], delimiter=self.separator, skipinitialspace=self.separator != "\t")
            return [cell.strip() for cell in next(reader, [])]
        if self.separator == BLANKS:
            return line.split()
        return [cell.strip() for cell in line.split(self.separator)]

    def readable(self, cell: str) -> bool:
        """Return whether a cell holds a number, or a word for none."""
        return is_number(cell, self.decimal) or is_unseen(cell)


@dataclass(frozen=True, kw_only=True)
class Sample:
    """Rows of a file's beginning in one format."""

    format: TextFormat
    """The format."""
    names: list[str]
    """Headings of the columns; empty where there are none that fit."""
    units: list[str]
    """Cells of the line of units below the heading; empty where there is none."""
    commented: bool = False
    """Whether the headings are those of a comment, which need not be a heading."""
    first: int
    """Position of the first row of numbers among the file's lines."""
    rows: list[list[str]]
    """Cells of each row."""


def take_sample(text: TextLines, fmt: TextFormat) -> Sample:
    """Return heading and first rows of a file in a format.

    A line that holds a number, or words for no number alone, is a row. Lines of words before the first row are a
    heading of the rows' length, a line of units, and text of other lengths.

    Raises:
        RecordingError: there are no rows, or a line before them is neither heading, nor units, nor text.
    """
    cells = [fmt.split(line) for _, line in text.lines[:SAMPLE_LINES]]
    first = next((number for number, row in enumerate(cells) if _is_row(row, fmt)), len(cells))
    if first == len(cells):
        raise RecordingError(f"{text.path} holds no rows of numbers.")
    if first == 0 and len(cells) > 1 and _is_numbering(cells[0], cells[1:]):
        return Sample(format=fmt, names=cells[0], units=[], first=1, rows=cells[1:])
    width, names, units = len(cells[first]), list[str](), list[str]()
    for number, row in enumerate(cells[:first]):
        if len(row) == width and names:
            if not are_units(row):
                line, content = text.lines[number]
                raise RecordingError(
                    f"{text.path} line {line} holds text that is not a number ('{quoted(content)}'), below a heading."
                )
            units = row
        elif len(row) == width:
            if len(set(row)) == 1:  # headings differ: this is a row, with a word for a lost point that is not known
                raise RecordingError(
                    f"{text.path} line {text.lines[number][0]} holds text that is not a number ('{quoted(row[0])}')."
                )
            names = row
        elif len(row) == width - 1 and number == first - 1 and not names:
            names = _shorter_heading(row, cells[first:])
    comment = fmt.split(text.last_comment) if not names and text.last_comment is not None else []
    commented = len(comment) == width and not any(is_number(cell, fmt.decimal) for cell in comment)
    return Sample(
        format=fmt,
        names=comment if commented else names,
        units=units,
        commented=commented,
        first=first,
        rows=cells[first:],
    )


def find_format(
    text: TextLines, *, columns: Sequence[int | str] | None, given: tuple[str | None, str | None]
) -> Sample:
    """Return the beginning of a file in the one format that makes it a table.

    Args:
        text: the file.
        columns: columns that must hold numbers, by number or heading; None for the first.
        given: separator and decimal mark, each None where it is to be found.

    Raises:
        RecordingError: no format makes the file a table, or more than one does.
    """
    separator, decimal = given
    separators = (*MARKS, BLANKS) if separator is None else (separator,)
    decimals = (".", ",") if decimal is None else (decimal,)
    formats = [TextFormat(separator=s, decimal=d) for s in separators for d in decimals]
    valid = [sample for fmt in formats if (sample := _valid(text, fmt, columns)) is not None]
    marked = [sample for sample in valid if sample.format.separator != BLANKS]
    valid = marked or valid
    if not valid:
        return take_sample(text, _likeliest(text, formats))
    numbers = {_numbers(sample, columns, text) for sample in valid}
    if len(numbers) > 1 or (decimal is None and _may_be_otherwise(valid[0])):
        number, line = text.lines[valid[0].first]
        raise RecordingError(
            f"{text.path}: line {number}, '{quoted(line)}', can be read "
            'in more than one way: give separator ("," ";" "|" ":" "tab" "blanks") and decimal ("." ",") in [points].'
        )
    return valid[0]


def _valid(text: TextLines, fmt: TextFormat, columns: Sequence[int | str] | None) -> Sample | None:
    """Return the sample where its rows have one length and numbers in the needed columns, else None."""
    # A separator may equal the decimal mark only within quotes.
    if fmt.separator == fmt.decimal and not any('"' in line for _, line in text.lines[:SAMPLE_LINES]):
        return None
    try:
        sample = take_sample(text, fmt)
        needed = column_numbers(sample, columns, str(text.path))
    except RecordingError:
        return None
    width = len(sample.rows[0])
    if any(len(row) != width for row in sample.rows) or width < max(MIN_COLUMNS, *(each + 1 for each in needed)):
        return None
    readable = all(fmt.readable(row[column]) for row in sample.rows for column in needed)
    return sample if readable else None


def _numbers(sample: Sample, columns: Sequence[int | str] | None, text: TextLines) -> tuple[str, ...]:
    """Return the numbers in the needed columns of a valid sample, as text so that NaN equals NaN."""
    needed = column_numbers(sample, columns, str(text.path))
    return tuple(str(parse_cell(row[column], sample.format.decimal)) for row in sample.rows for column in needed)


def column_numbers(sample: Sample, columns: Sequence[int | str] | None, where: str) -> list[int]:
    """Return the numbers of columns that are given by number or heading.

    Without any they are those headed x, y and z, or the first three.
    Headings are compared without regard to case, blanks at their ends and a unit in brackets.

    Raises:
        RecordingError: no heading, or more than one, has a given name.
    """
    plain = [plain_heading(name) for name in sample.names]
    if columns is None:
        headed = all(plain.count(axis) == 1 for axis in AXES)
        return [plain.index(axis) for axis in AXES] if headed else list(range(min(3, len(sample.rows[0]))))
    numbers = []
    for column in columns:
        if isinstance(column, str):
            found = [number for number, name in enumerate(plain) if name == plain_heading(column)]
            exact = [number for number in found if sample.names[number] == column]
            found = exact if len(exact) == 1 else found
            if len(found) != 1:
                raise RecordingError(
                    f"{where} has {len(found) or 'no'} columns headed '{quoted(column)}'; its heading is "
                    f"'{quoted(', '.join(sample.names)) or 'none'}'."
                )
            column = found[0]
        numbers.append(column)
    return numbers


def _is_row(cells: list[str], fmt: TextFormat) -> bool:
    return any(is_number(cell, fmt.decimal) for cell in cells) or all(is_unseen(cell) for cell in cells)


def _is_numbering(cells: list[str], rest: list[list[str]]) -> bool:
    """Return whether a first row only numbers the columns, as pandas writes where they have no names."""
    numbers = cells[1:] if cells[0] == "" else cells
    counts = len(numbers) >= MIN_COLUMNS and numbers == [str(number) for number in range(len(numbers))]
    return counts and any("." in cell for row in rest for cell in row)


def _shorter_heading(names: list[str], rows: list[list[str]]) -> list[str]:
    """Return headings for rows that are one cell longer: by an empty last cell, or by the row names of R."""
    return [*names, ""] if all(row and row[-1] == "" for row in rows) else ["", *names]


def _may_be_otherwise(sample: Sample) -> bool:
    """Return whether a decimal mark other than the sample's would give other numbers.

    Commas may separate thousands where every number with a comma could be such a one. Commas between whole numbers may
    be decimal marks where the cells pair up, a sign before the first of each pair alone.
    """
    cells = [cell for row in sample.rows for cell in row]
    if sample.format.decimal == ",":
        commas = [cell for cell in cells if "," in cell]
        return bool(commas) and all(THOUSANDS.fullmatch(cell) for cell in commas)
    width = len(sample.rows[0])
    if sample.format.separator != "," or sample.names or width % 2 or width < 2 * MIN_COLUMNS:
        return False
    return all(cell.lstrip("+-").isdigit() for cell in cells) and all(
        cell.isdigit() for row in sample.rows for cell in row[1::2]
    )


def _likeliest(text: TextLines, formats: list[TextFormat]) -> TextFormat:
    """Return the format by which a file that fits none is best described: the first mark that its last line holds."""
    line = text.lines[-1][1] if text.lines else ""
    found = [fmt for fmt in formats if fmt.separator != fmt.decimal and fmt.separator in line]
    best = found[0] if found else replace(formats[-1], decimal=formats[0].decimal)
    return best
