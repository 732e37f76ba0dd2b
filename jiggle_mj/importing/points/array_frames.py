"""Frames of tracked points in arrays: one file with all frames, or an .npy or .npz a frame."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped

from ...errors import RecordingError
from ..data_folder import quoted
from .archives import array_shapes, describe, read_array
from .file_kinds import refuse_many
from .headings import stated_units
from .layouts import FRAMES_FIRST, frames_first
from .measured import Measured
from .missing_rule import AXES
from .points_table import PointFiles
from .visibility import named_visibility, refuse_unnamed_visibility


def read_array_frames(paths: list[Path], points: PointFiles) -> Measured:
    """Return the contents of archives.

    Raises:
        RecordingError: an array is missing, damaged or too large, or the arrays' shapes contradict each other.
    """
    if points.columns is not None or points.format is not None or points.separator or points.decimal:
        raise RecordingError(
            f"[points] columns, format, separator and decimal are for text files; {paths[0].name} is read as arrays."
        )
    path = paths[0]
    name = f"{path}: {_listed(points.key)}"
    if len(paths) > 1:
        return _one_a_frame(paths, points)
    times = None if points.times is None else read_array(path, points.times)
    n_times = None if times is None else times.size
    positions = frames_first(_components(path, points.key, points), points.layout, name=name, n_times=n_times)
    positions = np.asarray(positions, dtype=np.float64)
    shapes = array_shapes(path)
    used = {points.times, points.runs, *_keys(points.key), *_keys(points.displacements)}
    others = {key: given for key, given in shapes.items() if key not in used}
    swapped = points.layout is not None and points.layout.index("points") < points.layout.index("frames")
    seen, notes = named_visibility(path, points, (positions.shape[0], positions.shape[1]), swapped=swapped)
    if points.visibility is None and (points.missing is None or points.missing.column not in others):
        notes = refuse_unnamed_visibility(path, others, positions, swapped=swapped)
    return Measured(
        positions=positions,
        times=times,
        units=stated_units(str(key) for key in _keys(points.key)),
        displacements=_displacements(path, points, positions),
        rule_values=_rule_values(path, points, positions, swapped),
        seen=seen,
        unused_displacements=tuple(key for key in others if "disp" in key.lower() and not points.displacements),
        headings=tuple(others),
        names=[f"{path.name} frame {number}" for number in range(len(positions))],
        notes=notes,
    )


def _keys(given: str | tuple[int | str, ...] | None) -> tuple[int | str, ...]:
    return () if given is None else (given,) if isinstance(given, str) else given


def _listed(key: str | tuple[str, ...] | None) -> str:
    return "the array" if key is None else ", ".join(str(each) for each in _keys(key))


def _components(path: Path, key: str | tuple[int | str, ...] | None, points: PointFiles) -> Shaped[np.ndarray, "..."]:
    """Return one array, or arrays of x, y and z as one whose last axis is xyz."""
    if key is None or isinstance(key, str):
        return read_array(path, key)
    if points.layout is not None and points.layout[2] != "xyz":
        raise RecordingError(f"[points] layout of the separate arrays {_listed_numbers(key)} must end with xyz.")
    arrays = [read_array(path, str(each)) for each in key]
    if len({array.shape for array in arrays}) > 1 or arrays[0].ndim != 2:
        shapes = describe({str(each): array.shape for each, array in zip(key, arrays, strict=True)})
        raise RecordingError(f"{path} has {shapes}; arrays of x, y and z must all have shape (frames, points).")
    return np.stack(arrays, axis=2)


def _listed_numbers(key: tuple[int | str, ...]) -> str:
    return quoted(", ".join(str(each) for each in key))


def _displacements(
    path: Path, points: PointFiles, positions: Float[np.ndarray, "t n c"]
) -> Float[np.ndarray, "t n c"] | None:
    if points.displacements is None:
        return None
    given = points.displacements
    key = str(given[0]) if len(given) == 1 else given
    array = frames_first(
        _components(path, key, points), points.layout or FRAMES_FIRST, name=f"{path}: displacements", n_times=None
    )
    if array.shape != positions.shape:
        raise RecordingError(f"{path}: displacements have shape {array.shape}, the positions {positions.shape}.")
    return np.asarray(array, dtype=np.float64)


def _rule_values(
    path: Path, points: PointFiles, positions: Float[np.ndarray, "t n c"], swapped: bool
) -> Float[np.ndarray, "t n"] | None:
    """Return the values of the column of the rule `missing`: an array of the archive, or x, y or z."""
    column = None if points.missing is None else points.missing.column
    if column is None:
        return None
    if column in AXES[: positions.shape[2]] and column not in array_shapes(path):
        return positions[:, :, AXES.index(column)]
    values, shape = read_array(path, column), positions.shape[:2]
    if values.shape == shape[::-1] and (swapped or shape[0] != shape[1]):
        values = values.T
    if values.shape != shape:
        raise RecordingError(f"{path}: {quoted(column)} has shape {values.shape}; missing needs {shape}, one a point.")
    return np.asarray(values, dtype=np.float64)


def _one_a_frame(paths: list[Path], points: PointFiles) -> Measured:
    """Return frames of shape (points, 3), a file each."""
    if points.times or points.runs or points.visibility or points.displacements or points.layout:
        raise RecordingError(
            "[points] times, runs, visibility, displacements and layout need one file with all frames; files names "
            f"{len(paths)}."
        )
    first = _components(paths[0], points.key, points)
    refuse_many(len(paths), len(first))
    arrays = [first, *(_components(path, points.key, points) for path in paths[1:])]
    for path, array in zip(paths, arrays, strict=True):
        if array.ndim != 2 or array.shape[1] not in (2, 3) or array.shape != arrays[0].shape:
            raise RecordingError(
                f"{path} has shape {array.shape}, {paths[0].name} has {arrays[0].shape}; each frame must be (points, "
                "3), with the same points."
            )
    positions = np.stack(arrays).astype(np.float64)
    rule = None if points.missing is None or points.missing.column is None else points.missing.column
    if rule is not None and rule not in AXES[: positions.shape[2]]:
        raise RecordingError(f"[points] missing names '{quoted(rule)}'; with a file a frame it may name x, y or z.")
    return Measured(
        positions=positions,
        units=stated_units(str(key) for key in _keys(points.key)),
        rule_values=None if rule is None else positions[:, :, AXES.index(rule)],
        names=[path.name for path in paths],
        notes=[],
    )
