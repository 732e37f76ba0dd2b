"""The study of acts that worked and acts that did not: verdicts of a small tissue, and counts by hand."""

import json
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from jiggle_mj.eval.studies.acts_table import ActsCell, ActsStudy, Verdict, limit, verdicts
from jiggle_mj.eval.studies.study import run_study
from jiggle_mj.recording.declaration import VERSION
from jiggle_mj.scenes import load_scene
from tests.support.tiny_scene import SCENE, scene_file

GOOD, BAD = Verdict("Cut", True, 9.0), Verdict("Cut", False, -9.0)


@pytest.mark.slow
def test_the_evidence_distinguishes_cuts_that_worked_from_those_that_did_not(tmp_path):
    found = verdicts(load_scene(str(scene_file(tmp_path, text=SCENE))), 0, acts_of_a_kind=1)
    factors = {(verdict.kind, verdict.works): verdict.log_bayes_factor for verdict in found}
    assert factors["Cut", True] > 0 > factors["Cut", False]


def test_counts_are_by_scene_and_of_all():
    found = {
        ActsCell(scene="arc", seed=0): [GOOD, BAD, Verdict("Cut", False, 1.0)],
        ActsCell(scene="line", seed=0): [Verdict("Cut", True, -1.0), BAD],
    }
    lines = ActsStudy().to_markdown(found).splitlines()
    assert lines[2].startswith("| arc | 0 of 1 | 1 of 2 | 2 of 2 | 0 of 0 | 0 of 0 | none worked |")
    assert lines[3].startswith("| line | 1 of 1 | 1 of 1 | 1 of 1 |")
    assert lines[4].startswith("| all | 1 of 2 | 2 of 3 | 2 of 3 |")


def test_the_limit_leaves_one_in_a_hundred_below():
    worked = np.arange(200.0)
    assert (worked < limit(worked)).sum() == 1


def test_what_this_version_has_measured_is_not_run_again(tmp_path):
    ran = []

    class Counted(ActsStudy):
        def verdicts(self, cell: ActsCell) -> list[Verdict]:
            ran.append((cell.scene, cell.seed))
            return [GOOD]

    (tmp_path / "arc-0.json").write_text(json.dumps({VERSION: "another", "verdicts": []}))
    study = Counted(scenes=("arc",))
    with ThreadPoolExecutor(1) as executor:
        found = [run_study(study, study.cells((0, 1)), tmp_path, executor=executor) for _ in range(2)]
    assert sorted(ran) == [("arc", 0), ("arc", 1)]
    assert found == [{ActsCell(scene="arc", seed=seed): [GOOD] for seed in (0, 1)}] * 2
