"""Reading tracked points, rows and triangles from the text files and .npz archives of measured data.

Text: numbers in columns, separated by blanks, commas or semicolons; lines that begin with # or % are comments, and one
heading line is skipped. Row i is the same material point in every frame. Applies no units: see `folder`.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from ..errors import RecordingError
from .declaration import PointFiles, Rows


def read_frames(folder: Path, points: PointFiles) -> tuple[Float[np.ndarray, "t n 3"], list[str]]:
    """Return all frames in the order of time, in the unit of the data, and a name for each.

    Raises:
        RecordingError: a file is missing or malformed, or the frames differ in their number of points.
    """
    if points.key is not None:
        path = folder / points.files[0]
        frames = read_npz(path, points.key)
        if frames.ndim != 3 or frames.shape[2] != 3:
            raise RecordingError(f"{path}: {points.key} must have shape (frames, points, 3); it has {frames.shape}.")
        return frames.astype(float), [f"{path.name} frame {number}" for number in range(len(frames))]
    paths = [path for pattern in points.files for path in _matching(folder, pattern)]
    tables = [_columns(path, points.columns) for path in paths]
    for path, table in zip(paths, tables, strict=True):
        if len(table) != len(tables[0]):
            raise RecordingError(
                f"the frames differ in their number of points: {paths[0].name} has {len(tables[0])} rows, "
                f"{path.name} has {len(table)}; row i must be the same point in every file."
            )
    return np.stack(tables), [path.name for path in paths]


def read_faces(folder: Path, faces: str, *, npz: Path | None, first_vertex: int) -> Int[np.ndarray, "f 3"]:
    """Return triangles from an array of the points' .npz, or from a text file, with vertices counted from 0.

    Raises:
        RecordingError: the array or file is missing or malformed.
    """
    table = read_npz(npz, faces) if npz is not None else _columns(folder / faces, (0, 1, 2))
    if table.ndim != 2 or table.shape[1] != 3 or not np.array_equal(table, np.round(table)):
        raise RecordingError(f"faces '{faces}' must be three whole numbers a row; got shape {table.shape}.")
    return table.astype(np.int64) - first_vertex


def read_rows(folder: Path, rows: Rows, n_points: int, where: str) -> Int[np.ndarray, " r"]:
    """Return row numbers, counted from 0.

    Raises:
        RecordingError: the file is missing or holds no numbers, or a number is not that of a row.
    """
    numbers: list[int] = list(rows.rows)
    if rows.file is not None:
        path = folder / rows.file
        try:
            numbers = [int(word) for word in _read_text(path).replace(",", " ").split()]
        except ValueError as failure:
            raise RecordingError(f"{path} must hold whole numbers ({failure}).") from failure
    wrong = [number for number in numbers if not 0 <= number - rows.first < n_points]
    if wrong or not numbers:
        raise RecordingError(
            f"{where} names row {wrong[0] if wrong else 'none'}; rows are numbered "
            f"{rows.first}..{rows.first + n_points - 1} (the first row is {rows.first})."
        )
    return np.unique(np.array(numbers) - rows.first)


def read_npz(path: Path, key: str) -> np.ndarray:
    """Return one array of an archive.

    Raises:
        RecordingError: the file is missing or no archive, or has no such array.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            if key not in archive.files:
                raise RecordingError(f"{path} has no array '{key}'; it has {', '.join(archive.files)}.")
            return archive[key]
    except (OSError, ValueError, EOFError, AttributeError) as failure:
        raise RecordingError(f"{path} cannot be read as .npz: {failure}.") from failure


def _matching(folder: Path, pattern: str) -> list[Path]:
    if not any(mark in pattern for mark in "*?["):
        return [folder / pattern]
    paths = sorted(folder.glob(pattern))
    if not paths:
        raise RecordingError(f"{folder} holds no file that matches '{pattern}'.")
    return paths


def _columns(path: Path, columns: tuple[int, ...]) -> Float[np.ndarray, "n c"]:
    table: list[list[float]] = []
    for number, line in enumerate(_read_text(path).splitlines(), start=1):
        words = line.replace(",", " ").replace(";", " ").split()
        if not words or words[0][0] in "#%":
            continue
        if len(words) <= max(columns):
            raise RecordingError(
                f"{path} line {number} has {len(words)} columns; columns {list(columns)} (from 0) are needed."
            )
        try:
            table.append([float(words[column]) for column in columns])
        except ValueError as failure:
            if table or number > 1:
                raise RecordingError(f"{path} line {number} holds text that is not a number ({failure}).") from failure
    if not table:
        raise RecordingError(f"{path} holds no rows of numbers.")
    return np.array(table)


def _read_text(path: Path) -> str:
    try:
        return path.read_text()
    except (OSError, UnicodeDecodeError) as failure:
        raise RecordingError(f"{path} cannot be read as text: {failure}.") from failure
