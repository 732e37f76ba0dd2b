"""Lines of a text file of any common encoding and line end, without comments."""

import codecs
import re
from dataclasses import dataclass
from pathlib import Path

from ...errors import RecordingError
from ..data_folder import quoted
from .cells import UNSEEN_WORDS

MAX_TEXT_BYTES = 3 * 10**7
"""Size above which a text file is refused [bytes]: a million points, read in some seconds."""
MAX_LINE_CHARACTERS = 10**5
"""Length above which a line is no row of a table."""
BOMS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF32_LE, "utf-32-le"),
    (codecs.BOM_UTF32_BE, "utf-32-be"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)
"""Marks of the encodings; that of UTF-32 begins with that of UTF-16."""
LINE_END = re.compile(r"\r\n|\r|\n")
"""Line ends of Windows, old Macs and Unix."""
COMMENT = re.compile(r"#|%|//|\*\*\*(?=\s|$)")
"""Beginning of a comment; DICe writes asterisks."""
EXCEL_SEPARATOR = re.compile(r'"?sep=.\s*"?', re.IGNORECASE)
"""A first line that tells Excel the separator, which is found here."""


@dataclass(frozen=True, kw_only=True)
class TextLines:
    """Lines of a file that are neither blank nor comments."""

    path: Path
    """The file."""
    lines: list[tuple[int, str]]
    """Number from 1 and text of each line, without blanks at its ends; tabs there are cells."""
    last_comment: str | None
    """Text of the last comment before the first line, without its sign; None for none."""


def read_lines(path: Path) -> TextLines:
    """Return the lines of a text file.

    Raises:
        RecordingError: the file cannot be read, is too large, is not text, or has a line that is too long.
    """
    lines: list[tuple[int, str]] = []
    comment: str | None = None
    for number, line in enumerate(LINE_END.split(read_text(path)), start=1):
        stripped = line.strip(" ")
        if len(stripped) > MAX_LINE_CHARACTERS:
            raise RecordingError(
                f"{path} line {number} has {len(stripped)} characters; a row of points has at most "
                f"{MAX_LINE_CHARACTERS}."
            )
        sign = COMMENT.match(stripped.lstrip())
        if sign and not _is_unseen_word(stripped):
            comment = stripped.lstrip()[sign.end() :].strip() if not lines else comment
        elif stripped.strip() and not (number == 1 and EXCEL_SEPARATOR.fullmatch(stripped)):
            lines.append((number, stripped))
    return TextLines(path=path, lines=lines, last_comment=comment)


def read_text(path: Path) -> str:
    """Return the text of a file: UTF-8, UTF-16 or UTF-32 by its mark, else UTF-8 or Windows' Latin alphabet.

    Raises:
        RecordingError: the file cannot be read, is too large, or is not text.
    """
    try:
        size = path.stat().st_size
        if size > MAX_TEXT_BYTES:
            raise RecordingError(
                f"{path} has {size} bytes of text; at most {MAX_TEXT_BYTES} are read: save the points as .npz."
            )
        data = path.read_bytes()
    except (OSError, ValueError) as failure:
        raise RecordingError(f"{quoted(path)} cannot be read as text: {quoted(failure)}.") from failure
    mark, encoding = next(((mark, name) for mark, name in BOMS if data.startswith(mark)), (b"", "utf-8"))
    try:
        text = data[len(mark) :].decode(encoding)
    except UnicodeDecodeError as failure:
        if mark:
            raise RecordingError(f"{path} is marked as {encoding}, but is not: {quoted(failure)}.") from failure
        text = data.decode("cp1252", "replace")
    if "\0" in text:
        raise RecordingError(
            f"{path} is not text: it holds bytes of 0. A binary file needs its own suffix; UTF-16 needs its mark (BOM)."
        )
    return text


def _is_unseen_word(line: str) -> bool:
    """Return whether what looks like a comment begins with a word for no number, as `#N/A` does."""
    return re.split(r"[\s,;]", line.lower(), maxsplit=1)[0].strip('"') in UNSEEN_WORDS
