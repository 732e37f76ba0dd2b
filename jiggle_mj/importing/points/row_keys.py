"""Which columns of a text table number the frames, give their times and name the points of its rows."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ...errors import RecordingError
from ..data_folder import quoted
from .headings import frame_columns, plain_heading, time_columns, track_column
from .missing_rule import AXES
from .points_table import NONE, PointFiles
from .text_format import column_numbers
from .text_table import TextTable
from .tracks import FrameRows, split_frames

Column = int | str


@dataclass(frozen=True, kw_only=True)
class RowKeys:
    """Columns that say what a row is; those of the first file hold for all."""

    frame: tuple[int, ...]
    """Columns that may number the frames, the likelier first."""
    times: int | None
    """Column of the frames' times; None for none."""
    time_heading: str | None
    """Heading that says that it gives times, whether they are read or not; None for none."""
    track: int | None
    """Column that names the points; None for none."""
    names: tuple[str, ...]
    """Heading of each column."""

    @classmethod
    def of(cls, table: TextTable, points: PointFiles) -> "RowKeys":
        """Return the columns that the user gives, else those that the heading names.

        Raises:
            RecordingError: a column that the user gives is missing.
        """
        sample = table.sample
        plain = {plain_heading(name) for name in sample.names}
        headed = sample.names if plain.issuperset(AXES) or not sample.commented else []  # a comment may be prose

        def given(column: Column | None) -> list[int]:
            return [] if column in (None, NONE) else column_numbers(sample, [column], str(table.text.path))

        time_heads = time_columns(headed)
        frame = [*frame_columns(headed), *time_heads] if points.frame_column is None else given(points.frame_column)
        track = track_column(headed) if points.track_column is None else next(iter(given(points.track_column)), None)
        times = given(points.times)
        return cls(
            frame=(*frame, *(column for column in times if column not in frame)),
            times=times[0] if times else None,
            time_heading=headed[time_heads[0]] if time_heads else None,
            track=track,
            names=tuple(sample.names or (f"column {number}" for number in range(table.width))),
        )

    @property
    def columns(self) -> set[int]:
        """Return all columns that are no coordinates."""
        return {*self.frame, *([] if self.track is None else [self.track])}

    @property
    def track_name(self) -> str | None:
        """Return the heading of the column that names the points; None for none."""
        return None if self.track is None else self.names[self.track]

    def rows(self, table: TextTable, columns: list[Column]) -> FrameRows:
        """Return the rows of a file; the time of a row is its last value where there are times."""
        return FrameRows(
            name=table.text.path.name,
            values=table.read([*columns, *([] if self.times is None else [self.times])]),
            ids=None if self.track is None else table.names_of(self.track),
        )

    def frames(self, table: TextTable, rows: FrameRows, *, alone: bool) -> list[FrameRows]:
        """Return the frames of a file: all of them where it is the only file and numbers them, else one.

        Raises:
            RecordingError: one file of several holds several frames, or a number of a frame is none.
        """
        for column in self.frame:
            labels = table.names_of(column)
            if len(set(labels)) < 2:
                continue
            heading = quoted(self.names[column])
            if not alone and self.names[column] == self.time_heading and not _rise(labels):
                continue  # a value of each point that is headed t, such as its temperature
            if not alone:
                raise RecordingError(
                    f"{rows.name} has several values in the column '{heading}', and there are further files: give one "
                    'file of all frames, or a file for each frame; or frame_column = "none" in [points] if each file '
                    "is one frame."
                )
            return split_frames(rows, _numbers(labels, f"{rows.name}: the column '{heading}'"), heading)
        return [rows]

    def split_times(self, frames: list[FrameRows]) -> Float[np.ndarray, " t"] | None:
        """Return the time of each frame; None where there are none.

        Raises:
            RecordingError: the rows of a frame differ in their time.
        """
        if self.times is None:
            return None
        for frame in frames:
            if len(np.unique(frame.values[:, -1])) != 1:
                raise RecordingError(f"{frame.name} has several times in '{quoted(self.names[self.times])}'.")
        return np.array([frame.values[0, -1] for frame in frames])


def _rise(labels: list[str]) -> bool:
    """Return whether labels are numbers that never fall, as the times of rows in turn."""
    try:
        return bool((np.diff([float(label) for label in labels]) >= 0).all())
    except ValueError:
        return False


def _numbers(labels: list[str], where: str) -> Float[np.ndarray, " n"]:
    try:
        return np.array([float(label) for label in labels])
    except ValueError as failure:
        raise RecordingError(f"{where} must hold numbers, by which frames are ordered: {quoted(failure)}.") from failure
