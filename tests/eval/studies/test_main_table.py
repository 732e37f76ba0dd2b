"""The main table: what is run again, what is not, and the Markdown by hand."""

import json

import numpy as np
import pytest

from jiggle_mj.episode import settings
from jiggle_mj.estimator import EstimatorConfig
from jiggle_mj.eval.studies.main_table import MAIN, MainCell, MainRow, MainStudy
from jiggle_mj.eval.studies.study import run_study
from jiggle_mj.recording.estimate import EstimateWriter
from tests.support.scored_run import SHEET, scored, unscored, written

ROW = MainRow(scene="arc", sensing="particles")


@pytest.fixture
def ran():
    """Names of the folders that were run."""
    return []


@pytest.fixture
def study(ran):
    """The study of one row, which writes folders instead of minutes of MuJoCo."""

    def run_scene(_scene, folder, *, seed, sensing, overwrite):
        assert sensing == "particles" and overwrite
        folder.mkdir(exist_ok=True, parents=True)
        for old in folder.iterdir():
            old.unlink()
        written(folder, settings(EstimatorConfig()))
        figures = scored() | {"seed": seed}
        (folder / "result.json").write_text(json.dumps(figures))
        ran.append(folder.name)
        return figures

    return MainStudy(rows=(ROW,), run_scene=run_scene)


def test_a_table_goes_on_where_it_stopped(study, ran, tmp_path):
    lines = []
    run_study(study, study.cells((0,)), tmp_path, log=lines.append)
    results = run_study(study, study.cells((0, 1)), tmp_path, log=lines.append)
    assert ran == ["arc-particles-0", "arc-particles-1"]
    assert lines == ["1 of 1: arc-particles-0", "1 of 1: arc-particles-1"]
    assert [figures["seed"] for figures in results.values()] == [0, 1]


def test_a_run_that_was_not_scored_or_had_other_settings_is_made_again(study, ran, tmp_path):
    run_study(study, study.cells((0, 1)), tmp_path)
    (tmp_path / "arc-particles-0" / "result.json").write_text(json.dumps(unscored()))
    other = tmp_path / "arc-particles-1"
    (other / "estimate.mcap").unlink()
    with EstimateWriter(other / "estimate.mcap", SHEET, settings(EstimatorConfig(detect_above=0.5))):
        pass
    run_study(study, study.cells((0, 1)), tmp_path)
    assert ran == ["arc-particles-0", "arc-particles-1"] * 2


def test_means_and_ranges_by_hand():
    """PCD 0.5 and 1.0: 75.0 (50.0...100.0); an equal figure has no range; one that is not defined is a dash."""
    one, two = scored(), scored()
    two["detection"]["by_dilation"]["0"]["pcd"] = 1.0
    for figures in (one, two):
        figures["calibration"]["nees_attached"] = None
    text = MainStudy().to_markdown({MainCell(row=ROW, seed=seed): run for seed, run in enumerate((one, two))})
    headings, _, cells = ([cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines())
    found = dict(zip(headings, cells, strict=True))
    assert (found["scene"], found["attached"], found["PCD % exact"]) == ("arc", "2", "75.0 (50.0…100.0)")
    assert (found["NEES/dof attached"], found["update s"]) == ("\N{EN DASH}", f"{np.mean([0.2, 0.2]):.2f}")


def test_the_readmes_table_has_the_rows_that_are_asked_for():
    shapes, others = ("line", "arc", "line_dot", "arc_line", "u_shape"), ("arc_soft", "arc_stiff", "arc_weld", "free")
    rows = {(row.scene, row.sensing) for row in MAIN}
    assert rows == {(scene, sensing) for scene in (*shapes, *others) for sensing in ("stereo", "particles")}
