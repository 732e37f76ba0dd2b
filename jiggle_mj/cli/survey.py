"""The survey of a recording as a table, and its problems as lines."""

from collections.abc import Iterator
from pathlib import Path

from rich.table import Table

from ..errors import JiggleError, MeshError, PerceptionError, RecordingError
from ..plausibility.check import refuse_implausible
from ..plausibility.problem import metres, seconds
from ..plausibility.survey import Survey, survey
from ..recording.mcap_files import truth_path
from ..recording.reader import Recording
from .terminal import console

ALLOW = " (--allow-implausible keeps it nevertheless)"
"""End of the message of a recording that is refused."""


def doubt(text: str) -> None:
    """Print a line about what is doubtful."""
    console.print(text, style="yellow", highlight=False, soft_wrap=True)


def show_survey(path: Path, *, allow_implausible: bool) -> Survey:
    """Print the survey of a recording that was just imported as a table, then what is doubtful about it.

    A recording that is refused is removed, with its truth.

    Args:
        path: the recording.
        allow_implausible: keep it where the check before an estimate refuses it.

    Raises:
        RecordingError: the recording cannot be read, is implausible, or its points show no sheet at rest.
    """
    from jiggle_mj.estimator.rest_check import check_rest

    try:
        recording = Recording.open(path)
        surveyed = survey(recording)
        table = Table("surveyed", "", box=None)
        for name, value in rows(surveyed):
            table.add_row(name, value)
        console.print(table)
        refuse_implausible(surveyed, path, log=doubt, allow=allow_implausible, cure=ALLOW)
        if recording.camera is None:
            check_rest(recording.without_images(), recording.declaration)
    except JiggleError as failure:
        for written in (path, truth_path(path)):
            written.unlink(missing_ok=True)
        if isinstance(failure, PerceptionError | MeshError):
            raise RecordingError(f"{path}: its points at rest are not one sheet: {failure}") from failure
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
