"""Coordinates that stand for a lost point though nobody says so."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from ...errors import RecordingError
from ...plausibility.identity import JUMP, SAME_PLACE_M, PointIdentity, isolated
from ...plausibility.point_motion import spacing
from ..data_folder import quoted

MARK_VALUES = (0.0, 1.0, -1.0, -9.0, -99.0, -999.0, -9999.0, -99999.0, 999.0, 9999.0, 99999.0)
"""Coordinates that programs write for a point without any."""
MAX_COORDINATE = 1e9
"""Size above which a coordinate is a mark, whatever the unit: a thousand kilometres in mm."""
MAX_LISTED_ROWS = 5
"""How many rows an error lists."""


@dataclass(frozen=True, kw_only=True)
class MarkCheck:
    """Search for coordinates that stand for a lost point though nobody says so."""

    names: list[str]
    """Name of each frame, for errors."""
    headings: tuple[str, ...] = field(default=())
    """Columns or arrays beside the positions, offered in the error."""

    def refuse_far(self, positions: Float[np.ndarray, "t n 3"]) -> None:
        """Refuse positions that are too far away for any sheet, in any unit.

        Raises:
            RecordingError: such a position is there; names frame, rows and place.
        """
        far = np.asarray((np.abs(np.nan_to_num(positions)) > MAX_COORDINATE).any(axis=2))
        seen = np.isfinite(positions).all(axis=2)
        all_far = far.any(axis=1) & (far == seen).all(axis=1)
        if all_far.any():
            raise RecordingError(
                f"all points of {self.names[int(all_far.argmax())]} are more than {MAX_COORDINATE:g} from the origin, "
                "as coordinates of a map are: subtract one offset from all coordinates of all frames."
            )
        self._refuse_where(positions, far, "too far away for a point")

    def refuse_marks(self, positions: Float[np.ndarray, "t n 3"]) -> None:
        """Refuse positions that cannot be those of points.

        Two points cannot be at one place, nor jump to one at different times. A point that is at 0, 0, 0 or another
        usual mark in some frames alone has not moved there; one that is there in all of them, far from the sheet, was
        never found.

        Raises:
            RecordingError: such a position is there; names frame, rows and place.
        """
        for number, frame in enumerate(positions):
            rows, n_places = _shared_place(frame)
            if number == 0 and len(rows) > 2 and len(rows) == np.isfinite(frame).all(axis=1).sum():
                raise RecordingError(
                    f"all {len(rows)} points of {self.names[0]} are at exactly {_shown(frame[rows[0]])}: are these "
                    "displacements? Give the reference coordinates as points, and these as displacements in [points]."
                )
            if n_places > 1:
                raise RecordingError(
                    f"{self.names[number]} has {n_places} places with several points each, such as "
                    f"{_shown(frame[rows[0]])}: the coordinates are rounded (save more digits, or subtract a large "
                    'offset first), or it holds several frames; if it is right, give missing = "none" in [points].'
                )
            if len(rows):
                self._refuse(number, frame[rows[0]], rows, "two points cannot be at one place")
        marked = np.asarray(np.all(np.isin(positions, MARK_VALUES), axis=2))
        always = marked.all(axis=0)
        partly = marked & ~always
        jumped = partly & (_jump(positions) > _extent(positions))
        zero = np.asarray((positions == 0).all(axis=2))
        apart = spacing(positions[0])
        at_origin = partly & zero & ~marked[0] & (_step(positions) > JUMP * (apart or 0.0))
        self._refuse_where(positions, np.asarray(jumped | at_origin), "it is elsewhere in other frames")
        alone = always & isolated(positions[0], apart)
        self._refuse_where(positions, marked & alone, "it is there in every frame, far from all others")
        # As if the sheet were some metres large: its unit is not known here, and rounding grows with the numbers.
        size = _extent(positions) or 1.0
        metres = positions / size
        identity = PointIdentity(metres[0], spacing(metres[0]))
        for frame in metres:
            identity.add(frame)
        if identity.shared_place is not None:
            place, count = identity.shared_place
            there = np.asarray((np.abs(metres - place) <= SAME_PLACE_M).all(axis=2))
            self._refuse_where(positions, there, f"{count} points jump to it at different times")
        if identity.lost_coordinate is not None:
            axis, value, count = identity.lost_coordinate
            raise RecordingError(
                f"{count} points jump to {'xyz'[axis]} = {value * size:.6g} at different times, and keep the other "
                "coordinates: that stands for a lost one, such as a depth. Write nan there; if it is right, give "
                'missing = "none" in [points].'
            )

    def doubted_rows(self, positions: Float[np.ndarray, "t n 3"]) -> list[str]:
        """Return a line where rows are at a usual mark in every frame, while all others move."""
        still = (positions == positions[0]).all(axis=(0, 2))
        always = np.isin(positions[0], MARK_VALUES).all(axis=1) & still
        if not always.any() or (still & ~always).any():
            return []
        x, y, z = positions[0, always][0].tolist()
        return [
            f"rows {np.flatnonzero(always)[:MAX_LISTED_ROWS].tolist()} from 0 are at exactly ({x:g}, {y:g}, {z:g}) in "
            f"every frame, and no other point stands still: if they are lost, give missing = [{x:g}, {y:g}, {z:g}]"
        ]

    def _refuse_where(self, positions: Float[np.ndarray, "t n 3"], wrong: Bool[np.ndarray, "t n"], why: str) -> None:
        """Refuse the wrong positions of the first frame that has any."""
        frames, points = np.nonzero(wrong)
        if len(frames):
            rows = points[frames == frames[0]]
            self._refuse(int(frames[0]), positions[frames[0], rows[0]], rows, why)

    def _refuse(self, number: int, place: Float[np.ndarray, " 3"], rows: Int[np.ndarray, " r"], why: str) -> None:
        listed = ", ".join(str(row) for row in rows[:MAX_LISTED_ROWS]) + (
            ", ..." if len(rows) > MAX_LISTED_ROWS else ""
        )
        others = f" (the file has {quoted(', '.join(self.headings))})" if self.headings else ""
        raise RecordingError(
            f"{self.names[number]} has {len(rows)} point{'s' * (len(rows) > 1)} at exactly {_shown(place)}, rows "
            f"{listed} from 0: {why}. If that marks lost points, give missing = [{_shown(place)[1:-1]}] in [points], "
            f'or a rule as "COLUMN == -1"{others}; if it is right, missing = "none".'
        )


def _shown(place: Float[np.ndarray, " 3"]) -> str:
    return f"({', '.join(f'{value:.9g}' for value in place)})"


def _shared_place(frame: Float[np.ndarray, "n 3"]) -> tuple[Int[np.ndarray, " r"], int]:
    """Return the rows at the place that most points of a frame share exactly, and the number of shared places."""
    rows = np.flatnonzero(np.isfinite(frame).all(axis=1))
    if len(rows) < 2:
        return np.empty(0, np.int64), 0
    _, which, counts = np.unique(frame[rows], axis=0, return_inverse=True, return_counts=True)
    shared = rows[which.ravel() == counts.argmax()] if counts.max() > 1 else np.empty(0, np.int64)
    return shared, int((counts > 1).sum())


def _jump(positions: Float[np.ndarray, "t n 3"]) -> Float[np.ndarray, "t n"]:
    """Return the distance of each position from the median of its point's positions."""
    seen = np.isfinite(positions).all(axis=(0, 2))
    jump = np.zeros(positions.shape[:2])
    jump[:, seen] = np.linalg.norm(positions[:, seen] - np.median(positions[:, seen], axis=0), axis=2)
    return jump


def _step(positions: Float[np.ndarray, "t n 3"]) -> Float[np.ndarray, "t n"]:
    """Return how far each point goes to a frame; 0 to the first one, and where it was unseen before."""
    step = np.linalg.norm(np.diff(positions, axis=0, prepend=positions[:1]), axis=2)
    return np.nan_to_num(step)


def _extent(positions: Float[np.ndarray, "t n 3"]) -> float:
    """Return half the diagonal of the first frame's bounding box."""
    finite = positions[0][np.isfinite(positions[0]).all(axis=1)]
    return 0.5 * float(np.linalg.norm(np.ptp(finite, axis=0))) if len(finite) else 0.0
