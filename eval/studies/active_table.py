"""The paper's comparison of policies: entropy against steps, attachment loads, and when the attachments are found.

The paper's controllers and primitives move one grasp, as there. Our policy runs twice: kept to that grasp, and free to
choose its own. A step is an observation, counted from the first with tissue in the jaws. Once a run has ended, its last
figures stand.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float

from jiggle_mj.episode import ESTIMATE, RECORDING, RESULT
from jiggle_mj.estimator import EstimatorConfig
from jiggle_mj.options import PRIMITIVES, PolicyName, Sensing
from jiggle_mj.recording.estimate import EstimateRecording, read_estimate
from jiggle_mj.recording.mcap_files import truth_path
from jiggle_mj.recording.truth import read_truth
from jiggle_mj.scenes import load_scene

from ..metrics.detection_metrics import dilate
from ..metrics.result_file import Json, read_result
from ..metrics.safety import AttachmentLoads, attachment_loads
from ..metrics.truth_transfer import TransferredTruth, transfer
from ..runs.experiment import run_scene
from .figures import is_scored, mean_and_range, value
from .study import Study, Table

SCENES = ("arc", "line", "line_dot", "arc_line", "u_shape", "large_attach")
POLICIES: tuple[PolicyName, ...] = ("information", "one-grasp", "sl-d", "lg-d", "lg-h", *PRIMITIVES)
BEST = "PMP, best"
"""Name of the row of the primitive that reduces the entropy most in each run, as the paper reports it."""
OURS, THEIRS = "information", "sl-d"
"""The two policies that are compared run by run."""
STEPS = 40
"""Steps of a run."""
ENTROPY_STEPS = (10, 20, 40)
"""Steps after which the entropy is reported."""
FOUND_SHARE = 0.9
"""Share of the attachments that counts as found."""


@dataclass(frozen=True, kw_only=True)
class ActiveCell:
    """One run: a policy in a scene."""

    scene: str
    policy: str
    seed: int


@dataclass(frozen=True, kw_only=True)
class Course:
    """One run, step by step; the first step is that in which the jaws close."""

    entropy_reduction: Float[np.ndarray, " steps"]
    """Entropy of the prior minus that of the belief [nat]."""
    loads: AttachmentLoads
    detected: Bool[np.ndarray, "steps n"]
    truth: TransferredTruth
    faces: np.ndarray
    result: Json


Courses = Mapping[ActiveCell, Course]


@dataclass(frozen=True, kw_only=True)
class ActiveStudy(Study[ActiveCell, Course]):
    """Study of policies."""

    default_seeds: ClassVar[range] = range(10)
    sensing: Sensing
    scenes: tuple[str, ...] = SCENES
    policies: tuple[PolicyName, ...] = POLICIES

    def cells(self, seeds: Iterable[int]) -> tuple[ActiveCell, ...]:
        """Return every policy in every scene with every seed."""
        runs = product(self.scenes, self.policies, seeds)
        return tuple(ActiveCell(scene=scene, policy=policy, seed=seed) for scene, policy, seed in runs)

    def name(self, cell: ActiveCell) -> str:
        """Return the run's folder name."""
        return f"{cell.scene}-{cell.policy}-{self.sensing}-{cell.seed}"

    def run_cell(self, cell: ActiveCell, path: Path) -> None:
        """Run the policy into the cell's folder."""
        run_scene(
            load_scene(cell.scene),
            path,
            seed=cell.seed,
            sensing=self.sensing,
            policy=cell.policy,
            steps=STEPS,
            overwrite=True,
        )

    def is_current(self, cell: ActiveCell, path: Path) -> bool:
        """Say whether the folder holds a scored run of this version, with the settings that policies run with."""
        return is_scored(path, replace(EstimatorConfig(), refinement="frames"))

    def read(self, cell: ActiveCell, path: Path) -> Course:
        """Read a run's files."""
        return course(path)

    def summarise(self, results: Courses) -> Table:
        """Return means and ranges over the seeds, and beneath them our policy against SL-D."""
        runs = with_best(results)
        observable, seeds = observable_within_limits(runs), sorted({cell.seed for cell in runs})
        rows = []
        for scene, policy in dict.fromkeys((cell.scene, cell.policy) for cell in runs):
            cells = [ActiveCell(scene=scene, policy=policy, seed=seed) for seed in seeds]
            by_seed = {cell.seed: runs[cell] for cell in cells if cell in runs}
            rows.append((scene, policy, *_row(by_seed, {seed: observable[scene, seed] for seed in by_seed})))
        entropy = (f"entropy fallen after {steps} [nat]" for steps in ENTROPY_STEPS)
        loads = ("most true U [nJ]", "most force [mN]", "violations")
        return Table(
            headings=("scene", "policy", *entropy, *loads, f"steps to {FOUND_SHARE:.0%}", "plan s"),
            rows=tuple(rows),
            beneath=("", *comparison(runs, observable)),
        )


def course(directory: Path) -> Course:
    """Read the files of one run."""
    figures, estimated = read_result(directory / RESULT), read_estimate(directory / ESTIMATE)
    truth = read_truth(truth_path(directory / RECORDING))
    loads, by_index = attachment_loads(truth), {frame.index: k for k, frame in enumerate(truth.frames)}
    first = estimated.estimates[0].index
    rows = [by_index[min(first + k, truth.frames[-1].index)] for k in range(STEPS + 1)]
    latest, prior = _latest(estimated, first), value(figures, ("entropy", "prior"))
    assert prior is not None
    return Course(
        entropy_reduction=prior - np.array([estimated.estimates[k].entropy for k in latest]),
        loads=AttachmentLoads(energy=loads.energy[rows], force=loads.force[rows]),
        detected=np.array([estimated.estimates[k].probability > 0.5 for k in latest]),
        truth=transfer(estimated.sheet, truth, truth.frames[-1].index),
        faces=estimated.sheet.faces,
        result=figures,
    )


def _latest(estimated: EstimateRecording, first: int) -> list[int]:
    """Return the position of the estimate that stands after each step."""
    indices = np.array([estimate.index for estimate in estimated.estimates])
    return [int(np.searchsorted(indices, first + k, side="right")) - 1 for k in range(STEPS + 1)]


def with_best(runs: Courses) -> dict[ActiveCell, Course]:
    """Return the same runs with `BEST` in place of the primitives."""
    kept = {cell: run for cell, run in runs.items() if cell.policy not in PRIMITIVES}
    for cell in runs:
        if cell.policy in PRIMITIVES:
            candidates = [replace(cell, policy=name) for name in PRIMITIVES]
            tried = [runs[candidate] for candidate in candidates if candidate in runs]
            kept[replace(cell, policy=BEST)] = max(tried, key=lambda run: float(run.entropy_reduction[-1]))
    return kept


def observable_within_limits(runs: Courses) -> dict[tuple[str, int], Bool[np.ndarray, " n"]]:
    """Return the attachments that are observable in some run within the limits, by scene and seed."""
    found: dict[tuple[str, int], Bool[np.ndarray, " n"]] = {}
    for cell, run in runs.items():
        within = not (over_limit(run).any() or run.truth.observable is None)
        observable = run.truth.observable if within else np.zeros_like(run.truth.attached)
        known = found.get((cell.scene, cell.seed), np.zeros_like(run.truth.attached))
        found[cell.scene, cell.seed] = known | observable
    return found


def over_limit(run: Course) -> Bool[np.ndarray, " steps"]:
    """Return the steps in which the energy or a force is over its limit."""
    energy, force = (value(run.result, ("safety", limit)) for limit in ("limit_j", "limit_n"))
    return run.loads.over_limit(energy=energy, force=force)


def steps_until_found(run: Course, observable: Bool[np.ndarray, " n"]) -> int | None:
    """Return the steps until `FOUND_SHARE` of the particles are found within one ring, and stay found.

    Returns:
        None if they are not found, or if there are none.
    """
    if not observable.any():
        return None
    hits = np.array([(dilate(row, run.faces, 1) & observable).sum() for row in run.detected])
    found = hits >= FOUND_SHARE * observable.sum()
    last_missed = np.flatnonzero(~found)
    first = int(last_missed[-1]) + 1 if len(last_missed) else 0
    return first if first < len(found) else None


def _row(by_seed: Mapping[int, Course], observable: Mapping[int, Bool[np.ndarray, " n"]]) -> list[str]:
    """Return the figures of one scene and policy."""
    runs = list(by_seed.values())
    until = [steps_until_found(run, observable[seed]) for seed, run in by_seed.items()]
    steps = mean_and_range([None if count is None else float(count) for count in until], 1.0, 0)
    return [
        *(mean_and_range([float(run.entropy_reduction[k]) for run in runs], 1.0, 0) for k in ENTROPY_STEPS),
        mean_and_range([run.loads.most[0] for run in runs], 1e9, 2),
        mean_and_range([run.loads.most[1] for run in runs], 1e3, 1),
        f"{sum(over_limit(run).any() for run in runs)} of {len(runs)}",
        f"{steps} ({sum(count is not None for count in until)} of {len(until)})",
        mean_and_range([value(run.result, ("timing", "plan_s")) for run in runs], 1.0, 1),
    ]


def comparison(runs: Courses, observable: Mapping[tuple[str, int], Bool[np.ndarray, " n"]]) -> list[str]:
    """Return sentences that compare our policy with SL-D in the same scenes and seeds; none without a pair."""
    pairs = [
        (cell, run, runs[replace(cell, policy=THEIRS)])
        for cell, run in runs.items()
        if cell.policy == OURS and replace(cell, policy=THEIRS) in runs
    ]
    if not pairs:
        return []
    after = {f"after {STEPS} steps": [STEPS] * len(pairs)}
    after["for as long as both were within the limits"] = [
        _last_step_within_limits(ours, theirs) for _, ours, theirs in pairs
    ]
    sentences = []
    for when, steps in after.items():
        ratio = [
            ours.entropy_reduction[k] / theirs.entropy_reduction[k]
            for (_, ours, theirs), k in zip(pairs, steps, strict=True)
        ]
        ratios = mean_and_range(ratio, 1.0, 2)
        sentences.append(f"Entropy fallen {when}, {OURS} over {THEIRS}: {ratios} in {len(pairs)} runs.")
    ours = [steps_until_found(run, observable[cell.scene, cell.seed]) for cell, run, _ in pairs]
    theirs = [steps_until_found(run, observable[cell.scene, cell.seed]) for cell, _, run in pairs]
    both = [(a, b) for a, b in zip(ours, theirs, strict=True) if a is not None and b is not None]
    words = f"{FOUND_SHARE:.0%} of what could be seen was found by {OURS} in {len(ours) - ours.count(None)} of "
    words += f"{len(pairs)} runs, by {THEIRS} in {len(theirs) - theirs.count(None)}"
    if both:
        words += f"; in the {len(both)} of both after {np.mean([a for a, _ in both]):.0f} steps against "
        words += f"{np.mean([b for _, b in both]):.0f}"
    return [*sentences, words + "."]


def _last_step_within_limits(*runs: Course) -> int:
    """Return the last step before the first in which one of the runs is over a limit."""
    over = np.flatnonzero(np.any([over_limit(run) for run in runs], axis=0))
    return STEPS if not len(over) else max(int(over[0]) - 1, 0)
