"""Tables of many runs: each scene, sensing and seed in a folder of its own, then means and spreads as Markdown.

A table that was interrupted goes on where it was: a folder with a scored result is not run again, unless the version or
the estimator's settings were others. Give a new folder after any other change.
"""

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from jiggle_mj.episode import ESTIMATE, RESULT, settings
from jiggle_mj.estimator import EstimatorConfig
from jiggle_mj.options import Sensing
from jiggle_mj.recording.declaration import made_by
from jiggle_mj.recording.estimate import read_estimate
from jiggle_mj.scenes import load_scene

from ..metrics.score import Json, read_result
from ..runs.experiment import run_scene


@dataclass(frozen=True, kw_only=True)
class MainRow:
    """One line of a table: the same scene and sensing over all seeds."""

    scene: str
    sensing: Sensing


MAIN = tuple(
    MainRow(scene=scene, sensing=sensing)
    for sensing in ("stereo", "particles")
    for scene in ("arc", "line", "u_shape", "line_dot", "arc_line", "arc_soft", "arc_stiff", "arc_weld", "free")
)
"""The table of docs/RESULTS.md."""
FIGURES = (
    ("attached", ("detection", "n_attached"), 1.0, 0),
    ("reported", ("detection", "n_detected"), 1.0, 0),
    ("PCD % exact", ("detection", "by_dilation", "0", "pcd"), 100.0, 1),
    ("PUG % exact", ("detection", "by_dilation", "0", "pug"), 100.0, 1),
    ("PCD % one ring", ("detection", "by_dilation", "1", "pcd"), 100.0, 1),
    ("PUG % one ring", ("detection", "by_dilation", "1", "pug"), 100.0, 1),
    ("observable", ("detection", "n_observable"), 1.0, 0),
    ("PUG % of observable, one ring", ("detection", "observable", "by_dilation", "1", "pug"), 100.0, 1),
    ("NEES/dof attached", ("calibration", "nees_attached"), 1.0, 2),
    ("coverage of 90 %, attached", ("calibration", "coverage_attached"), 1.0, 2),
    ("ECE", ("calibration", "ece"), 1.0, 3),
    ("tracking mm", ("tracking", "rms_m"), 1e3, 2),
    ("update s", ("timing", "update_s", "median"), 1.0, 2),
    ("perception s", ("timing", "perception_s"), 1.0, 2),
)
"""Heading, place in result.json, factor and digits of each column."""


def measure(
    rows: Iterable[MainRow], seeds: Iterable[int], directory: Path, *, log: Callable[[str], None]
) -> dict[MainRow, list[Json]]:
    """Run what has not been run, and read all results.

    Args:
        rows: of the table.
        seeds: of each row.
        directory: holds a folder for each run.
        log: told of each run before it starts.
    """
    seeds, found = tuple(seeds), {}
    for row in rows:
        found[row] = []
        for seed in seeds:
            folder = directory / f"{row.scene}-{row.sensing}-{seed}"
            done = finished(folder, EstimatorConfig())
            if done is None:
                log(f"{row.scene}, {row.sensing}, seed {seed}")
                done = run_scene(load_scene(row.scene), folder, seed=seed, sensing=row.sensing, overwrite=True)
            found[row].append(done)
    return found


def carry_out(runs: Mapping[str, Callable[[], object]], executor: Executor, *, log: Callable[[str], None]) -> None:
    """Runs by name, several at a time; the first that fails ends them, and what is finished stays.

    Args:
        runs: what to call, which must go through pickle.
        executor: calls it.
        log: told of each run that is done.
    """
    left = {executor.submit(run): name for name, run in runs.items()}
    try:
        for number, done in enumerate(as_completed(left), start=1):
            done.result()
            log(f"{number} of {len(left)}: {left[done]}")
    except BaseException:
        for waiting in left:
            waiting.cancel()
        raise


def markdown(results: dict[MainRow, list[Json]]) -> str:
    """Mean over the seeds, and the range behind it where they differ."""
    lines = [
        "| scene | sensing | " + " | ".join(name for name, *_ in FIGURES) + " |",
        "|" + "---|" * (len(FIGURES) + 2),
    ]
    for row, runs in results.items():
        cells = [cell([value(run, path) for run in runs], factor, digits) for _, path, factor, digits in FIGURES]
        lines.append(f"| {row.scene} | {row.sensing} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def finished(folder: Path, config: EstimatorConfig) -> Json | None:
    """The result of a run that was scored, with this version and these settings; None if there is none."""
    if not (folder / RESULT).exists():
        return None
    figures, made_with = read_result(folder / RESULT), read_estimate(folder / ESTIMATE).metadata
    expected = settings(config) | made_by()
    current = all(made_with.get(name) == value for name, value in expected.items())
    return figures if current and value(figures, ("detection", "n_attached")) is not None else None


def value(run: Json, path: tuple[str, ...]) -> float | None:
    """The figure at a place of result.json; None where it is null or missing."""
    found: object = run
    for key in path:
        found = found[key] if isinstance(found, dict) else None
    return None if found is None else float(str(found))


def cell(values: list[float | None], factor: float, digits: int) -> str:
    """Mean and range of the values that are known."""
    known = factor * np.array([value for value in values if value is not None])
    if not len(known):
        return "–"  # noqa: RUF001  # a dash of its own for 'not defined'
    mean, low, high = (f"{number:.{digits}f}" for number in (known.mean(), known.min(), known.max()))
    return mean if low == high else f"{mean} ({low}…{high})"
