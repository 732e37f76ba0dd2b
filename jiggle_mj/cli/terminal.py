"""What goes to stderr: progress, figures in a few lines, and why it stopped."""

import json
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, NoReturn

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

if TYPE_CHECKING:
    from ..episode import OnFrame
    from ..estimate import Estimate
    from ..observation import Observation

console = Console(stderr=True)


def log(text: str) -> None:
    """A line about long work."""
    console.print(text, highlight=False)


def stop(failure: object, code: int) -> NoReturn:
    """Say why in red, and leave."""
    console.print(f"jiggle-mj: {failure}", style="red", markup=False, highlight=False, soft_wrap=True)
    sys.exit(code)


@contextmanager
def patient() -> Iterator[Callable[[], bool]]:
    """The first Ctrl-C is noted, for who asks, and what is under way comes to its end; the second stops at once."""
    noted: list[int] = []

    def note(number: int, _: FrameType | None) -> None:
        if noted:
            raise KeyboardInterrupt
        noted.append(number)
        log("interrupted: what is under way comes to its end, and the results are written; again stops at once")

    before = signal.signal(signal.SIGINT, note)
    try:
        yield lambda: bool(noted)
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def progress(total: int, title: str) -> "Iterator[OnFrame]":
    """A bar of frames."""
    with bar(total, title) as advance:

        def on_frame(observation: "Observation", found: "Estimate | None") -> None:
            note = "" if found is None else f", entropy {found.entropy:.0f} nat"
            advance(f": grasp {observation.tool.grasp}{note}")

        yield on_frame


@contextmanager
def bar(total: int, title: str) -> Iterator[Callable[..., None]]:
    """A bar on stderr; what is given is called with a note for each part done."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as bar:
        task = bar.add_task(title, total=total)
        yield lambda note="": bar.update(task, advance=1, description=title + note)


def show(figures: dict, out: Path, as_json: bool) -> None:
    """What was found, in a few lines; the whole of it with --json."""
    from jiggle_mj.eval.report.verdict import doubts

    detection, calibration = figures["detection"], figures["calibration"]
    console.print(
        f"{detection['n_detected']} of {figures['n_particles']} particles reported attached ({detection['rule']})"
    )
    if detection["n_attached"] is not None:
        table = Table("rings", "PCD %", "PUG %", "F1 %", box=None)
        for rings, one in detection["by_dilation"].items():
            table.add_row(
                rings, *("-" if one[name] is None else f"{100 * one[name]:.1f}" for name in ("pcd", "pug", "f1"))
            )
        console.print(table)
        parts = [f"{detection['n_attached']} truly attached"]
        if calibration["nees_attached"] is not None:
            parts.append(f"NEES per dof of the attached {calibration['nees_attached']:.2f}")
        if figures["tracking"]["rms_m"] is not None:
            parts.append(f"tracking RMS {1e3 * figures['tracking']['rms_m']:.2f} mm")
        console.print(", ".join(parts))
    for skipped in figures["frames"]["skipped"]:
        console.print(f"frame {skipped['index']} skipped: {skipped['why']}")
    for index in figures["frames"]["not_converged"]:
        console.print(f"frame {index}: the search for the sheet's state was cut off; trust it less.")
    for doubt in doubts(figures):
        console.print(doubt)
    console.print(f"report: {out / 'report.html'}")
    if as_json:
        print(json.dumps(figures))
