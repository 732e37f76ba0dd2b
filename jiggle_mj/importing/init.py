"""`jiggle-mj init`: look at a folder of measured points, and write a commented recording.toml that runs.

All that is guessed is said in a comment beside it, so that the user checks it there.
"""

import json
import os
import re
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from ..errors import JiggleError, OutputError, RecordingError
from .data_folder import DataFolder
from .folder import import_folder
from .grasp_table import START_TOGETHER, Rows
from .init_arrays import GuessedArrays, guess_arrays
from .init_motion import guess_held, guess_noise
from .init_points import GuessedPoints, guess_points, guess_unit
from .point_files import read_rows
from .points.archives import read_array
from .units import LENGTH_UNITS

HELD_FILE = re.compile(r"control|held|grasp|grip", re.IGNORECASE)
"""Names of text files with the numbers of held rows."""
ATTACHED_FILE = re.compile(r"fix|attach|anchor|clamp", re.IGNORECASE)
"""Names of text files with the numbers of attached rows."""
PLAUSIBLE_NOISE_DIGITS = 2
"""Digits of the estimated noise."""


@dataclass(frozen=True, kw_only=True)
class Description:
    """What `init` wrote."""

    path: Path
    """The recording.toml."""
    text: str
    """Its text."""
    problem: str | None
    """Why an import with it is still refused; None where it runs."""


def describe_folder(folder: str | os.PathLike[str]) -> Description:
    """Write a recording.toml into a folder of measured points, and try it.

    Raises:
        RecordingError: no points are found in the folder.
        OutputError: there is a recording.toml, or it cannot be written.
    """
    folder = Path(folder)
    path = folder / "recording.toml"
    if path.exists():
        raise OutputError(f"{path} exists and is kept; remove it, or edit it and import.")
    text = draft(folder)
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as failure:
        raise OutputError(f"{path} cannot be written: {failure.strerror}.") from failure
    try:
        with tempfile.TemporaryDirectory() as place:
            import_folder(folder, path, Path(place) / "run.mcap")
    except JiggleError as failure:
        return Description(path=path, text=text, problem=str(failure))
    return Description(path=path, text=text, problem=None)


def draft(folder: Path) -> str:
    """Return the text of a recording.toml for a folder.

    Raises:
        RecordingError: no points are found in the folder.
    """
    points = guess_points(folder)
    arrays = guess_arrays(folder, points)
    unit, why_unit = guess_unit(points)
    noise = guess_noise(points.positions) * LENGTH_UNITS[unit]
    n_frames, n_points = points.positions.shape[:2]
    name = re.sub(r"\W+", "_", folder.resolve().name).strip("_") or "recording"
    lines = [
        f"# {n_frames} frames of {n_points} points. Check every line that says 'guessed' or 'check'.",
        *(f"# {note}" for note in points.notes),
        f"name = {_text(name)}",
        f"unit = {_text(unit)}  # {why_unit}",
    ]
    if arrays.times is None:
        lines.append("period = 1.0  # s from frame to frame; not known: check, if time matters")
    else:
        lines.append(f"time_unit = {_text(arrays.time_unit)}  # {arrays.why_time_unit}")
    digits = f"{noise:.{PLAUSIBLE_NOISE_DIGITS}g}"
    lines.append(f"noise_sd = {float(digits)!r}  # m, estimated from how the points tremble; check")
    lines += ["", *_points_lines(points, arrays), "", *_mesh_lines(arrays), ""]
    lines += [*_grasp_lines(folder, points, arrays), "", *_truth_lines(folder, n_points)]
    return "\n".join([*lines, *_DECLARATION]) + "\n"


_DECLARATION = (
    "[declaration]",
    "membrane_stiffness = 30.0  # N/m, Young's modulus times thickness; assumed: stiffnesses scale with it",
    "thickness = 1e-3  # m, assumed",
    "gravity = [0.0, 0.0, 0.0]  # m/s^2; [0.0, 0.0, -9.81] where z is up; zeros where the vertical is unknown",
    "bed = false  # true where the sheet lies on something; needs gravity",
)


def _points_lines(points: GuessedPoints, arrays: GuessedArrays) -> list[str]:
    files = points.files
    given = {
        "files": list(files.files),
        "key": files.key,
        "layout": points.layout,
        "format": files.format,
        "visibility": files.visibility,
        "times": arrays.times,
        "runs": arrays.runs,
    }
    lines = [f"{key} = {json.dumps(value)}" for key, value in given.items() if value is not None]
    rest = ["# rest = 0  # number of the frame that shows the sheet at rest"] if arrays.times is None else []
    return ["[points]", *lines, *rest]


def _mesh_lines(arrays: GuessedArrays) -> list[str]:
    lines = ["[mesh]"]
    if arrays.faces is not None:
        lines.append(f"faces = {_text(arrays.faces)}")
        if arrays.first_vertex:
            lines.append(f"first_vertex = {arrays.first_vertex}")
    return [*lines, "# margin = 0.01  # m: the sheet goes on around the points that are seen"]


def _grasp_lines(folder: Path, points: GuessedPoints, arrays: GuessedArrays) -> list[str]:
    file = _rows_file(folder, points.positions.shape[1], HELD_FILE)
    frames = [k for k, each in enumerate(points.positions) if np.isfinite(each).all(axis=1).any()]
    runs = np.zeros(len(points.positions), int)
    if arrays.runs is not None:
        runs = read_array(folder / points.files.files[0], arrays.runs)
    lines: list[str] = []
    several = len(np.unique(runs)) > 1
    for value in np.unique(runs):
        lines.append("[[grasp]]" if several else "[grasp]")
        if several:
            lines.append(f"run = {int(value)}")
        if file is not None and not several:
            lines += [f"rows_file = {_text(file[0])}  # guessed by its name", f"rows_first = {file[1]}"]
        else:
            run = points.positions[[k for k in frames if runs[k] == value]]
            lines.append(f"rows = {_guessed_rows(run)}  # guessed: they move most at first; check")
        lines += [*_tool_lines(arrays), ""]
    return lines[:-1]


def _guessed_rows(frames: Float[np.ndarray, "t n 3"]) -> list[int]:
    held: Int[np.ndarray, " h"] = guess_held(frames)
    return held.tolist()


def _tool_lines(arrays: GuessedArrays) -> list[str]:
    if arrays.tool is None:
        return ["# without tool, the held points give its position"]
    lines = [f"tool = {_text(arrays.tool)}  # guessed by its name"]
    given = {"tool_times": arrays.tool_times, "tool_turns": arrays.tool_turns, "tool_unit": arrays.tool_unit}
    given |= {"tool_time_unit": arrays.tool_time_unit}
    lines += [f"{key} = {_text(value)}" for key, value in given.items() if value is not None]
    if arrays.clocks_apart:
        lines.append(f"tool_clock_offset = {_text(START_TOGETHER)}  # guessed: the clocks differ; or seconds to add")
    return [*lines, "after = 0.0  # s from the begin until the jaws close"]


def _truth_lines(folder: Path, n_points: int) -> list[str]:
    file = _rows_file(folder, n_points, ATTACHED_FILE)
    if file is None:
        return ["# [truth]  # for scoring only, where you know it", "# attached_rows = []", ""]
    lines = [f"attached_rows_file = {_text(file[0])}  # guessed by its name", f"attached_rows_first = {file[1]}"]
    return ["[truth]  # for scoring only: never in the recording", *lines, ""]


def _rows_file(folder: Path, n_points: int, names: re.Pattern[str]) -> tuple[str, int] | None:
    """Return name and first number of a text file of such a name that holds rows of the points."""
    for path in sorted(folder.glob("*.txt")):
        if names.search(path.stem):
            for first in (0, 1):
                try:
                    read_rows(DataFolder(path=folder), Rows(file=path.name, first=first), n_points, path.name)
                except RecordingError:
                    continue
                return path.name, first
    return None


def _text(value: str) -> str:
    """Return a string as TOML writes it."""
    return json.dumps(value)
