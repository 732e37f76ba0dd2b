"""The paper's tables: what is run again, what is printed, one true run of a small scene, the paper's own figures."""

import numpy as np
import pytest

from jiggle_mj.eval.studies.paper_tables import (
    EXACT_FORCE_SD,
    METHODS,
    ROWS,
    TABLES,
    THRESHOLD_SHARE,
    PaperCell,
    PaperRow,
    PaperStudy,
)
from jiggle_mj.eval.studies.same_engine import STIFFNESS_SHARE, sheet
from jiggle_mj.eval.studies.study import run_study
from tests.support.result_keys import KEYS
from tests.support.scored_run import scored
from tests.support.small_scene import SCENE

ROW = PaperRow(scene="arc", reference="xpbd", method="implicit (ours)")


def test_a_same_engine_run_is_scored_and_not_repeated(tmp_path):
    """One lift of a small sheet through the estimator; Adam has no uncertainty, so its calibration stays null."""
    row, lines = PaperRow(scene="small", reference="xpbd", method="Adam"), []
    study = PaperStudy(table=TABLES["one-lift"], rows=(row,), load_scene=lambda _: SCENE)
    [cell] = study.cells((3,))
    first, again = (run_study(study, [cell], tmp_path, log=lines.append)[cell] for _ in range(2))
    assert lines == ["1 of 1: 1-small-xpbd-adam-3"] and again == first
    detection, entropy = first["detection"], first["entropy"]
    assert isinstance(detection, dict) and isinstance(entropy, dict)
    assert first["estimator"] == "adam" and detection["n_attached"] == sheet(SCENE)[1].sum()
    assert f"{THRESHOLD_SHARE * STIFFNESS_SHARE:g} k" in detection["rule"]
    assert first["calibration"] == KEYS["calibration"]
    assert entropy["final"] is None and detection["average_precision"] > 0


def test_the_rule_is_half_of_the_references_own_stiffness():
    """Shipped scenes attach with 1 N/m, k = 30 N/m."""
    assert ROW.config.detect_above == pytest.approx(0.005)
    mujoco = PaperRow(scene="arc", reference="mujoco", method="Adam")
    assert mujoco.config.detect_above == pytest.approx(0.5 / 30) and mujoco.config.filter == "adam"


def test_only_our_filter_gets_the_force_error_of_its_own_engine():
    exact = {row for row in ROWS if row.config.force_sd == EXACT_FORCE_SD}
    assert {(row.reference, row.method) for row in exact} == {("equilibrium", "implicit (ours)")}
    assert {row.config.force_sd for row in ROWS} == {EXACT_FORCE_SD, METHODS["NNLS"].force_sd}


def test_every_method_meets_every_shape_and_reference_once():
    assert len(set(ROWS)) == len(ROWS) == 3 * 5 * len(METHODS)
    assert len({method.filter for method in METHODS.values()}) == len(METHODS)


def test_printed_and_measured_figures_are_rows_of_one_table():
    study = PaperStudy(table=TABLES["one-lift"])
    lines = study.to_markdown({PaperCell(row=ROW, seed=seed): scored() for seed in range(2)}).splitlines()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines if line.startswith("|")]
    assert {len(row) for row in rows} == {len(rows[0])}
    assert ["line_dot", "its own engine", "Adam, printed", "/", "0"] in [row[:5] for row in rows]
    assert rows[-1][:5] == ["arc", "xpbd", "implicit (ours)", "50", "50"]


def test_the_printed_means_are_those_that_the_paper_claims():
    """Table 1's means, and that its "outperforms in all test cases" holds there."""
    printed = TABLES["simulation"].printed
    means = {method: np.mean([*by_scene.values()], axis=0).tolist() for method, by_scene in printed.items()}
    assert means == {"Ours": pytest.approx([98.16, 64.16]), "Adam": pytest.approx([81.38, 47.74])}
    assert all(np.greater(printed["Ours"][scene], printed["Adam"][scene]).all() for scene in printed["Ours"])
