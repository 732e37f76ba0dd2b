"""Guess which files of a folder hold the tracked points, and how they are read."""

import json
import re
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped

from ..errors import RecordingError
from .data_folder import DataFolder, quoted
from .point_files import read_frames
from .points.archives import array_shapes
from .points.dic_formats import DIC_FORMATS
from .points.file_kinds import file_kind
from .points.headings import plain_heading, track_column
from .points.measured import is_planar
from .points.missing_rule import AXES
from .points.points_table import PointFiles
from .points.rating_names import rates_points
from .points.text_lines import read_lines
from .points.text_table import TextTable
from .points.visibility import as_visibility
from .units import LENGTH_UNITS, LIKELY_EXTENT, PIXELS_ARE_NO_LENGTH, PREFERRED_UNITS

ARCHIVES, FRAMES = (".npz", ".mat"), (".csv", ".txt", ".tsv", ".xyz", ".dat", ".ply", ".obj", ".pcd", ".asc", ".pts")
"""Endings of files that hold all frames, and of files that hold one each."""
MAX_FILES = 20_000
"""Files of a folder that are looked at."""


@dataclass(frozen=True, kw_only=True)
class GuessedPoints:
    """The files of the points, and what they hold."""

    files: PointFiles
    """What `[points]` must say."""
    positions: Float[np.ndarray, "t n 3"]
    """All frames in the unit of the data."""
    units: frozenset[str]
    """Units that headings or names of arrays state."""
    times: Shaped[np.ndarray, " t"] | None
    """Times of the frames from a column of the text; None for none."""
    arrays: dict[str, tuple[int, ...]]
    """Name and shape of each array of the archive; empty for files of one frame each."""
    notes: list[str]
    """What the reader assumed or found, a line each."""
    layout: str | None = None
    """The stated layout, as text."""


def guess_points(folder: Path) -> GuessedPoints:
    """Return the likeliest points of a folder.

    Raises:
        RecordingError: the folder cannot be read, or no file in it holds points of two frames.
    """
    try:
        names = sorted(path.name for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    except (OSError, ValueError) as failure:
        raise RecordingError(f"{quoted(folder)} is no folder that can be read: {quoted(failure)}.") from failure
    if len(names) > MAX_FILES:
        raise RecordingError(f"{folder} holds {len(names)} files; at most {MAX_FILES} are looked at.")
    failures: list[str] = []
    for files in (*_of_archives(folder, names, failures), *_of_frames(names)):
        found = _first_readable(folder, files, failures)
        if found is not None:
            return found
    failures += _unread(folder, names)
    why = f" {failures[0]}" if failures else " None is of a known kind with at least two frames."
    raise RecordingError(
        f"{folder} holds no points that could be read without help: {len(names)} files.{why} Write {folder}/"
        "recording.toml by hand: docs/RECORDINGS.md has its keys."
    )


def guess_unit(points: GuessedPoints) -> tuple[str, str]:
    """Return the unit of the data, and why: the name of the array states it, or the extent of the sheet fits it."""
    key = points.files.key
    extent = float(np.nanmax(np.ptp(_finite(points.positions[0]), axis=0)))
    for unit in sorted(points.units & LENGTH_UNITS.keys()):
        name = "headings say" if key is None else f"name {key} says"
        return unit, f"as the {name}; the sheet is {extent * LENGTH_UNITS[unit]:.3g} m large"
    low, high = LIKELY_EXTENT
    pixels = f"; {PIXELS_ARE_NO_LENGTH}" if is_planar(points.positions) else ""
    for unit in PREFERRED_UNITS:
        if low <= extent * LENGTH_UNITS[unit] <= high:
            return unit, f"guessed: the sheet is then {extent * LENGTH_UNITS[unit]:.3g} m large{pixels}"
    units = ", ".join(PREFERRED_UNITS)
    return "m", f"not known: the sheet is {extent:.3g} units large, which fits none of {units}{pixels}"


def _finite(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    return points[np.isfinite(points).all(axis=1)]


def _of_archives(folder: Path, names: list[str], failures: list[str]) -> list[PointFiles]:
    """Return candidates among the arrays of archives, and single arrays, the largest first."""
    sized: list[tuple[int, PointFiles]] = []
    for name in names:
        suffix = Path(name).suffix.lower()
        if suffix == ".npy":
            sized.append(((folder / name).stat().st_size, PointFiles(files=(name,))))
        if suffix not in ARCHIVES:
            continue
        try:
            shapes = array_shapes(folder / name)
        except RecordingError as failure:
            failures.append(str(failure))
            continue
        for key, shape in shapes.items():
            if len([length for length in shape if length > 1]) == 3 and 2 <= shape[-1] <= 4:
                pixels = re.search(r"px|pixel|uv|image", key, re.IGNORECASE) is not None
                sized.append((0 if pixels else int(np.prod(shape)), PointFiles(files=(name,), key=key)))
    return [files for _, files in sorted(sized, key=lambda item: -item[0])]


def _of_frames(names: list[str]) -> list[PointFiles]:
    """Return candidates: files of one frame each, whose names differ in their numbers alone; then single tables."""
    groups: dict[str, list[str]] = {}
    for name in names:
        if Path(name).suffix.lower() in FRAMES:
            groups.setdefault(re.sub(r"\d+", "*", name), []).append(name)
    ordered = sorted(groups.items(), key=lambda item: -len(item[1]))
    several = [PointFiles(files=(key,)) for key, members in ordered if len(members) >= 2 and "[" not in key]
    alone = [PointFiles(files=(members[0],)) for _, members in ordered if len(members) == 1]
    return [*several, *alone]


def _unread(folder: Path, names: list[str]) -> list[str]:
    """Return why the files of the most frequent ending are of a kind that is not read; nothing where they are."""
    endings = Counter(Path(name).suffix.lower() for name in names)
    for ending, _ in endings.most_common(1):
        try:
            file_kind(folder / next(name for name in names if Path(name).suffix.lower() == ending))
        except RecordingError as failure:
            return [str(failure)]
    return []


def _first_readable(folder: Path, files: PointFiles, failures: list[str]) -> GuessedPoints | None:
    """Return the points under the first way of reading that works: as they are, as an export, points first."""
    shapes = array_shapes(folder / files.files[0]) if files.key is not None else {}
    ways: list[tuple[PointFiles, str | None]] = [(files, None)]
    if files.key is None:
        ways += [(replace(files, format=name), None) for name in DIC_FORMATS]
    visible = [as_visibility(key) for key in shapes if key != files.key and rates_points(key)]
    ways += [(replace(files, layout=("points", "frames", "xyz")), "points, frames")] if shapes else []
    ways += [(replace(way, visibility=each), layout) for each in visible for way, layout in ways]
    for way, layout in ways:
        try:
            found = read_frames(DataFolder(path=folder), way)
        except RecordingError as failure:
            failures += [str(failure)] * (way.format is None)  # where a format is right, the first reading names it
            continue
        if found.time_heading is not None and way.times is None:
            try:
                timed = replace(way, times=found.time_heading)
                found, way = read_frames(DataFolder(path=folder), timed), timed
            except RecordingError as failure:
                failures.append(str(failure))
        if len(found.positions) >= 2 and len(_finite(found.positions[0])) >= 3:
            return GuessedPoints(
                files=way,
                positions=found.positions,
                units=found.units,
                times=found.times,
                arrays=shapes,
                notes=found.notes,
                layout=layout,
            )
        if len(found.positions) == 1 and way.format is None and len(found.names) == 1:
            failures.append(_why_one_frame(folder / found.names[0]))
    return None


def _why_one_frame(path: Path) -> str:
    """Return what to do about a file that is read as one frame: columns that repeat may number frames and points."""
    why = f"{path} is one frame, and two are needed: give one file a frame"
    if not path.is_file() or file_kind(path) != "text":
        return f"{why}."
    table = TextTable.open(read_lines(path), columns=None, given=(None, None), known=None)
    names = table.sample.names or range(table.width)
    repeated = [column for column in range(table.width) if _repeats(table, column)]
    track = track_column(table.sample.names)
    repeated.sort(key=lambda column: column == track)
    given = [json.dumps(names[column], ensure_ascii=False) for column in repeated]
    if not given:
        return f"{why}, or frame_column in [points] for the column that numbers the frames."
    second = given[1] if len(given) > 1 else '"COLUMN"'
    others = f" ({quoted(', '.join(given))} repeat)" if len(given) > 2 else ""
    places = "" if table.sample.names else ", and columns = [...] for x, y and z"
    return (
        f"{why}, or in [points] the column that numbers the frames and the one that names the points, as frame_column "
        f"= {given[0]} and track_column = {second}{others}{places}."
    )


def _repeats(table: TextTable, column: int) -> bool:
    """Return whether the column is headed as no coordinate, and has each value twice or more on average."""
    if table.sample.names and plain_heading(table.sample.names[column]) in AXES:
        return False
    cells = table.names_of(column)
    return 1 < len(set(cells)) <= len(cells) / 2
