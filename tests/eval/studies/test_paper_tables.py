"""The paper's tables: what is run again, what is printed, one true run of a small scene, the paper's own figures."""

import numpy as np
import pytest

from jiggle_mj.eval.studies import paper_tables
from jiggle_mj.eval.studies.paper_tables import METHODS, OWN_FORCE_SD, RULE, TABLES, Cell, cells, markdown, measure
from jiggle_mj.eval.studies.same_engine import STIFFNESS, sheet
from tests.support.result_keys import KEYS
from tests.support.scored_run import scored
from tests.support.small_scene import SCENE

CELL = Cell(scene="arc", reference="xpbd", method="implicit (ours)")


def test_a_same_engine_run_is_scored_and_not_repeated(tmp_path, monkeypatch):
    """One lift of a small sheet through the front door; Adam, which states no uncertainty, so that none is judged."""
    monkeypatch.setattr(paper_tables, "load_scene", lambda _: SCENE)
    cell, told = Cell(scene="small", reference="xpbd", method="Adam"), []
    first, again = (measure(TABLES["one-lift"], [cell], (3,), tmp_path, log=told.append)[cell][0] for _ in range(2))
    assert told == ["small, xpbd, Adam, seed 3"] and again == first
    detection, entropy = first["detection"], first["entropy"]
    assert isinstance(detection, dict) and isinstance(entropy, dict)
    assert first["estimator"] == "adam" and detection["n_attached"] == sheet(SCENE)[1].sum()
    assert f"{RULE * STIFFNESS:g} k" in detection["rule"]
    assert first["calibration"] == KEYS["calibration"]
    assert entropy["final"] is None and detection["average_precision"] > 0


def test_the_rule_is_half_of_the_references_own_stiffness():
    """Shipped scenes attach with 1 N/m, k = 30 N/m."""
    assert CELL.config.detect_above == pytest.approx(0.005)
    mujoco = Cell(scene="arc", reference="mujoco", method="Adam")
    assert mujoco.config.detect_above == pytest.approx(0.5 / 30) and mujoco.config.filter == "adam"


def test_only_ours_is_told_that_its_own_engine_is_exact():
    told = {cell for cell in cells() if cell.config.force_sd == OWN_FORCE_SD}
    assert {(cell.reference, cell.method) for cell in told} == {("equilibrium", "implicit (ours)")}
    assert {cell.config.force_sd for cell in cells()} == {OWN_FORCE_SD, METHODS["NNLS"].force_sd}


def test_every_method_meets_every_shape_and_reference_once():
    every = cells()
    assert len(set(every)) == len(every) == 3 * 5 * len(METHODS)
    assert len({method.filter for method in METHODS.values()}) == len(METHODS)


def test_printed_and_measured_stand_side_by_side():
    table = TABLES["one-lift"]
    lines = markdown(table, {CELL: [scored(), scored()]}).splitlines()
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
