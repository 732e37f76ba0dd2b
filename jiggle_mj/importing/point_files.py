"""Reading tracked points, rows and triangles from the files of measured data.

Row i is the same material point in every frame. Applies no units: see `folder`.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from ..errors import RecordingError
from .data_folder import DataFolder, quoted
from .points.array_frames import read_array_frames
from .points.file_kinds import FileKind, file_kind
from .points.frame_order import frame_files
from .points.increment_doubts import doubt_increments
from .points.measured import Measured, PointFrames, displaced, in_space
from .points.mesh_frames import read_mesh_frames
from .points.points_table import PointFiles
from .points.text_frames import missing_rule, read_text_frames
from .points.text_lines import read_text
from .points.unseen import MarkCheck
from .recording_toml import Rows


def read_frames(folder: DataFolder, points: PointFiles) -> PointFrames:
    """Return all frames in the order of time.

    Raises:
        RecordingError: a file is missing, malformed, outside the folder or too large, the frames differ in their number
            of points, or coordinates stand for lost points without a rule that says so.
    """
    paths, notes = frame_files(folder, points.files)
    kinds = {file_kind(path): path for path in reversed(paths)}
    kind = file_kind(paths[0])
    if len(kinds) > 1:
        other = next(path for each, path in kinds.items() if each != kind)
        raise RecordingError(f"{paths[0].name} and {other.name} are files of different kinds; frames need one kind.")
    measured = _read(paths, kind, points)
    given = displaced(measured)
    positions = in_space(given)
    if measured.positions.shape[2] == 2:
        notes.append("points have two coordinates: they lie in the plane z = 0")
    positions = _without_unseen(positions, measured, points)
    if given is not measured.positions:
        notes += doubt_increments(positions)
    return PointFrames(
        positions=positions,
        times=measured.times,
        time_heading=measured.time_heading,
        units=measured.units,
        names=measured.names,
        notes=[*notes, *measured.notes],
    )


def _read(paths: list[Path], kind: FileKind, points: PointFiles) -> Measured:
    if kind == "text":
        return read_text_frames(paths, points)
    if points.frame_column is not None or points.track_column is not None:
        raise RecordingError(
            f"[points] frame_column and track_column are for text files; {paths[0].name} is read as {kind}."
        )
    if points.times is not None and kind not in ("npz", "mat"):
        raise RecordingError(f"[points] times is for .npz, .mat and text files; {paths[0].name} is read as {kind}.")
    if kind in ("ply", "obj", "pcd"):
        return read_mesh_frames(paths, kind, points)
    return read_array_frames(paths, points)


def _without_unseen(
    positions: Float[np.ndarray, "t n 3"], measured: Measured, points: PointFiles
) -> Float[np.ndarray, "t n 3"]:
    """Return positions with NaN where a rule or an array says that a point was not seen."""
    unseen = np.zeros(positions.shape[:2], bool)
    rule = missing_rule(points)
    if rule is not None:
        reference = in_space(measured.positions)
        unseen |= rule.unseen_by_place(positions) | rule.unseen_by_place(reference)
        if measured.rule_values is not None:
            unseen |= rule.unseen_by_value(measured.rule_values)
    if measured.seen is not None:
        unseen |= ~measured.seen
    positions = np.where(unseen[:, :, np.newaxis], np.nan, positions)
    check = MarkCheck(names=measured.names, headings=measured.headings)
    check.refuse_far(positions)
    if points.missing is None or points.missing.place is not None or points.missing.column is not None:
        check.refuse_marks(positions)
        measured.notes.extend(check.doubted_rows(positions))
    return positions


def read_rows(folder: DataFolder, rows: Rows, n_points: int, where: str) -> Int[np.ndarray, " r"]:
    """Return row numbers, counted from 0.

    Raises:
        RecordingError: the file is missing or holds no numbers, or a number is not that of a row.
    """
    numbers: list[int] = list(rows.rows)
    if rows.file is not None:
        path = folder / rows.file
        if file_kind(path) != "text":
            raise RecordingError(f"{path} must be text that holds row numbers.")
        words = read_text(path).replace(",", " ").replace(";", " ").split()
        wrong_word = next((word for word in words if not word.isdecimal() or len(word) > 9), None)
        if wrong_word is not None:
            raise RecordingError(f"{path} must hold whole numbers; it holds '{quoted(wrong_word)}'.")
        numbers = [int(word) for word in words]
    wrong = [number for number in numbers if not 0 <= number - rows.first < n_points]
    if wrong or not numbers:
        raise RecordingError(
            f"{where} names row {quoted(wrong[0]) if wrong else 'none'}; rows are numbered "
            f"{rows.first}..{rows.first + n_points - 1} (the first row is {rows.first})."
        )
    return np.unique(np.array(numbers) - rows.first)
