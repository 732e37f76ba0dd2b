"""Text tables of points: rows of one length, some of whose columns are numbers."""

from array import array
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ...errors import RecordingError
from ..data_folder import quoted
from .cells import is_number, parse_cell
from .text_format import Sample, TextFormat, column_numbers, find_format, take_sample
from .text_lines import TextLines


@dataclass(frozen=True, kw_only=True)
class TextTable:
    """Columns of a text table."""

    text: TextLines
    """The file's lines."""
    sample: Sample
    """Format, heading and first rows."""

    @classmethod
    def open(
        cls,
        text: TextLines,
        *,
        columns: Sequence[int | str] | None,
        given: tuple[str | None, str | None],
        known: TextFormat | None,
    ) -> "TextTable":
        """Find the format of a file.

        Args:
            text: the file's lines.
            columns: columns that must hold numbers, by number or heading; None for the first.
            given: separator and decimal mark, each None where it is to be found.
            known: format of the other frames; None for the first.

        Raises:
            RecordingError: the file is no table, or can be read in more than one way.
        """
        sample = find_format(text, columns=columns, given=given) if known is None else take_sample(text, known)
        return cls(text=text, sample=sample)

    @property
    def width(self) -> int:
        """Return the number of columns."""
        return len(self.sample.rows[0])

    def read(self, columns: Sequence[int | str]) -> Float[np.ndarray, "n c"]:
        """Return columns, by number or heading; NaN for cells without a number.

        Raises:
            RecordingError: a column is missing, a row has another length, or a cell holds other text.
        """
        path, fmt = self.text.path, self.sample.format
        numbers = column_numbers(self.sample, columns, str(path))
        if max(numbers) >= self.width:
            line = self.text.lines[self.sample.first][0]
            raise RecordingError(
                f"{path} line {line} has {self.width} columns; columns {list(columns)} (from 0) are needed."
            )
        found = array("d")
        first_line = self.text.lines[self.sample.first][0]
        for line, content in self.text.lines[self.sample.first :]:
            cells = fmt.split(content)
            if len(cells) != self.width:
                raise RecordingError(
                    f"{path} line {line} has {len(cells)} columns, line {first_line} has {self.width}: all rows must "
                    "have as many; a lost point is an empty cell or nan."
                )
            try:
                found.extend(parse_cell(cells[number], fmt.decimal) for number in numbers)
            except ValueError as failure:
                raise RecordingError(
                    f"{path} line {line} holds text that is not a number ('{quoted(failure)}'), with decimal = "
                    f"'{fmt.decimal}'."
                ) from failure
        return np.array(found).reshape(-1, len(numbers))

    def names_of(self, column: int | str) -> list[str]:
        """Return what a column names: numbers without regard to how they are written, and other text as it is.

        The column must be one that `read` could split.
        """
        (number,) = column_numbers(self.sample, [column], str(self.text.path))
        fmt = self.sample.format
        cells = [fmt.split(content)[number] for _, content in self.text.lines[self.sample.first :]]
        return [f"{parse_cell(cell, fmt.decimal):.17g}" if is_number(cell, fmt.decimal) else cell for cell in cells]
