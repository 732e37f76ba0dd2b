"""Arrays beside the positions that say which points are seen: those that the user names, and those that nobody does."""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Shaped

from ...errors import RecordingError
from ..data_folder import quoted
from .archives import read_array
from .points_table import DEFAULT_VISIBILITY_THRESHOLD, NONE, PointFiles
from .rating_names import marks_hidden, rates_points

MAX_LISTED = 5
"""How many arrays a note lists."""
NEGATED = re.compile(r"not\s+(.+)")
"""A visibility that is the opposite of an array."""


def as_visibility(key: str) -> str:
    """Return an array as the key `visibility` names it: as its opposite where it marks the points that are not seen."""
    return f"not {key}" if marks_hidden(key) else key


def named_visibility(
    path: Path, points: PointFiles, shape: tuple[int, int], *, swapped: bool
) -> tuple[Bool[np.ndarray, "t n"] | None, list[str]]:
    """Return which points the array that the user names says are seen, and in words how it was read; None for none.

    Args:
        path: the archive.
        points: what the user says.
        shape: number of frames and of points.
        swapped: whether the positions have their points first; decides where both orders fit.

    Raises:
        RecordingError: the array is missing, has another shape or other values, or its name says the opposite.
    """
    if points.visibility in (None, NONE):
        return None, []
    negation = NEGATED.fullmatch(points.visibility)
    key = negation[1] if negation else points.visibility
    if negation is None and marks_hidden(key):
        raise RecordingError(
            f'[points] visibility = "{quoted(key)}" names an array of the points that are not seen: give visibility = '
            f'"not {quoted(key)}", or rename the array if 1 is seen.'
        )
    values, name = _values(read_array(path, key), f"{path}: {key}", shape, swapped), f"{path}: {key}"
    seen, how = _seen(values, name, points.visibility_threshold, hidden=negation is not None)
    if negation is not None:
        seen, how = ~seen & ~_nan(values), f"{how}, and taken as its opposite"
    return seen, [f"{key}: {how}; {int((~seen).sum())} are unseen"]


def refuse_unnamed_visibility(
    path: Path,
    arrays: Mapping[str, tuple[int, ...]],
    positions: Float[np.ndarray, "t n c"],
    *,
    swapped: bool,
) -> list[str]:
    """Refuse an array that nobody names and that seems to say that points with a position are not seen.

    Args:
        path: the archive.
        arrays: name and shape of each array that is not used.
        positions: the points.
        swapped: whether the positions have their points first.

    Returns:
        A note for each array of such a name that has another shape, and one that lists those of another name that vary
        from point to point and frame to frame.

    Raises:
        RecordingError: an array of truth values, or with such a name, has one value for each frame and point, and some
            do not mean seen, or cannot be judged.
    """
    notes: list[str] = []
    unread: list[str] = []
    finite, shape = np.asarray(np.isfinite(positions).all(axis=2)), (positions.shape[0], positions.shape[1])
    wanted = tuple(length for length in shape if length != 1)
    for key, given in arrays.items():
        sizes, likely = tuple(length for length in given if length != 1), rates_points(key)
        if sizes not in (wanted, wanted[::-1]) or len(sizes) < 2:
            notes += [f"{quoted(key)} {given} has no value for each frame and point, and is not used"] * likely
            continue
        array = read_array(path, key)
        if not likely and array.dtype.kind != "b":
            unread += [f"{quoted(key)} {given}"] * bool((array != array.flat[0]).any())
            continue
        values = _values(array, f"{path}: {key}", shape, swapped=swapped)
        cure = f'visibility = "{quoted(as_visibility(key))}" in [points], or visibility = "none"'
        refuse_low_ratings(
            values, finite, key=key, where=f"{path} has an array {quoted(key)} {given}", cure=cure, none="visibility"
        )
    if unread:
        name = unread[0].partition(" (")[0]
        notes.append(
            f"{', '.join(unread[:MAX_LISTED])}{', ...' if len(unread) > MAX_LISTED else ''}: one value for each frame "
            f'and point, not used. If one rates the points, give visibility = "{name}" in [points] for a probability, '
            f'else missing = "{name} < NUMBER", or ">"'
        )
    return notes


def refuse_low_ratings(
    values: Shaped[np.ndarray, "t n"],
    finite: Bool[np.ndarray, "t n"],
    *,
    key: str,
    where: str,
    cure: str,
    none: str,
) -> None:
    """Refuse values that nobody uses, and that say that points with a position are not seen, or may say so.

    Args:
        values: one for each frame and point.
        finite: which points have a position.
        key: name of the values, which says whether they are high where a point is seen.
        where: what holds them, for the message.
        cure: what uses them.
        none: key whose value `NONE` says that they mean something else.

    Raises:
        RecordingError: such a value is there.
    """
    if not _in_unit_range(values):
        if len(np.unique(values[np.isfinite(values)])) < 2:
            return
        rule = f"{quoted(key)} {_sign(marks_hidden(key))} NUMBER"
        raise RecordingError(
            f"{where} with values from {np.nanmin(values):.3g} to {np.nanmax(values):.3g}, which seems to rate "
            f'the points: give missing = "{rule}" in [points] for lost ones, or {none} = "{NONE}".'
        )
    high = np.nan_to_num(values, nan=0.0) >= DEFAULT_VISIBILITY_THRESHOLD
    unseen = _nan(values) | (high if marks_hidden(key) else ~high)
    if (unseen & finite).any():
        raise RecordingError(f"{where}, which seems to say which points are seen, and not all are: give {cure}.")


def _values(
    array: Shaped[np.ndarray, "..."], name: str, shape: tuple[int, int], swapped: bool
) -> Shaped[np.ndarray, "t n"]:
    """Return an array with one value for each frame and point, whatever its order and axes of length 1."""
    flat = array
    while flat.ndim > 2 and 1 in (flat.shape[0], flat.shape[-1]):
        flat = flat[..., 0] if flat.shape[-1] == 1 else flat[0]
    fits = {flat.shape == shape: flat, flat.shape == shape[::-1]: flat.T}
    if flat.ndim != 2 or True not in fits:
        raise RecordingError(
            f"{name} has shape {array.shape}; visibility needs one value for each of {shape[0]} frames and {shape[1]} "
            "points."
        )
    return flat.T if swapped and flat.shape == shape[::-1] else fits[True] if shape[0] != shape[1] else flat


def _seen(
    values: Shaped[np.ndarray, "t n"], name: str, threshold: float, *, hidden: bool
) -> tuple[Bool[np.ndarray, "t n"], str]:
    """Return where values say that a point is seen, or hidden, and in words how that was read."""
    if values.dtype.kind == "b":
        return values, "true is seen"
    if not _in_unit_range(values):
        raise RecordingError(
            f"{name} holds values from {np.nanmin(values):.3g} to {np.nanmax(values):.3g}; visibility is true or "
            f'false, or a probability; for other values give missing = "ARRAY {_sign(hidden)} NUMBER".'
        )
    values = np.nan_to_num(values, nan=0.0)
    if set(np.unique(values)) <= {0, 1}:
        return values == 1, "1 is seen"
    return values >= threshold, f"a probability of {threshold:g} or more is seen"


def _sign(hidden: bool) -> str:
    """Return how a lost point's rating compares with a limit."""
    return ">" if hidden else "<"


def _nan(values: Shaped[np.ndarray, "t n"]) -> Bool[np.ndarray, "t n"]:
    return np.isnan(values) if values.dtype.kind == "f" else np.zeros(values.shape, bool)


def _in_unit_range(values: Shaped[np.ndarray, "t n"]) -> bool:
    return bool(((values >= 0) & (values <= 1) | _nan(values)).all())
