"""The paper's comparison of policies: entropy against steps, what the attachments bore, and when they were found.

Six scenes. The paper's controllers and primitives move one grasp, as there; ours runs twice, kept to that grasp and
free to choose its own. A step is an observation, counted from the first with tissue in the jaws; once a run has ended,
its last figures stand.
"""

from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Bool, Float
from plotly.subplots import make_subplots

from jiggle_mj.episode import ESTIMATE, RECORDING, RESULT
from jiggle_mj.estimator import EstimatorConfig
from jiggle_mj.options import PRIMITIVES, PolicyName, Sensing
from jiggle_mj.recording.estimate import EstimateRecording, read_estimate
from jiggle_mj.recording.mcap_files import truth_path
from jiggle_mj.recording.truth import read_truth
from jiggle_mj.scenes import load_scene

from ..metrics.detection import dilate
from ..metrics.safety import Borne, borne
from ..metrics.score import Json, read_result
from ..metrics.truth_transfer import TransferredTruth, carry
from ..runs.experiment import run_scene
from .main_table import carry_out, cell, finished, value

SCENES = ("arc", "line", "line_dot", "arc_line", "u_shape", "large_attach")
POLICIES: tuple[PolicyName, ...] = ("information", "one-grasp", "sl-d", "lg-d", "lg-h", *PRIMITIVES)
BEST = "PMP, best"
"""The primitive with the most entropy reduction in each run, as the paper gives it."""
OURS, THEIRS = "information", "sl-d"
STEPS = 40
MARKS = (10, 20, 40)
"""Steps after which the entropy is given."""
FOUND = 0.9
"""Share of the attachments that a run is to find."""
FILE = "active.html"


@dataclass(frozen=True, kw_only=True)
class Course:
    """One run, step by step; the first step is that in which the jaws close."""

    fallen: Float[np.ndarray, " steps"]
    """By how much the entropy has fallen since the prior [nat]."""
    borne: Borne
    detected: Bool[np.ndarray, "steps n"]
    truth: TransferredTruth
    faces: np.ndarray
    result: Json


Runs = dict[tuple[str, str, int], Course]
"""By scene, policy and seed."""


def measure(
    scenes: Iterable[str],
    policies: Iterable[PolicyName],
    seeds: Iterable[int],
    directory: Path,
    *,
    sensing: Sensing,
    executor: Executor,
    log: Callable[[str], None],
) -> Runs:
    """Run what has not been run, and read all of it.

    Args:
        scenes: to run.
        policies: in each.
        seeds: of noise and samples.
        directory: holds a folder for each run.
        sensing: what the estimator sees.
        executor: runs several at a time.
        log: told of each run that is done.
    """
    names = {(scene, policy, seed): f"{scene}-{policy}-{sensing}-{seed}"
             for scene, policy, seed in product(scenes, policies, seeds)}  # fmt: skip
    config = replace(EstimatorConfig(), refinement="frames")
    left = {
        name: partial(_run, scene, policy, seed, directory / name, sensing)
        for (scene, policy, seed), name in names.items()
        if finished(directory / name, config) is None
    }
    carry_out(left, executor, log=log)
    return {key: course(directory / name) for key, name in names.items()}


def _run(scene: str, policy: str, seed: int, directory: Path, sensing: Sensing) -> None:
    run_scene(load_scene(scene), directory, seed=seed, sensing=sensing, policy=policy, steps=STEPS, overwrite=True)


def course(directory: Path) -> Course:
    """Read one run's files."""
    figures, found = read_result(directory / RESULT), read_estimate(directory / ESTIMATE)
    truth = read_truth(truth_path(directory / RECORDING))
    loads, by_index = borne(truth), {frame.index: k for k, frame in enumerate(truth.frames)}
    first = found.estimates[0].index
    rows = [by_index[min(first + k, truth.frames[-1].index)] for k in range(STEPS + 1)]
    latest, prior = _latest(found, first), value(figures, ("entropy", "prior"))
    assert prior is not None
    return Course(
        fallen=prior - np.array([found.estimates[k].entropy for k in latest]),
        borne=Borne(energy=loads.energy[rows], force=loads.force[rows]),
        detected=np.array([found.estimates[k].probability > 0.5 for k in latest]),
        truth=carry(found.sheet, truth, truth.frames[-1].index),
        faces=found.sheet.faces,
        result=figures,
    )


def _latest(found: EstimateRecording, first: int) -> list[int]:
    """Which estimate stands after each step."""
    indices = np.array([estimate.index for estimate in found.estimates])
    return [int(np.searchsorted(indices, first + k, side="right")) - 1 for k in range(STEPS + 1)]


def with_best(runs: Runs) -> Runs:
    """The same with `BEST` instead of the primitives."""
    rest = {key: run for key, run in runs.items() if key[1] not in PRIMITIVES}
    for scene, policy, seed in runs:
        if policy in PRIMITIVES:
            tried = [runs[scene, name, seed] for name in PRIMITIVES if (scene, name, seed) in runs]
            rest[scene, BEST, seed] = max(tried, key=lambda run: float(run.fallen[-1]))
    return rest


def knowable(runs: Runs) -> dict[tuple[str, int], Bool[np.ndarray, " n"]]:
    """Attachments that some run within the limits loaded enough to show, by scene and seed."""
    found: dict[tuple[str, int], Bool[np.ndarray, " n"]] = {}
    for (scene, _, seed), run in runs.items():
        within = not (beyond(run).any() or run.truth.observable is None)
        loaded = run.truth.observable if within else np.zeros_like(run.truth.attached)
        found[scene, seed] = found.get((scene, seed), np.zeros_like(run.truth.attached)) | loaded
    return found


def beyond(run: Course) -> Bool[np.ndarray, " steps"]:
    """Steps beyond the limit on the energy or that on a force."""
    energy, force = (value(run.result, ("safety", limit)) for limit in ("limit_j", "limit_n"))
    return run.borne.passed(energy=energy, force=force)


def steps_until(run: Course, known: Bool[np.ndarray, " n"]) -> int | None:
    """Steps until `FOUND` of those particles are found within one ring, and stay so; None if they are not."""
    if not known.any():
        return None
    found = np.array([(dilate(row, run.faces, 1) & known).sum() for row in run.detected]) >= FOUND * known.sum()
    last_missed = np.flatnonzero(~found)
    first = int(last_missed[-1]) + 1 if len(last_missed) else 0
    return first if first < len(found) else None


def markdown(runs: Runs) -> str:
    """Means and ranges over the seeds, and then ours beside SL-D."""
    runs = with_best(runs)
    known, seeds = knowable(runs), sorted({seed for *_, seed in runs})
    headings = [f"entropy fallen after {mark} [nat]" for mark in MARKS]
    headings += ["most true U [nJ]", "most force [mN]", "violations", f"steps to {FOUND:.0%}", "plan s"]
    lines = ["| scene | policy | " + " | ".join(headings) + " |", "|" + "---|" * (len(headings) + 2)]
    for scene, policy in dict.fromkeys((scene, policy) for scene, policy, _ in runs):
        mine = {seed: runs[scene, policy, seed] for seed in seeds if (scene, policy, seed) in runs}
        until = [steps_until(run, known[scene, seed]) for seed, run in mine.items()]
        cells = [cell([float(run.fallen[mark]) for run in mine.values()], 1.0, 0) for mark in MARKS]
        cells += [
            cell([run.borne.most[0] for run in mine.values()], 1e9, 2),
            cell([run.borne.most[1] for run in mine.values()], 1e3, 1),
            f"{sum(beyond(run).any() for run in mine.values())} of {len(mine)}",
            f"{cell([None if one is None else float(one) for one in until], 1.0, 0)}"
            f" ({sum(one is not None for one in until)} of {len(until)})",
            cell([value(run.result, ("timing", "plan_s")) for run in mine.values()], 1.0, 1),
        ]
        lines.append(f"| {scene} | {policy} | " + " | ".join(cells) + " |")
    return "\n".join([*lines, "", *beside(runs, known)])


def beside(runs: Runs, known: Mapping[tuple[str, int], Bool[np.ndarray, " n"]]) -> list[str]:
    """Ours against SL-D in the same scenes and seeds, in words."""
    pairs = [
        (key, run, runs[key[0], THEIRS, key[2]])
        for key, run in runs.items()
        if key[1] == OURS and (key[0], THEIRS, key[2]) in runs
    ]
    if not pairs:
        return []
    after = {f"after {STEPS} steps": [STEPS] * len(pairs)}
    after["for as long as both were within the limits"] = [_within(ours, theirs) for _, ours, theirs in pairs]
    said = []
    for when, steps in after.items():
        ratio = [ours.fallen[k] / theirs.fallen[k] for (_, ours, theirs), k in zip(pairs, steps, strict=True)]
        said.append(f"Entropy fallen {when}, {OURS} over {THEIRS}: {cell(ratio, 1.0, 2)} in {len(pairs)} runs.")
    ours = [steps_until(run, known[scene, seed]) for (scene, _, seed), run, _ in pairs]
    theirs = [steps_until(run, known[scene, seed]) for (scene, _, seed), _, run in pairs]
    both = [(a, b) for a, b in zip(ours, theirs, strict=True) if a is not None and b is not None]
    words = f"{FOUND:.0%} of what could be seen was found by {OURS} in {len(ours) - ours.count(None)} of {len(pairs)} "
    words += f"runs, by {THEIRS} in {len(theirs) - theirs.count(None)}"
    if both:
        words += f"; in the {len(both)} of both after {np.mean([a for a, _ in both]):.0f} steps against "
        words += f"{np.mean([b for _, b in both]):.0f}"
    return [*said, words + "."]


def _within(*runs: Course) -> int:
    """The last step before the first at which one is beyond a limit."""
    passed = np.flatnonzero(np.any([beyond(run) for run in runs], axis=0))
    return STEPS if not len(passed) else max(int(passed[0]) - 1, 0)


def write_curves(runs: Runs, path: Path) -> None:
    """Entropy and true energy against steps, a scene a row, a policy a colour; thin lines are single runs."""
    runs = with_best(runs)
    scenes = list(dict.fromkeys(scene for scene, *_ in runs))
    titles = [f"{scene}: {what}" for scene in scenes for what in ("entropy fallen [nat]", "mean boundary energy [J]")]
    figure = make_subplots(rows=len(scenes), cols=2, subplot_titles=titles, vertical_spacing=0.3 / len(scenes) / 2)
    colours = dict(zip(dict.fromkeys(policy for _, policy, _ in runs), COLOURS, strict=False))
    step = np.arange(STEPS + 1)
    for (scene, policy), colour in ((key, colours[key[1]]) for key in dict.fromkeys(key[:2] for key in runs)):
        mine, row = [run for key, run in runs.items() if key[:2] == (scene, policy)], 1 + scenes.index(scene)
        for column, rows in enumerate(([run.fallen for run in mine], [run.borne.energy for run in mine]), start=1):
            for one in rows:
                line = go.Scatter(x=step, y=one, line={"color": colour, "width": 0.7}, opacity=0.5, showlegend=False)
                figure.add_trace(line, row=row, col=column)
            first = row == column == 1
            mean = go.Scatter(x=step, y=np.mean(rows, axis=0), line={"color": colour, "width": 2.5}, name=policy,
                              legendgroup=policy, showlegend=first)  # fmt: skip
            figure.add_trace(mean, row=row, col=column)
        figure.update_yaxes(type="log", row=row, col=2)
    for row, scene in enumerate(scenes, start=1):
        allowed = value(next(run for key, run in runs.items() if key[0] == scene).result, ("safety", "limit_j"))
        limit = go.Scatter(x=step[[0, -1]], y=[allowed] * 2, line={"dash": "dot", "color": "black"},
                           name="limit", showlegend=row == 1)  # fmt: skip
        figure.add_trace(limit, row=row, col=2)
    figure.update_layout(height=330 * len(scenes), template="plotly_white", title="Policies, step by step")
    figure.write_html(path, include_plotlyjs=True, div_id="active")


COLOURS = ("#d55e00", "#cc79a7", "#0072b2", "#56b4e9", "#009e73", "#e69f00")
