"""Order of the axes of an array of tracked points: frames first, points first, or as the user says."""

from typing import Literal

import numpy as np
from jaxtyping import Float, Shaped

from ...errors import RecordingError
from ..data_folder import quoted

Axis = Literal["frames", "points", "xyz"]
Layout = tuple[Axis, Axis, Axis]
FRAMES_FIRST: Layout = ("frames", "points", "xyz")
"""The order of all arrays inside the importer."""
MAX_PLANE, MAX_SPACE = 2, 3
"""Coordinates of a point in a plane and in space."""

_FOURTH = " Save x, y, z without the fourth; if that says which points are seen, as an array for visibility."


def read_layout(text: str, where: str) -> Layout:
    """Return the order of axes that a text such as "points, frames" states; xyz is last where it is not named.

    Raises:
        RecordingError: the text does not name frames and points once each.
    """
    names = [name.strip() for name in text.split(",")]
    full = names if "xyz" in names else [*names, "xyz"]
    if sorted(full) != sorted(FRAMES_FIRST):
        raise RecordingError(
            f'{where} layout must order frames, points and xyz, as "points, frames" (xyz is last where it is not '
            f"named); got '{quoted(text)}'."
        )
    first, second, third = full
    return (first, second, third)  # pyright: ignore[reportReturnType]  # sorted(full) says that they are axes


def frames_first(
    array: Shaped[np.ndarray, "..."], layout: Layout | None, *, name: str, n_times: int | None
) -> Shaped[np.ndarray, "t n c"]:
    """Return an array of positions with the axes frames, points, xyz.

    Args:
        array: positions; a leading axis of length 1, a batch of one, is dropped.
        layout: order of the axes; None where the user states none: then frames first must be plausible.
        name: file and array, for errors.
        n_times: number of the frames' times; None where they have none.

    Raises:
        RecordingError: the array has another shape, or looks as if its points came first.
    """
    if array.ndim == 4 and array.shape[0] == 1:
        array = array[0]
    shape = array.shape
    if array.ndim != 3:
        raise RecordingError(f"{name} must have shape (frames, points, 3); it has {shape}.")
    if layout is not None:
        moved = np.transpose(array, [layout.index(axis) for axis in FRAMES_FIRST])
        if moved.shape[2] not in (MAX_PLANE, MAX_SPACE):
            raise RecordingError(
                f'{name} has shape {shape}; layout "{", ".join(layout)}" makes that {moved.shape[2]} coordinates a '
                f"point, which must be 3, or 2 in a plane.{_FOURTH * (moved.shape[2] == MAX_SPACE + 1)}"
            )
        return moved
    if shape[2] == MAX_SPACE + 1:
        raise RecordingError(f"{name} has shape {shape}, with 4 numbers a point: 3 are read, or 2 in a plane.{_FOURTH}")
    if shape[2] not in (MAX_PLANE, MAX_SPACE):
        raise RecordingError(
            f'{name} must have shape (frames, points, 3); it has {shape}. Give the order of its axes: layout = "frames,'
            ' xyz, points", say.'
        )
    if 0 in shape:
        raise RecordingError(f"{name} has shape {shape}: it holds no position.")
    if n_times is None or shape[0] == shape[1]:
        _refuse_points_first(array, name)
    elif n_times == shape[1] != shape[0]:
        raise RecordingError(
            f"{name} has shape {shape} and times has {n_times} entries: its points come first. Give layout = "
            '"points, frames".'
        )
    return array


def _refuse_points_first(array: Shaped[np.ndarray, "t n c"], name: str) -> None:
    """Refuse an array whose first axis looks like that of the points.

    The mean position along an axis of frames varies by the sheet's motion, that along an axis of points by the sheet's
    extent. A sheet whose points differ less from each other than its frames do is rarer than an array with the points
    first, and the user can say which it is.

    Raises:
        RecordingError: the means over the second axis vary more than those over the first.
    """
    between_first, between_second = _spread(array, average_over=1), _spread(array, average_over=0)
    if min(array.shape[:2]) > 1 and between_first > between_second:
        n, t = array.shape[:2]
        raise RecordingError(
            f"{name} has shape {array.shape}: as {n} frames of {t} points its frames would lie {between_first:.3g} "
            f"apart, more than its points ({between_second:.3g}). Its points probably come first: give layout = "
            f'"points, frames" ({t} frames of {n} points), or layout = "frames, points" if it is right as it is.'
        )


def _spread(array: Shaped[np.ndarray, "t n c"], *, average_over: int) -> float:
    """Return the root mean square distance of the means along one axis from their own mean, finite values alone."""
    values = np.asarray(array, dtype=np.float64)
    seen = np.isfinite(values).all(axis=2, keepdims=True)
    count = seen.sum(axis=average_over)
    with np.errstate(over="ignore", invalid="ignore"):  # absurd coordinates are refused later, by name
        sums = np.where(seen, values, 0.0).sum(axis=average_over)
        means: Float[np.ndarray, "m c"] = (sums / np.maximum(count, 1))[count[:, 0] > 0]
        return float(np.sqrt(means.var(axis=0).sum())) if len(means) else 0.0
