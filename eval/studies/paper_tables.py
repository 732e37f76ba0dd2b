"""The paper's two tables of simulated estimation, printed figures beside measured ones.

Table 1 (`simulation`): four corner grasps. Appendix (`one-lift`): the first of them. Five shapes, each method against
three references: the two engines of `same_engine`, and MuJoCo's vertices with noise, by `run_scene`. The Gaussian
methods share the prior and the paper's rule, attached above half of b*; ours states P(attached), and knows no b*. Each
run has a folder, and is not repeated.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from jiggle_mj.episode import ESTIMATE, RESULT, check_directory, clear_directory, estimate
from jiggle_mj.estimator import Estimator, EstimatorConfig
from jiggle_mj.estimator.filters import adam, unscented
from jiggle_mj.estimator.physics.simulator import HINGE_STIFFNESS, SWEEPS_PER_STEP, TIME_STEP
from jiggle_mj.scenes import Scene, load_scene
from jiggle_mj.scenes.scene.programme import grasp_points

from ..metrics.score import Json, result, with_truth, write_result
from ..runs.experiment import run_scene
from .main_table import cell, finished, value
from .same_engine import HEIGHT, INCREMENTS, NOISE, STIFFNESS, Engine, same_engine

Reference = Literal["xpbd", "equilibrium", "mujoco"]
REFERENCES: tuple[Reference, ...] = ("xpbd", "equilibrium", "mujoco")
RULE = 0.5
"""b_thresh / b*, as in the paper (0.05 / 0.1)."""
OWN_FORCE_SD = 5e-4
"""Force that the model gets wrong, as our filter is told where the truth is its own equilibrium [k x spacing].

The others are not told: least squares take it for the noise of the positions too, the unscented filter for a tolerance.
"""
METHODS = {
    "explicit (the paper's filter)": EstimatorConfig(filter="explicit"),
    "Adam": EstimatorConfig(filter="adam"),
    "NNLS": EstimatorConfig(filter="nnls"),
    "unscented, patches": EstimatorConfig(filter="unscented"),
    "implicit (ours)": EstimatorConfig(),
}
"""Name and settings of each row."""
SCENES = ("arc", "line", "line_dot", "arc_line", "u_shape")
FIGURES = (
    ("PCD %", ("detection", "by_dilation", "0", "pcd"), 100.0, 0),
    ("PUG %", ("detection", "by_dilation", "0", "pug"), 100.0, 0),
    ("PCD % one ring", ("detection", "by_dilation", "1", "pcd"), 100.0, 0),
    ("PUG % one ring", ("detection", "by_dilation", "1", "pug"), 100.0, 0),
    ("NEES/dof attached", ("calibration", "nees_attached"), 1.0, 2),
    ("coverage of 90 %, attached", ("calibration", "coverage_attached"), 1.0, 2),
    ("ECE", ("calibration", "ece"), 1.0, 3),
    ("update s", ("timing", "update_s", "median"), 1.0, 2),
)


@dataclass(frozen=True, kw_only=True)
class PaperTable:
    """One table of the paper."""

    grasps: int
    printed: dict[str, dict[str, tuple[float | None, float]]]
    """PCD and PUG in per cent, by method and scene; None where the paper prints a slash."""


TABLES = {
    "simulation": PaperTable(
        grasps=4,
        printed={
            "Ours": {"arc": (100, 87.1), "line": (100, 43.3), "line_dot": (96.0, 48.9), "arc_line": (97.3, 65.5),
                     "u_shape": (97.5, 76.0)},
            "Adam": {"arc": (82.1, 59.3), "line": (85.7, 40.0), "line_dot": (68.0, 34.7), "arc_line": (83.8, 51.8),
                     "u_shape": (87.3, 52.9)},
        },
    ),
    "one-lift": PaperTable(
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
class Cell:
    """One line of a measured table: a scene, a reference and a method over all seeds."""

    scene: str
    reference: Reference
    method: str

    @property
    def config(self) -> EstimatorConfig:
        """The method's settings with the paper's rule for this b*; ours with its own engine's model error."""
        found = replace(METHODS[self.method], detect_above=RULE * true_share(self))
        exact = self.reference == "equilibrium" and found.filter == "implicit"
        return replace(found, force_sd=OWN_FORCE_SD) if exact else found


def true_share(cell: Cell) -> float:
    """b* of an attached particle [membrane stiffness]."""
    if cell.reference != "mujoco":
        return STIFFNESS
    scene = load_scene(cell.scene)
    return scene.attachments[0].stiffness / scene.declared.membrane_stiffness


def cells() -> tuple[Cell, ...]:
    """All lines, those of one reference together."""
    return tuple(
        Cell(scene=scene, reference=reference, method=method)
        for reference in REFERENCES
        for scene in SCENES
        for method in METHODS
    )


def measure(
    table: PaperTable, cells: Iterable[Cell], seeds: Iterable[int], directory: Path, *, log: Callable[[str], None]
) -> dict[Cell, list[Json]]:
    """Run what has not been run, and read all results.

    Args:
        table: says how many corners are lifted.
        cells: lines of the table.
        seeds: of the noise, for each line.
        directory: holds a folder for each run.
        log: told of each run before it starts.
    """
    seeds, found = tuple(seeds), {}
    for one in cells:
        found[one] = []
        for seed in seeds:
            name = f"{table.grasps}-{one.scene}-{one.reference}-{one.config.filter}-{seed}"
            done = finished(directory / name, one.config)
            if done is None:
                log(f"{one.scene}, {one.reference}, {one.method}, seed {seed}")
                done = run(one, table.grasps, seed, directory / name)
            found[one].append(done)
    return found


def run(cell: Cell, grasps: int, seed: int, directory: Path) -> Json:
    """One run, replacing what is in its folder; the content of result.json."""
    scene = load_scene(cell.scene)
    if cell.reference != "mujoco":
        return run_same_engine(scene, cell.reference, directory, seed=seed, grasps=grasps, config=cell.config)
    scene = replace(scene, programme=replace(scene.programme, points=grasp_points(scene)[:grasps]))
    return run_scene(scene, directory, seed=seed, sensing="particles", config=cell.config, overwrite=True)


def run_same_engine(
    scene: Scene, engine: Engine, directory: Path, *, seed: int, grasps: int, config: EstimatorConfig
) -> Json:
    """Truth by `same_engine`, estimate through the front door, score; estimate.mcap and result.json."""
    check_directory(directory, (), overwrite=True)
    clear_directory(directory, (ESTIMATE, RESULT))
    made = same_engine(scene, engine, seed=seed, grasps=grasps)
    estimator = Estimator(made.declaration, config=config)
    episode = estimate(made.observations, estimator, directory / ESTIMATE)
    unscored = result(
        scene=scene.name,
        seed=seed,
        sensing="particles",
        estimator=config.filter,
        policy="corners",
        sheet=episode.sheet,
        estimates=episode.estimates,
        detection=episode.detection,
        prior_entropy=episode.prior_entropy,
        n_frames=episode.n_frames,
        skipped=episode.skipped,
    )
    scored = with_truth(
        unscored,
        sheet=episode.sheet,
        estimates=episode.estimates,
        belief=episode.belief,
        detection=episode.detection,
        truth=made.truth,
    )
    write_result(directory / RESULT, scored)
    return scored


def markdown(table: PaperTable, results: dict[Cell, list[Json]]) -> str:
    """Printed figures first, then one line for each scene, reference and method; the settings beneath."""
    headings = [name for name, *_ in FIGURES]
    lines = ["| scene | reference | method | " + " | ".join(headings) + " |", "|" + "---|" * (len(headings) + 3)]
    for method, by_scene in table.printed.items():
        for scene, (pcd, pug) in by_scene.items():
            shares = ["/" if share is None else f"{share:g}" for share in (pcd, pug)]
            rest = ["" for _ in headings[2:]]
            lines.append("| " + " | ".join([scene, "its own engine", f"{method}, printed", *shares, *rest]) + " |")
    for one, runs in results.items():
        figures = [cell([value(run, path) for run in runs], factor, digits) for _, path, factor, digits in FIGURES]
        lines.append("| " + " | ".join([one.scene, one.reference, one.method, *figures]) + " |")
    seeds = sorted({str(run["seed"]) for runs in results.values() for run in runs}, key=int)
    return "\n".join([*lines, "", settings_in_words(table, seeds)])


def settings_in_words(table: PaperTable, seeds: list[str]) -> str:
    """What the table was made with."""
    common = EstimatorConfig()
    shipped = {true_share(Cell(scene=scene, reference="mujoco", method="implicit (ours)")) for scene in SCENES}
    return "\n".join(
        (
            f"Mean (lowest…highest) over the seeds {', '.join(seeds)}, which draw the noise of {NOISE * 1e3:g} mm.",
            f"Corners lifted: {table.grasps}. k: membrane stiffness.",
            f"xpbd, equilibrium: the scene's mesh, b* = {STIFFNESS:g} k,",
            f"lifts of {HEIGHT:g} of the width in {INCREMENTS} moves, each from rest.",
            f"mujoco: the scene as shipped, b* = {' or '.join(f'{share:.3g}' for share in sorted(shipped))} k.",
            f"Attached: above {RULE:g} b*. Prior sd {common.prior_sd:.3g} k, force sd {common.force_sd:g} k x spacing,",
            f"but {OWN_FORCE_SD:g} for ours where the truth is an equilibrium of the same energy,",
            f"{common.samples} sample a frame. f: dt = {TIME_STEP:g} s, {SWEEPS_PER_STEP} sweeps,",
            f"hinges {HINGE_STIFFNESS:.3g} k. Adam: rate {adam.RATE:g} k, {adam.ADAM_STEPS} steps a frame.",
            f"{unscented.PATCHES} patches. Ours: attached where P > 0.5, with P / (1 - P) beforehand of",
            f"{common.prior.probability / (1 - common.prior.probability):.3g} times e^{common.prior.coupling:g}",
            f"for each attached neighbour, and b / (b + k) from {common.prior.components[0]:g} up where attached.",
            "Printed: one run each, b* = 0.1, b_thresh = 0.05, no units, no noise.",
        )
    )
