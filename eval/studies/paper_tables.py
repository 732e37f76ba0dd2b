"""The paper's two tables of simulated estimation, printed figures and measured ones.

Table 1 (`simulation`) lifts four corners in turn. The appendix (`one-lift`) lifts the first of them. Each of five
shapes meets each method and three references: the two engines of `same_engine`, and MuJoCo's vertices with noise, by
`run_scene`. The Gaussian methods share the prior and the paper's rule: attached above half of b*. Ours reports
P(attached), and knows no b*.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Literal

from jiggle_mj.episode import ESTIMATE, RESULT, check_directory, clear_directory, estimate
from jiggle_mj.estimator import Estimator, EstimatorConfig
from jiggle_mj.estimator.filters import adam, unscented
from jiggle_mj.estimator.physics.simulator import HINGE_STIFFNESS, SWEEPS_PER_STEP, TIME_STEP
from jiggle_mj.scenes import Scene, load_scene
from jiggle_mj.scenes.scene.programme import grasp_points

from ..metrics.result import Run, result, with_truth
from ..metrics.result_file import Json, read_result, write_result
from ..runs.experiment import run_scene
from .figures import Columns, figure_cells, is_scored
from .same_engine import LIFT_INCREMENTS, LIFT_SHARE, POINT_SD, STIFFNESS_SHARE, Engine, same_engine
from .study import Study, Table

Reference = Literal["xpbd", "equilibrium", "mujoco"]
REFERENCES: tuple[Reference, ...] = ("xpbd", "equilibrium", "mujoco")
THRESHOLD_SHARE = 0.5
"""Threshold of the detection rule as a share of b*, b_thresh / b*, as in the paper (0.05 / 0.1)."""
EXACT_FORCE_SD = 5e-4
"""Standard deviation of the model's force error where the truth is our filter's own equilibrium [k x spacing].

Only our filter gets it. Least squares take this number for the noise of the positions too, the unscented filter for a
tolerance.
"""
METHODS = {
    "explicit (the paper's filter)": EstimatorConfig(filter="explicit"),
    "Adam": EstimatorConfig(filter="adam"),
    "NNLS": EstimatorConfig(filter="nnls"),
    "unscented, patches": EstimatorConfig(filter="unscented"),
    "implicit (ours)": EstimatorConfig(),
}
"""Name and settings of each method."""
SCENES = ("arc", "line", "line_dot", "arc_line", "u_shape")
FIGURES: Columns = (
    ("PCD %", ("detection", "by_dilation", "0", "pcd"), 100.0, 0),
    ("PUG %", ("detection", "by_dilation", "0", "pug"), 100.0, 0),
    ("PCD % one ring", ("detection", "by_dilation", "1", "pcd"), 100.0, 0),
    ("PUG % one ring", ("detection", "by_dilation", "1", "pug"), 100.0, 0),
    ("NEES/dof attached", ("calibration", "nees_attached"), 1.0, 2),
    ("coverage of 90 %, attached", ("calibration", "coverage_attached"), 1.0, 2),
    ("ECE", ("calibration", "ece"), 1.0, 3),
    ("update s", ("timing", "update_s", "median"), 1.0, 2),
)
"""Heading, place in result.json, factor and digits of each measured column."""


@dataclass(frozen=True, kw_only=True)
class PrintedTable:
    """One table as the paper prints it."""

    grasps: int
    """Corners that are lifted, one after the other."""
    printed: dict[str, dict[str, tuple[float | None, float]]]
    """PCD and PUG in per cent, by method and scene; None where the paper prints a slash."""


TABLES = {
    "simulation": PrintedTable(
        grasps=4,
        printed={
            "Ours": {"arc": (100, 87.1), "line": (100, 43.3), "line_dot": (96.0, 48.9), "arc_line": (97.3, 65.5),
                     "u_shape": (97.5, 76.0)},
            "Adam": {"arc": (82.1, 59.3), "line": (85.7, 40.0), "line_dot": (68.0, 34.7), "arc_line": (83.8, 51.8),
                     "u_shape": (87.3, 52.9)},
        },
    ),
    "one-lift": PrintedTable(
        grasps=1,
        printed={
            "Ours": {"arc": (100, 14.8), "line": (100, 16.7), "line_dot": (100, 5.1), "arc_line": (100, 16.4),
                     "u_shape": (100, 22.1)},
            "Adam": {"arc": (75.0, 5.6), "line": (75.0, 10.0), "line_dot": (None, 0.0), "arc_line": (75.0, 5.5),
                     "u_shape": (80.0, 11.5)},
            "BANet": {"arc": (10.7, 37.0), "line": (2.5, 16.7), "line_dot": (6.4, 13.3), "arc_line": (9.4, 18.2),
                      "u_shape": (2.3, 4.8)},
        },
    ),
}  # fmt: skip
"""As printed in the paper: Table 1, and the appendix's table of one lift-up."""


@dataclass(frozen=True, kw_only=True)
class PaperRow:
    """One line of a measured table: a scene, a reference and a method over all seeds."""

    scene: str
    reference: Reference
    method: str

    @property
    def config(self) -> EstimatorConfig:
        """The method's settings, with the paper's rule for this b*, and our filter's force error where it is exact."""
        config = replace(METHODS[self.method], detect_above=THRESHOLD_SHARE * true_share(self))
        exact = self.reference == "equilibrium" and config.filter == "implicit"
        return replace(config, force_sd=EXACT_FORCE_SD) if exact else config


@dataclass(frozen=True, kw_only=True)
class PaperCell:
    """One run of a measured table."""

    row: PaperRow
    seed: int


def true_share(row: PaperRow) -> float:
    """Return b* of an attached particle as a share of the membrane stiffness."""
    if row.reference != "mujoco":
        return STIFFNESS_SHARE
    scene = load_scene(row.scene)
    return scene.attachments[0].stiffness / scene.declared.membrane_stiffness


ROWS = tuple(
    PaperRow(scene=scene, reference=reference, method=method)
    for reference in REFERENCES
    for scene in SCENES
    for method in METHODS
)
"""Rows of a measured table, those of one reference together."""


@dataclass(frozen=True, kw_only=True)
class PaperStudy(Study[PaperCell, Json]):
    """One of the paper's tables, measured."""

    default_seeds: ClassVar[range] = range(10)
    table: PrintedTable
    rows: tuple[PaperRow, ...] = ROWS
    load_scene: Callable[[str], Scene] = load_scene
    """Gives the scene of a row's name."""

    def cells(self, seeds: Iterable[int]) -> tuple[PaperCell, ...]:
        """Return every row with every seed."""
        seeds = tuple(seeds)
        return tuple(PaperCell(row=row, seed=seed) for row in self.rows for seed in seeds)

    def name(self, cell: PaperCell) -> str:
        """Return the run's folder name."""
        row = cell.row
        return f"{self.table.grasps}-{row.scene}-{row.reference}-{row.config.filter}-{cell.seed}"

    def run_cell(self, cell: PaperCell, path: Path) -> None:
        """Run the scene on the cell's reference into its folder."""
        row, grasps = cell.row, self.table.grasps
        scene, config = self.load_scene(row.scene), row.config
        if row.reference != "mujoco":
            run_same_engine(scene, row.reference, path, seed=cell.seed, grasps=grasps, config=config)
        else:
            scene = replace(scene, programme=replace(scene.programme, points=grasp_points(scene)[:grasps]))
            run_scene(scene, path, seed=cell.seed, sensing="particles", config=config, overwrite=True)

    def is_current(self, cell: PaperCell, path: Path) -> bool:
        """Say whether the folder holds a scored run of this version with the method's settings."""
        return is_scored(path, cell.row.config)

    def read(self, cell: PaperCell, path: Path) -> Json:
        """Read result.json."""
        return read_result(path / RESULT)

    def summarise(self, results: Mapping[PaperCell, Json]) -> Table:
        """Return the printed figures, then a line for each scene, reference and method; the settings beneath."""
        headings = [heading for heading, *_ in FIGURES]
        rows = []
        for method, by_scene in self.table.printed.items():
            for scene, (pcd, pug) in by_scene.items():
                shares = ["/" if share is None else f"{share:g}" for share in (pcd, pug)]
                unknown = ["" for _ in headings[2:]]
                rows.append((scene, "its own engine", f"{method}, printed", *shares, *unknown))
        measured: dict[PaperRow, list[Json]] = {}
        for cell, figures in results.items():
            measured.setdefault(cell.row, []).append(figures)
        for row, runs in measured.items():
            rows.append((row.scene, row.reference, row.method, *figure_cells(runs, FIGURES)))
        seeds = sorted({str(figures["seed"]) for figures in results.values()}, key=int)
        return Table(
            headings=("scene", "reference", "method", *headings),
            rows=tuple(rows),
            beneath=("", *settings_in_words(self.table, seeds)),
        )


def run_same_engine(
    scene: Scene, engine: Engine, directory: Path, *, seed: int, grasps: int, config: EstimatorConfig
) -> None:
    """Make a truth by `same_engine`, estimate it as any recording is, and write estimate.mcap and scored result.json.

    Args:
        scene: whose sheet and shapes.
        engine: what computes the truth.
        directory: the run's folder; files that are there are replaced.
        seed: of the noise.
        grasps: corners that are lifted.
        config: of the estimator.
    """
    check_directory(directory, (), overwrite=True)
    clear_directory(directory, (ESTIMATE, RESULT))
    made = same_engine(scene, engine, seed=seed, grasps=grasps)
    estimator = Estimator(made.declaration, config=config)
    episode = estimate(made.observations, estimator, directory / ESTIMATE)
    run = Run(
        scene=scene.name, seed=seed, sensing="particles", estimator=config.filter, policy="corners", episode=episode
    )
    scored = with_truth(
        result(run),
        sheet=episode.sheet,
        estimates=episode.estimates,
        belief=episode.belief,
        detection=episode.detection,
        truth=made.truth,
    )
    write_result(directory / RESULT, scored)


def settings_in_words(table: PrintedTable, seeds: list[str]) -> tuple[str, ...]:
    """Return lines that say what the table was made with."""
    common = EstimatorConfig()
    shipped = {true_share(PaperRow(scene=scene, reference="mujoco", method="implicit (ours)")) for scene in SCENES}
    return (
        f"Mean (lowest…highest) over the seeds {', '.join(seeds)}, which draw the noise of {POINT_SD * 1e3:g} mm.",
        f"Corners lifted: {table.grasps}. k: membrane stiffness.",
        f"xpbd, equilibrium: the scene's mesh, b* = {STIFFNESS_SHARE:g} k,",
        f"lifts of {LIFT_SHARE:g} of the width in {LIFT_INCREMENTS} moves, each from rest.",
        f"mujoco: the scene as shipped, b* = {' or '.join(f'{share:.3g}' for share in sorted(shipped))} k.",
        f"Attached: above {THRESHOLD_SHARE:g} b*. Prior sd {common.prior_sd:.3g} k, "
        f"force sd {common.force_sd:g} k x spacing,",
        f"but {EXACT_FORCE_SD:g} for ours where the truth is an equilibrium of the same energy,",
        f"{common.samples} sample a frame. f: dt = {TIME_STEP:g} s, {SWEEPS_PER_STEP} sweeps,",
        f"hinges {HINGE_STIFFNESS:.3g} k. Adam: rate {adam.RATE:g} k, {adam.ADAM_STEPS} steps a frame.",
        f"{unscented.PATCHES} patches. Ours: attached where P > 0.5, with P / (1 - P) beforehand of",
        f"{common.prior.probability / (1 - common.prior.probability):.3g} times e^{common.prior.coupling:g}",
        f"for each attached neighbour, and b / (b + k) from {common.prior.components[0]:g} up where attached.",
        "Printed: one run each, b* = 0.1, b_thresh = 0.05, no units, no noise.",
    )
