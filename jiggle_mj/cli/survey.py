"""The check before an estimate: the survey of a recording as a table, its problems as lines."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rich.table import Table

from ..errors import RecordingError
from ..plausibility.problem import metres, seconds
from ..plausibility.problems import problems
from ..plausibility.survey import Survey, survey
from ..recording.mcap_files import truth_path
from ..recording.reader import Recording
from .terminal import console


def report(surveyed: Survey, path: Path, *, allow_implausible: bool = False, cure: str = "") -> None:
    """Print what is doubtful about a recording.

    Args:
        surveyed: its survey.
        path: its file, for messages.
        allow_implausible: print what refuses it, and go on.
        cure: ends the message of a refusal.

    Raises:
        RecordingError: the recording is implausible; names every reason.
    """
    found = problems(surveyed)
    for problem in found:
        if not problem.refuses or allow_implausible:
            text = f"{problem.name}: {problem.text}"
            console.print(text, style="yellow", markup=False, highlight=False, soft_wrap=True)
    refused = [] if allow_implausible else [problem for problem in found if problem.refuses]
    if refused:
        reasons = " ".join(f"{problem.name}: {problem.text}" for problem in refused)
        raise RecordingError(f"{path} is implausible. {reasons}{cure}")


def check_before(recording: Recording, path: Path, declare: Mapping[str, Any], *, allow_implausible: bool) -> None:
    """Check a recording before it is estimated, and say what is assumed of its tissue.

    Args:
        recording: an open recording.
        path: its file, for messages.
        declare: properties that the command line declares.
        allow_implausible: see `report`.

    Raises:
        RecordingError: the recording is implausible.
    """
    from jiggle_mj.eval.runs.settings_used import assumed

    cure = " (--allow-implausible goes on nevertheless)"
    report(survey(recording), path, allow_implausible=allow_implausible, cure=cure)
    assumption = assumed(recording.declaration, declare=declare, declared=recording.declared)
    if assumption is not None:
        console.print(assumption, style="bold yellow", markup=False, highlight=False, soft_wrap=True)


def show_survey(path: Path) -> Survey:
    """Print the survey of a recording that was just imported as a table, then what is doubtful about it.

    A recording that is refused is removed, with its truth.

    Raises:
        RecordingError: the recording cannot be read, or is implausible.
    """
    try:
        surveyed = survey(Recording.open(path))
        table = Table("surveyed", "", box=None)
        for name, value in rows(surveyed):
            table.add_row(name, value)
        console.print(table)
        report(surveyed, path)
    except RecordingError:
        for written in (path, truth_path(path)):
            written.unlink(missing_ok=True)
        raise
    return surveyed


def rows(surveyed: Survey) -> Iterator[tuple[str, str]]:
    """Yield name and value of each line of the table; what is unknown is left out."""
    skipped = f", {surveyed.skipped} skipped" if surveyed.skipped else ""
    yield "frames", f"{surveyed.frames}{skipped}, {surveyed.closed_frames} with closed jaws in {surveyed.grasps} grasps"
    rate = "" if not surveyed.period_s else f", {1 / surveyed.period_s:.3g} a second"
    yield "time", f"{seconds(surveyed.span_s)}{rate}"
    if surveyed.largest_gap_s is not None:
        yield "longest gap in a grasp", seconds(surveyed.largest_gap_s)
    if surveyed.points is not None:
        yield (
            "points",
            f"{surveyed.points}" + (f", {surveyed.unseen:.1%} unseen" if surveyed.unseen is not None else ""),
        )
    lengths = {
        "extent of the sheet": surveyed.extent_m,
        "spacing of the points": surveyed.spacing_m,
        "motion of the points": surveyed.points_motion_m,
        "motion of the held points": surveyed.held_motion_m,
        "motion of the tool": surveyed.tool_motion_m,
        "path of the tool": surveyed.tool_path_m,
        "tool from what it holds": surveyed.tool_distance_m,
        "baseline of the cameras": surveyed.baseline_m,
        "tool from the camera": surveyed.tool_depth_m,
        "declared noise": surveyed.declared_sd_m,
    }
    yield from ((name, metres(length)) for name, length in lengths.items() if length is not None)
    if surveyed.noise_sd_m is not None:
        yield "measured noise", f"{metres(surveyed.noise_sd_m)} ({surveyed.noise_from})"
    if surveyed.tool_speed_m_s is not None:
        yield "largest speed of the tool", f"{surveyed.tool_speed_m_s:.3g} m/s"
    if surveyed.image_size is not None:
        yield "images", f"{surveyed.image_size[0]} x {surveyed.image_size[1]} px"
