"""The comparison of policies: steps counted by hand, the best primitive, ours beside SL-D, the curves' file."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from jiggle_mj.eval.metrics.safety import Borne
from jiggle_mj.eval.metrics.truth_transfer import TransferredTruth
from jiggle_mj.eval.studies import active_table
from jiggle_mj.eval.studies.active_table import (
    BEST,
    STEPS,
    Course,
    knowable,
    markdown,
    steps_until,
    with_best,
    write_curves,
)
from jiggle_mj.eval.studies.main_table import carry_out

FACES = np.array([[k, k + 1, k + 2] for k in range(8)])
ATTACHED = np.arange(10) < 4


def course(total: float, *, energy: float = 1e-9, found_after: int = 5, load: float = 1.0) -> Course:
    """Entropy that falls evenly by `total`; all attached are found at once."""
    detected = np.zeros((STEPS + 1, 10), dtype=bool)
    detected[found_after:] = ATTACHED
    return Course(
        fallen=np.linspace(0, total, STEPS + 1),
        borne=Borne(energy=np.full(STEPS + 1, energy), force=np.full(STEPS + 1, 1e-3)),
        detected=detected,
        truth=TransferredTruth(attached=ATTACHED, stiffness=1.0 * ATTACHED, load=load * ATTACHED),
        faces=FACES,
        result={"safety": {"limit_j": 1e-7, "limit_n": 1e-2}, "timing": {"plan_s": 2.0}},
    )


def test_a_run_has_found_what_it_keeps_finding():
    run = course(100.0, found_after=7)
    assert steps_until(run, ATTACHED) == 7
    lost = run.detected.copy()
    lost[20] = False
    assert steps_until(Course(**{**vars(run), "detected": lost}), ATTACHED) == 21
    assert steps_until(course(100.0, found_after=STEPS + 1), ATTACHED) is None
    assert steps_until(run, np.zeros(10, dtype=bool)) is None


def test_the_best_primitive_stands_for_all():
    runs = {("arc", "pmp-up", 0): course(50.0), ("arc", "pmp-left", 0): course(80.0), ("arc", "sl-d", 0): course(60.0)}
    best = with_best(runs)
    assert set(best) == {("arc", BEST, 0), ("arc", "sl-d", 0)} and best["arc", BEST, 0].fallen[-1] == 80


def test_what_only_a_run_beyond_the_limits_loaded_counts_for_nobody():
    runs = {("arc", "sl-d", 0): course(60.0, load=0.0), ("arc", "pmp-up", 0): course(90.0, energy=1e-6)}
    assert not knowable(runs)["arc", 0].any()
    runs["arc", "information", 0] = course(90.0)
    assert (knowable(runs)["arc", 0] == ATTACHED).all()


def test_ours_stands_beside_theirs_in_words_and_violations_are_counted():
    runs = {
        ("arc", "information", 0): course(150.0, found_after=6),
        ("arc", "sl-d", 0): course(100.0, found_after=12),
        ("arc", "pmp-up", 0): course(120.0, energy=1e-6),
    }
    text = markdown(runs)
    assert "after 40 steps, information over sl-d: 1.50 in 1 runs" in text
    assert "found by information in 1 of 1 runs, by sl-d in 1; in the 1 of both after 6 steps against 12" in text
    (ours,) = [line for line in text.splitlines() if line.startswith("| arc | information")]
    (torn,) = [line for line in text.splitlines() if line.startswith(f"| arc | {BEST}")]
    assert "0 of 1" in ours and "1 of 1" in torn and "6 (1 of 1)" in ours


def test_while_both_are_within_the_limits_only_those_steps_count():
    theirs = course(100.0)
    theirs.borne.energy[21:] = 1e-6
    late = replace(theirs, fallen=np.concatenate([np.full(21, 20.0), np.full(STEPS - 20, 100.0)]))
    text = markdown({("arc", "information", 0): course(150.0), ("arc", "sl-d", 0): late})
    assert "within the limits, information over sl-d: 3.75 in 1 runs" in text


def test_the_curves_are_the_same_bytes_twice(tmp_path):
    runs = {(scene, policy, 0): course(9.0) for scene in ("arc", "line") for policy in ("information", "sl-d")}
    for name in ("one.html", "two.html"):
        write_curves(runs, tmp_path / name)
    page = (tmp_path / "one.html").read_text()
    assert page == (tmp_path / "two.html").read_text()
    assert "arc: entropy fallen" in page and "line: mean boundary energy" in page


def test_only_what_is_missing_is_run(tmp_path, monkeypatch):
    done, left = {"arc-sl-d-particles-0"}, []
    monkeypatch.setattr(active_table, "finished", lambda folder, _: {} if folder.name in done else None)
    monkeypatch.setattr(active_table, "carry_out", lambda runs, executor, log: left.extend(runs))
    monkeypatch.setattr(active_table, "course", lambda folder: replace(course(1.0), result={"folder": folder.name}))
    with ThreadPoolExecutor(1) as executor:
        found = active_table.measure(
            ("arc",), ("sl-d", "lg-d"), (0,), tmp_path, sensing="particles", executor=executor, log=left.append
        )
    assert left == ["arc-lg-d-particles-0"]
    assert [one.result["folder"] for one in found.values()] == ["arc-sl-d-particles-0", "arc-lg-d-particles-0"]


def test_a_failed_run_says_so_and_ends_the_table():
    def fails():
        raise ValueError("torn")

    said = []
    with ThreadPoolExecutor(1) as executor, pytest.raises(ValueError, match="torn"):
        carry_out({"one": dict, "two": fails, "three": dict}, executor, log=said.append)
    assert said == ["1 of 3: one"]
