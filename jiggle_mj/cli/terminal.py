"""Output to stderr: progress, a short summary of the figures, and the reason of a failure."""

import json
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, NoReturn

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from .interrupts import INTERRUPTED as INTERRUPTED
from .interrupts import raise_swallowed

if TYPE_CHECKING:
    from ..episode import OnFrame
    from ..estimate import Estimate
    from ..observation import Observation

console = Console(stderr=True, markup=False)
WORTH_SAYING = 0.5
"""Sum of P(attached) from which it is said where no particle is reported: likelier than not, one is attached."""
FAILED, WRONG_USAGE = 1, 2
"""Exit codes of a run that failed, and of arguments that cannot be used."""


def log(text: str) -> None:
    """Print a line about the progress of long work."""
    console.print(text, highlight=False)


def note(text: object) -> None:
    """Print a line in red."""
    console.print(f"jiggle-mj: {text}", style="red", highlight=False, soft_wrap=True)


def stop(failure: object, code: int) -> NoReturn:
    """Print the reason in red, and exit with a code, even where stderr cannot be written."""
    with suppress(OSError):
        note(failure)
    sys.exit(code)


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether Ctrl-C was pressed; a second Ctrl-C raises `KeyboardInterrupt`."""
    interrupts: list[int] = []

    def on_interrupt(number: int, _: FrameType | None) -> None:
        if interrupts:
            raise KeyboardInterrupt
        interrupts.append(number)
        log("interrupted: finishing the current step and writing the results; press Ctrl-C again to stop at once")

    previous = signal.signal(signal.SIGINT, on_interrupt)
    try:
        yield lambda: bool(interrupts)
    finally:
        signal.signal(signal.SIGINT, previous)


@contextmanager
def progress(total: int, title: str) -> "Iterator[OnFrame]":
    """Yield a callback that advances a bar by a frame."""
    with bar(total, title) as advance:

        def on_frame(observation: "Observation", estimate: "Estimate | None") -> None:
            note = "" if estimate is None else f", entropy {estimate.entropy:.0f} nat"
            advance(f": grasp {observation.tool.grasp}{note}")

        yield on_frame


@contextmanager
def bar(total: int, title: str) -> Iterator[Callable[..., None]]:
    """Yield a function that advances a bar on stderr by one part, with a note beside it."""
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as shown:
        task = shown.add_task(title, total=total)

        def advance(note: str = "") -> None:
            raise_swallowed()
            shown.update(task, advance=1, description=title + note)

        try:
            yield advance
        except BaseException:
            shown.live.transient = (
                shown.tasks[0].completed == 0
            )  # a bar that never moved says nothing beside the reason
            raise


def show(figures: dict, out: Path, as_json: bool) -> None:
    """Print a summary of result.json to stderr, and all of it to stdout with --json."""
    from jiggle_mj.eval.report.verdict import doubts, skipped_frames

    detection, calibration = figures["detection"], figures["calibration"]
    for line in skipped_frames(figures):
        console.print(line, highlight=False)
    console.print(
        f"{detection['n_detected']} of {figures['n_particles']} particles reported attached ({detection['rule']})",
    )
    expected = detection.get("n_expected") or 0.0  # not in results of older versions
    if not detection["n_detected"] and expected >= WORTH_SAYING:
        console.print(f"P(attached) sums to {expected:.1f}: something holds softly, or where it holds is not certain.")
    if detection["n_attached"] is not None:
        table = Table("rings", "PCD %", "PUG %", "F1 %", box=None)
        for rings, figure in detection["by_dilation"].items():
            cells = ("-" if figure[name] is None else f"{100 * figure[name]:.1f}" for name in ("pcd", "pug", "f1"))
            table.add_row(rings, *cells)
        console.print(table)
        parts = [f"{detection['n_attached']} truly attached"]
        if calibration["nees_attached"] is not None:
            parts.append(f"NEES per dof of the attached {calibration['nees_attached']:.2f}")
        if figures["tracking"]["rms_m"] is not None:
            parts.append(f"tracking RMS {1e3 * figures['tracking']['rms_m']:.2f} mm")
        console.print(", ".join(parts))
    for index in figures["frames"]["not_converged"]:
        console.print(f"frame {index}: the search for the sheet's state did not converge; trust this frame less.")
    for doubt in doubts(figures):
        console.print(doubt)
    console.print(f"report: {out / 'report.html'}")
    if as_json:
        print(json.dumps(figures))
