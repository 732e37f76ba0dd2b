"""Rows of text tables become frames of tracks: by a column that numbers the frames, and one that names the points."""

from collections import Counter
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from jaxtyping import Float

from ...errors import RecordingError
from ..data_folder import quoted
from .cells import is_unseen
from .file_kinds import refuse_many


@dataclass(frozen=True, kw_only=True)
class FrameRows:
    """Rows of one frame."""

    name: str
    """Name of the frame, for messages."""
    values: Float[np.ndarray, "n c"]
    """Columns that are read."""
    ids: list[str] | None
    """Name of each row's point; None where rows have none."""


def split_frames(rows: FrameRows, numbers: Float[np.ndarray, " n"], heading: str) -> list[FrameRows]:
    """Return the frames of a table that holds all of them, in the order of their numbers or times.

    Args:
        rows: all rows.
        numbers: number or time of each row's frame.
        heading: heading of the numbers, for messages.

    Raises:
        RecordingError: a number is missing, or every frame has one row.
    """
    if not np.isfinite(numbers).all():
        row = int(np.flatnonzero(~np.isfinite(numbers))[0])
        raise RecordingError(f"{rows.name}: row {row} (from 0) has no number in the column '{quoted(heading)}'.")
    values, first = np.unique(numbers, return_inverse=True)
    if len(values) == len(numbers):
        raise RecordingError(
            f"{rows.name} has one row for each value of '{quoted(heading)}': a table of all frames has a row for each "
            'point of each frame; save others as .npz. If it is one frame, give frame_column = "none" in [points].'
        )
    in_turn = np.split(np.argsort(first, kind="stable"), np.cumsum(np.bincount(first))[:-1])
    return [
        FrameRows(
            name=f"{rows.name} {quoted(heading)} {value:.15g}",
            values=rows.values[which],
            ids=None if rows.ids is None else [rows.ids[row] for row in which],
        )
        for value, which in zip(values, in_turn, strict=True)
    ]


def joined_tracks(frames: list[FrameRows], heading: str | None) -> tuple[Float[np.ndarray, "t n c"], list[str]]:
    """Return the values with one row a point, NaN where a frame lacks it, and notes.

    Points are in the order in which they first appear. Without names, row i is the same point in every frame.

    Args:
        frames: in the order of time.
        heading: heading of the points' names; None for none.

    Raises:
        RecordingError: a frame names a point twice, no point is in two frames, or frames without names differ in their
            number of rows.
    """
    if heading is None or any(frame.ids is None for frame in frames):
        _refuse_lengths(frames)
        return np.stack([frame.values for frame in frames]), []
    if all(frame.ids == frames[0].ids for frame in frames):
        return np.stack([frame.values for frame in frames]), []
    named = [_without_nameless(frame) for frame in frames]
    ids = [frame.ids or [] for frame in named]
    order = {name: row for row, name in enumerate(dict.fromkeys(chain.from_iterable(ids)))}
    for frame, names in zip(named, ids, strict=True):
        if len(set(names)) < len(names):
            twice = next(name for name, count in Counter(names).items() if count > 1)
            raise RecordingError(
                f"{frame.name} has the {quoted(heading)} '{quoted(twice)}' in several rows: {_CURE.format('names')}"
            )
    if len(frames) > 1 and len(order) == sum(map(len, ids)):
        raise RecordingError(
            f"no {quoted(heading)} is in two frames, so that nothing is tracked: {_CURE.format('counts')}"
        )
    refuse_many(len(frames), len(order))
    values = np.full((len(frames), len(order), frames[0].values.shape[1]), np.nan)
    for number, (frame, names) in enumerate(zip(named, ids, strict=True)):
        values[number, [order[name] for name in names]] = frame.values
    left_out = sum(len(frame.values) for frame in frames) - sum(map(len, ids))
    notes = [f"points are matched between frames by the column '{quoted(heading)}'; row i is the i-th that appears"]
    return values, [*notes, *([f"{left_out} rows without '{quoted(heading)}' are left out"] if left_out else [])]


_CURE = (
    'it must name one point, the same in all frames. If it {} something else, give track_column = "none" in [points] '
    "(row i is then the same point in every frame), or the column that names the points."
)


def _without_nameless(frame: FrameRows) -> FrameRows:
    """Return the rows whose point has a name."""
    ids = frame.ids or []
    kept = [row for row, name in enumerate(ids) if not is_unseen(name)]
    return replace(frame, values=frame.values[kept], ids=[ids[row] for row in kept])


def _refuse_lengths(frames: list[FrameRows]) -> None:
    for frame in frames:
        if len(frame.values) != len(frames[0].values):
            raise RecordingError(
                f"the frames differ in their number of points: {frames[0].name} has {len(frames[0].values)} rows, "
                f"{frame.name} has {len(frame.values)}; row i must be the same point in every frame, empty or nan "
                "where it is lost, or a column must name the points: track_column in [points]."
            )
