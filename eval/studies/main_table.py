"""The main table: each scene and sensing over the seeds, as means and ranges of the figures of `result.json`."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from jiggle_mj.episode import RESULT
from jiggle_mj.estimator import EstimatorConfig
from jiggle_mj.options import Sensing
from jiggle_mj.scenes import load_scene

from ..metrics.result_file import Json, read_result
from ..runs.experiment import run_scene
from .figures import Columns, figure_cells, is_scored
from .study import Study, Table


@dataclass(frozen=True, kw_only=True)
class MainRow:
    """One line of the table: a scene and a sensing over all seeds."""

    scene: str
    sensing: Sensing


@dataclass(frozen=True, kw_only=True)
class MainCell:
    """One run of the table."""

    row: MainRow
    seed: int


MAIN = tuple(
    MainRow(scene=scene, sensing=sensing)
    for sensing in ("stereo", "particles")
    for scene in ("arc", "line", "u_shape", "line_dot", "arc_line", "arc_soft", "arc_stiff", "arc_weld", "free")
)
"""Rows of the table in docs/RESULTS.md."""
FIGURES: Columns = (
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


@dataclass(frozen=True, kw_only=True)
class MainStudy(Study[MainCell, Json]):
    """Study of docs/RESULTS.md."""

    default_seeds: ClassVar[range] = range(3)
    rows: tuple[MainRow, ...] = MAIN
    run_scene: Callable[..., Json] = run_scene
    """Runs a scene and writes its folder; another one stands in where no simulation is wanted."""

    def cells(self, seeds: Iterable[int]) -> tuple[MainCell, ...]:
        """Return every row with every seed."""
        seeds = tuple(seeds)
        return tuple(MainCell(row=row, seed=seed) for row in self.rows for seed in seeds)

    def name(self, cell: MainCell) -> str:
        """Return the run's folder name."""
        return f"{cell.row.scene}-{cell.row.sensing}-{cell.seed}"

    def run_cell(self, cell: MainCell, path: Path) -> None:
        """Run the scene into its folder."""
        scene, row = load_scene(cell.row.scene), cell.row
        self.run_scene(scene, path, seed=cell.seed, sensing=row.sensing, overwrite=True)

    def is_current(self, cell: MainCell, path: Path) -> bool:
        """Say whether the folder holds a scored run of this version with the default settings."""
        return is_scored(path, EstimatorConfig())

    def read(self, cell: MainCell, path: Path) -> Json:
        """Read result.json."""
        return read_result(path / RESULT)

    def summarise(self, results: Mapping[MainCell, Json]) -> Table:
        """Return a row for each scene and sensing: the mean over the seeds, and the range where they differ."""
        rows: dict[MainRow, list[Json]] = {}
        for cell, figures in results.items():
            rows.setdefault(cell.row, []).append(figures)
        return Table(
            headings=("scene", "sensing", *(heading for heading, *_ in FIGURES)),
            rows=tuple((row.scene, row.sensing, *figure_cells(runs, FIGURES)) for row, runs in rows.items()),
        )
