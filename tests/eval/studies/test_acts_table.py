"""The table of acts that worked and acts that did not: verdicts of a small tissue, and counts by hand."""

import json
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from jiggle_mj.eval.studies import acts_table
from jiggle_mj.eval.studies.acts_table import Verdict, limit, markdown, measure, verdicts
from jiggle_mj.recording.declaration import VERSION
from jiggle_mj.scenes import load_scene
from tests.support.tiny_scene import SCENE, scene_file

GOOD, BAD = Verdict("Cut", True, 9.0), Verdict("Cut", False, -9.0)


@pytest.mark.slow
def test_a_small_tissue_tells_cuts_that_worked_from_those_that_did_not(tmp_path, monkeypatch):
    monkeypatch.setattr(acts_table, "PLACES", 1)
    found = verdicts(load_scene(str(scene_file(tmp_path, text=SCENE))), 0)
    told = {(one.kind, one.works): one.log_bayes_factor for one in found}
    assert told["Cut", True] > 0 > told["Cut", False]


def test_counts_are_by_scene_and_of_all():
    found = {("arc", 0): [GOOD, BAD, Verdict("Cut", False, 1.0)], ("line", 0): [Verdict("Cut", True, -1.0), BAD]}
    lines = markdown(found).splitlines()
    assert lines[2].startswith("| arc | 0 of 1 | 1 of 2 | 2 of 2 | 0 of 0 | 0 of 0 | none worked |")
    assert lines[3].startswith("| line | 1 of 1 | 1 of 1 | 1 of 1 |")
    assert lines[4].startswith("| all | 1 of 2 | 2 of 3 | 2 of 3 |")


def test_the_limit_leaves_one_in_a_hundred_below():
    worked = np.arange(200.0)
    assert (worked < limit(worked)).sum() == 1


def test_what_this_version_has_measured_is_not_run_again(tmp_path, monkeypatch):
    ran = []
    monkeypatch.setattr(acts_table, "load_scene", lambda name: name)
    monkeypatch.setattr(acts_table, "verdicts", lambda scene, seed: ran.append((scene, seed)) or [GOOD])
    (tmp_path / "arc-0.json").write_text(json.dumps({VERSION: "another", "verdicts": []}))
    with ThreadPoolExecutor(1) as executor:
        found = [measure(("arc",), (0, 1), tmp_path, executor=executor, log=lambda _: None) for _ in range(2)]
    assert sorted(ran) == [("arc", 0), ("arc", 1)]
    assert found == [{("arc", 0): [GOOD], ("arc", 1): [GOOD]}] * 2
