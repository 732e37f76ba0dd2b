"""What the files of frames hold, before units: positions, displacements and further columns, all frames first."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Shaped

from ...errors import RecordingError


@dataclass(frozen=True, kw_only=True)
class PointFrames:
    """Tracked points of all frames."""

    positions: Float[np.ndarray, "t n 3"]
    """Positions in the unit of the data; NaN where a point was not seen."""
    times: Shaped[np.ndarray, " t"] | None
    """Times of the frames in the unit of the data, as they are stored; None for none."""
    time_heading: str | None
    """Heading of the column of a text table that gives the frames' times; None for none."""
    units: frozenset[str]
    """Units of length that headings or names of arrays state, of `headings.LENGTHS`."""
    names: list[str]
    """Name of each frame, for messages."""
    notes: list[str]
    """What the reader assumed or found, a line each."""


@dataclass(frozen=True, kw_only=True)
class Measured:
    """Contents of the files of frames."""

    positions: Float[np.ndarray, "t n c"]
    """Positions in space, or in a plane."""
    times: Shaped[np.ndarray, " t"] | None = None
    """Times of the frames in the unit of the data, as they are stored; None for none."""
    time_heading: str | None = None
    """Heading of the column of a text table that gives the frames' times; None for none."""
    units: frozenset[str] = frozenset()
    """Units of length that headings or names of arrays state, of `headings.LENGTHS`."""
    displacements: Float[np.ndarray, "t n c"] | None = None
    """Displacements that the user, or the format, names; None for none."""
    by_format: bool = False
    """Whether the format names them: then they are added where the positions are those of the reference alone."""
    rule_values: Float[np.ndarray, "t n"] | None = None
    """Values of the column of the rule `missing`; None where it has none."""
    seen: Bool[np.ndarray, "t n"] | None = None
    """Which points a visibility array says are seen; None without one."""
    unused_displacements: tuple[str, ...] = ()
    """Columns or arrays that seem to hold displacements, which nobody named."""
    headings: tuple[str, ...] = ()
    """Columns or arrays beside the positions, for errors."""
    names: list[str]
    """Name of each frame, for messages."""
    notes: list[str]
    """What the reader assumed or found, a line each."""


def displaced(measured: Measured) -> Float[np.ndarray, "t n c"]:
    """Return the positions with the displacements added.

    Raises:
        RecordingError: the positions move by the displacements already; or nothing moves, and there are displacements
            that nobody named.
    """
    positions, given = measured.positions, measured.displacements
    moves = _moves(positions)
    if given is None:
        if measured.unused_displacements and not moves and len(positions) > 1:
            names = [f'"{name}"' for name in measured.unused_displacements]
            listed = names[0] if len(names) == 1 else f"[{', '.join(names)}]"
            raise RecordingError(
                f"nothing moves in {len(positions)} frames, {measured.names[0]} to {measured.names[-1]}: the "
                f"positions are those of the reference. The file has displacements: give displacements = "
                f"{listed} in [points]."
            )
        return positions
    if measured.by_format:
        return positions if moves else positions + given
    if moves and _moves_by(positions, given):
        raise RecordingError(
            "the positions move by the displacements already, so that these would count twice: leave displacements out."
        )
    return positions + given


def in_space(positions: Float[np.ndarray, "t n c"]) -> Float[np.ndarray, "t n 3"]:
    """Return positions with z = 0 where they have two coordinates; a point without one of them is unseen."""
    if positions.shape[2] == 2:
        positions = np.concatenate([positions, np.zeros((*positions.shape[:2], 1))], axis=2)
    return np.where(np.isfinite(positions).all(axis=2, keepdims=True), positions, np.nan)


def is_planar(positions: Float[np.ndarray, "t n 3"]) -> bool:
    """Return whether z is 0 everywhere, as it is for points of two coordinates."""
    return not np.nan_to_num(positions[:, :, 2]).any()


def _moves(positions: Float[np.ndarray, "t n c"]) -> bool:
    """Return whether any point is at two places."""
    first = positions[0]
    both = np.isfinite(positions) & np.isfinite(first)
    return bool((both & (positions != first)).any())


def _moves_by(positions: Float[np.ndarray, "t n c"], given: Float[np.ndarray, "t n c"]) -> bool:
    """Return whether the motion from the first frame is nearer to the displacements than to none."""
    with np.errstate(over="ignore", invalid="ignore"):  # absurd coordinates are refused later, by name
        motion, said = positions - positions[0], given - given[0]
        both = np.isfinite(motion).all(axis=2) & np.isfinite(said).all(axis=2)
        return bool(np.square((motion - said)[both]).sum() < 0.5 * np.square(motion[both]).sum())
