"""The comparison of policies: steps counted by hand, the best primitive, ours against SL-D, the curves' file."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from jiggle_mj.eval.metrics.safety import AttachmentLoads
from jiggle_mj.eval.metrics.truth_transfer import TransferredTruth
from jiggle_mj.eval.studies.active_curves import write_curves
from jiggle_mj.eval.studies.active_table import (
    BEST,
    STEPS,
    ActiveCell,
    ActiveStudy,
    Course,
    observable_within_limits,
    steps_until_found,
    with_best,
)
from jiggle_mj.eval.studies.study import run_study

STUDY = ActiveStudy(sensing="particles")
FACES = np.array([[k, k + 1, k + 2] for k in range(8)])
ATTACHED = np.arange(10) < 4


def course(total: float, *, energy: float = 1e-9, found_after: int = 5, load: float = 1.0) -> Course:
    """Return a run whose entropy falls evenly by `total`; all attached particles are found at once."""
    detected = np.zeros((STEPS + 1, 10), dtype=bool)
    detected[found_after:] = ATTACHED
    return Course(
        entropy_reduction=np.linspace(0, total, STEPS + 1),
        loads=AttachmentLoads(energy=np.full(STEPS + 1, energy), force=np.full(STEPS + 1, 1e-3)),
        detected=detected,
        truth=TransferredTruth(attached=ATTACHED, stiffness=1.0 * ATTACHED, load=load * ATTACHED),
        faces=FACES,
        result={"safety": {"limit_j": 1e-7, "limit_n": 1e-2}, "timing": {"plan_s": 2.0}},
    )


def cell(scene: str, policy: str) -> ActiveCell:
    """Return the cell of seed 0."""
    return ActiveCell(scene=scene, policy=policy, seed=0)


def test_a_run_has_found_what_it_keeps_finding():
    run = course(100.0, found_after=7)
    assert steps_until_found(run, ATTACHED) == 7
    lost = run.detected.copy()
    lost[20] = False
    assert steps_until_found(replace(run, detected=lost), ATTACHED) == 21
    assert steps_until_found(course(100.0, found_after=STEPS + 1), ATTACHED) is None
    assert steps_until_found(run, np.zeros(10, dtype=bool)) is None


def test_the_best_primitive_stands_for_all():
    totals = {"pmp-up": 50.0, "pmp-left": 80.0, "sl-d": 60.0}
    runs = {cell("arc", policy): course(total) for policy, total in totals.items()}
    best = with_best(runs)
    assert set(best) == {cell("arc", BEST), cell("arc", "sl-d")}
    assert best[cell("arc", BEST)].entropy_reduction[-1] == 80


def test_what_only_a_run_beyond_the_limits_loaded_counts_for_nobody():
    runs = {cell("arc", "sl-d"): course(60.0, load=0.0), cell("arc", "pmp-up"): course(90.0, energy=1e-6)}
    assert not observable_within_limits(runs)["arc", 0].any()
    runs[cell("arc", "information")] = course(90.0)
    assert (observable_within_limits(runs)["arc", 0] == ATTACHED).all()


def test_ours_is_compared_with_theirs_in_words_and_violations_are_counted():
    runs = {
        cell("arc", "information"): course(150.0, found_after=6),
        cell("arc", "sl-d"): course(100.0, found_after=12),
        cell("arc", "pmp-up"): course(120.0, energy=1e-6),
    }
    text = STUDY.to_markdown(runs)
    assert "after 40 steps, information over sl-d: 1.50 in 1 runs" in text
    assert "found by information in 1 of 1 runs, by sl-d in 1; in the 1 of both after 6 steps against 12" in text
    (ours,) = [line for line in text.splitlines() if line.startswith("| arc | information")]
    (torn,) = [line for line in text.splitlines() if line.startswith(f"| arc | {BEST}")]
    assert "0 of 1" in ours and "1 of 1" in torn and "6 (1 of 1)" in ours


def test_while_both_are_within_the_limits_only_those_steps_count():
    theirs = course(100.0)
    theirs.loads.energy[21:] = 1e-6
    late = replace(theirs, entropy_reduction=np.concatenate([np.full(21, 20.0), np.full(STEPS - 20, 100.0)]))
    text = STUDY.to_markdown({cell("arc", "information"): course(150.0), cell("arc", "sl-d"): late})
    assert "within the limits, information over sl-d: 3.75 in 1 runs" in text


def test_the_curves_are_the_same_bytes_twice(tmp_path):
    runs = {cell(scene, policy): course(9.0) for scene in ("arc", "line") for policy in ("information", "sl-d")}
    for name in ("one.html", "two.html"):
        write_curves(runs, tmp_path / name)
    page = (tmp_path / "one.html").read_text()
    assert page == (tmp_path / "two.html").read_text()
    assert "arc: entropy fallen" in page and "line: mean boundary energy" in page


def test_only_what_is_missing_is_run(tmp_path):
    current, ran = {"arc-sl-d-particles-0"}, []

    class Counted(ActiveStudy):
        def run_cell(self, cell: ActiveCell, path: Path) -> None:
            ran.append(path.name)

        def is_current(self, cell: ActiveCell, path: Path) -> bool:
            return path.name in current

        def read(self, cell: ActiveCell, path: Path) -> Course:
            return replace(course(1.0), result={"folder": path.name})

    study = Counted(sensing="particles", scenes=("arc",), policies=("sl-d", "lg-d"))
    with ThreadPoolExecutor(1) as executor:
        found = run_study(study, study.cells((0,)), tmp_path, executor=executor)
    assert ran == ["arc-lg-d-particles-0"]
    assert [run.result["folder"] for run in found.values()] == ["arc-sl-d-particles-0", "arc-lg-d-particles-0"]
