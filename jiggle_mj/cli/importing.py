"""The verbs `import` and `inspect`: a robot's bag or a folder of measured points becomes a recording."""

import json
import re
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from rich.table import Column, Table

from ..errors import OptionError
from .init import refuse_no_folder
from .options import AsJson, Out, PathArgument
from .survey import show_survey
from .terminal import console

Repeated = tyro.conf.UseAppendAction[Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME=VALUE")]]
"""An option that may be repeated."""
SHOWN_REASONS = 8
"""Reasons for leaving out frames that are printed."""

if TYPE_CHECKING:
    from ..importing.bags.settings import BagSettings


def import_(
    path: PathArgument,
    /,
    *,
    out: Out,
    recording: Path | None = None,
    topics: Path | None = None,
    topic: Repeated = (),
    closed: str | None = None,
    camera_info: Repeated = (),
    pairing_tolerance: float | None = None,
    grasp_radius: float | None = None,
    world: str | None = None,
    clock: Literal["header", "receive"] | None = None,
    allow_truncated: bool = False,
    overwrite: bool = False,
    allow_outside: bool = False,
    allow_implausible: bool = False,
    as_json: AsJson = False,
) -> None:
    """Convert a robot's bag, or a folder of measured points, to a recording.

    A ROS 1 or ROS 2 bag has its topics guessed and printed: docs/BAGS.md. A folder of points is described by its
    recording.toml: docs/RECORDINGS.md.

    Args:
        path: a bag (.bag, .mcap, .db3, or the folder of a ROS 2 bag), or a folder of data files.
        out: the recording to write; attachments that a recording.toml knows go to a separate truth file beside it.
        recording: the recording.toml; that of the folder if left out.
        topics: of a bag: a map.toml that says what its topics are for.
        topic: of a bag: the topic of one role, such as left=/psm/left/image_raw; may be repeated. Roles: left, right,
            left_info, right_info, tool, gripper, points, depth, depth_info, force.
        closed: of a bag: when the jaws are closed, such as 'jaw<0.1', 'data==false', or always.
        camera_info: of a bag: a camera's calibration file, such as left=left.yaml; may be repeated.
        pairing_tolerance: of a bag: largest difference between the stamps of a left and a right image [ms]; 5 if left
            out.
        grasp_radius: of a bag: radius of the grip [m]; 0.002 if left out.
        world: of a bag: coordinate frame that counts as the world, z up; the root of /tf if left out.
        clock: of a bag: whose time a message has, its header's or the recorder's that received it; header if left out.
        allow_truncated: of a bag: read the complete records of an MCAP file that was cut off.
        overwrite: replace existing files.
        allow_outside: of a folder: read data files outside it where the TOML names them.
        allow_implausible: keep a recording that the check before an estimate refuses.
        as_json: print a summary to stdout as JSON.
    """
    from ..importing.bags.bag_paths import is_bag

    options = {
        "topic": topic,
        "closed": closed,
        "camera_info": camera_info,
        "pairing_tolerance": pairing_tolerance,
        "grasp_radius": grasp_radius,
        "world": world,
        "clock": clock,
        "allow_truncated": allow_truncated,
    }
    is_ros2_folder = (path / "metadata.yaml").exists()
    if is_bag(path) and (recording is None or path.is_file() or is_ros2_folder):
        if recording is not None:
            raise OptionError(f"--recording describes a folder of points, and {path} is a bag; use --topics.")
        settings = _settings(topics, options)
        _import_bag(path, out, settings, overwrite=overwrite, allow_implausible=allow_implausible, as_json=as_json)
        return
    given = [name for name, value in {"topics": topics, **options}.items() if value not in (None, (), False)]
    if given:
        raise OptionError(f"--{given[0].replace('_', '-')} is for a bag, and {path} is none.")
    refuse_no_folder(path)
    _import_folder(
        path,
        recording,
        out,
        overwrite=overwrite,
        allow_outside=allow_outside,
        allow_implausible=allow_implausible,
        as_json=as_json,
    )


def inspect(
    path: PathArgument,
    /,
    *,
    topics: Path | None = None,
    topic: Repeated = (),
    allow_truncated: bool = False,
    as_json: AsJson = False,
) -> None:
    """Print what is in a bag or a recording: topics, types, rates, frames, spans, and what an estimate lacks.

    Args:
        path: a bag (.bag, .mcap, .db3, or the folder of a ROS 2 bag), or a recording.
        topics: a map.toml that says what the topics of a bag are for.
        topic: the topic of one role, such as left=/psm/left/image_raw; may be repeated.
        allow_truncated: read the complete records of an MCAP file that was cut off.
        as_json: print it to stdout as JSON.
    """
    from ..importing.bags.inspection import inspect_bag

    report = inspect_bag(path, _settings(topics, {"topic": topic, "allow_truncated": allow_truncated}))
    heads = ("topic", "type", "messages", "Hz", "from [s]", "to [s]", "role", "frames")
    table = Table(*(Column(head, overflow="fold", no_wrap=head == "topic") for head in heads), box=None)
    for each in report.topics:
        begin, end = ("-", "-") if each.span is None else (f"{time:.3f}" for time in each.span)
        rate = "-" if each.rate is None else f"{each.rate:.4g}"
        shown = re.split("[/.]", each.type)[-1] + ("" if each.stamped is not False else " (no stamp)")
        table.add_row(
            each.name, shown, str(each.count), rate, begin, end, each.role or "-", ", ".join(each.frames) or "-"
        )
    console.print(f"{path}: a {report.kind}")
    console.print(table)
    for lack in report.missing:
        console.print(f"missing: {lack}", highlight=False, soft_wrap=True)
    console.print(f"next: {report.next_command}", highlight=False, soft_wrap=True)
    if as_json:
        print(json.dumps(asdict(report), default=str))


def _settings(topics: Path | None, options: dict) -> "BagSettings":
    from ..importing.bags.settings import BagSettings, read_map, with_options

    return with_options(BagSettings() if topics is None else read_map(topics), **options)


def _import_bag(
    path: Path, out: Path, settings: "BagSettings", *, overwrite: bool, allow_implausible: bool, as_json: bool
) -> None:
    from ..importing.bags.importer import import_bag

    summary = import_bag(path, out, settings, overwrite=overwrite)
    table = Table("role", "topic", "", box=None)
    for role, name in summary.topics.items():
        table.add_row(role, name, "guessed" if role in summary.guessed else "given")
    console.print(table)
    for note in summary.notes:
        console.print(note, highlight=False, soft_wrap=True)
    for why, count in list(summary.skipped.items())[:SHOWN_REASONS]:
        console.print(f"left out {count} frames: {why}", highlight=False, soft_wrap=True)
    if len(summary.skipped) > SHOWN_REASONS:
        console.print(f"left out {sum(summary.skipped.values())} frames in all, for {len(summary.skipped)} reasons")
    console.print(
        f"wrote {summary.recording}: {summary.n_frames} frames over {summary.duration:.3g} s, "
        f"{summary.n_grasps} grasps",
        highlight=False,
        soft_wrap=True,
    )
    show_survey(summary.recording, allow_implausible=allow_implausible)
    if as_json:
        print(json.dumps({f.name: getattr(summary, f.name) for f in fields(summary)}, default=str))


def _import_folder(
    folder: Path,
    recording: Path | None,
    out: Path,
    *,
    overwrite: bool,
    allow_outside: bool,
    allow_implausible: bool,
    as_json: bool,
) -> None:
    from ..importing.folder import import_folder

    summary = import_folder(folder, recording, out, overwrite=overwrite, allow_outside=allow_outside)
    for note in summary.notes:
        console.print(f"note: {note}", highlight=False, soft_wrap=True)
    for name, why in summary.skipped:
        console.print(f"left out {name}: {why}")
    console.print(
        f"wrote {summary.recording}: {summary.n_frames} frames of {summary.n_points} points, {summary.n_unseen} "
        f"missing points over all frames, {summary.n_held} held; truth: {summary.truth or 'none'}"
    )
    show_survey(summary.recording, allow_implausible=allow_implausible)
    if as_json:
        print(json.dumps(asdict(summary), default=str))
