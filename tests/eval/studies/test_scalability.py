"""The study of planning times: the table by hand, and which times are kept."""

import json

import jax
import pytest

from jiggle_mj.eval.studies.scalability import PRINTED, PlanTimes, ScalabilityStudy
from jiggle_mj.recording.declaration import version_entry

DEVICE = jax.devices()[0].device_kind


def test_each_size_has_its_line_and_the_papers_seconds_where_there_are_any():
    lines = ScalabilityStudy().to_markdown({600: PlanTimes(1.42, 1.38), 2400: PlanTimes(7.6, 21.2)}).splitlines()
    assert lines[2] == f"| 600 | {PRINTED[600]} s | 1.4 s | 1.4 s |"
    assert lines[3] == "| 2400 | \N{EN DASH} | 7.6 s | 21 s |"
    assert lines[-1].startswith("Medians of three on ")


@pytest.mark.parametrize(("device", "current"), [(DEVICE, True), ("another", False)])
def test_times_are_kept_for_the_kind_of_device_that_they_were_measured_on(tmp_path, device, current):
    kept = version_entry() | {"device": device, "times": {"sl_d_s": 1.5, "ours_s": 0.5}}
    (tmp_path / "600.json").write_text(json.dumps(kept))
    study = ScalabilityStudy()
    assert study.is_current(600, tmp_path / "600.json") is current
    assert not study.is_current(1200, tmp_path / "1200.json")
    assert study.read(600, tmp_path / "600.json") == PlanTimes(sl_d_s=1.5, ours_s=0.5)
