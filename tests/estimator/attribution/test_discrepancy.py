"""Content of discrepancy.json, its page, and the suggested pull."""

import json
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from jiggle_mj.estimate import Sheet
from jiggle_mj.estimator.attribution.discrepancy import discrepancy, suggested
from jiggle_mj.estimator.attribution.suggestion import expected_log_bayes_factor, suggest
from jiggle_mj.estimator.blas import one_thread
from jiggle_mj.eval.report.discrepancy_page import story, write_page
from jiggle_mj.eval.runs import closing_the_loop as closing_run
from jiggle_mj.observation import Declaration
from tests.support.small_sheet import sheet


def test_the_file_and_the_page_hold_the_result(light, tmp_path):
    closed, found, _ = light
    assert json.loads(json.dumps(found)) == found
    assert {"verdict", "effects", "ambiguous_with", "tested", "held_out", "localisation"} <= set(found)
    correlations = found["localisation"]["correlates_with"]
    assert correlations["height"] is not None and abs(correlations["height"]) <= 1
    for name in ("a", "b"):
        write_page(tmp_path / f"{name}.html", name="light", sheet=_sheet(closed), found=found)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()
    assert f"Added: {found['effects'][0]['name']}" in (tmp_path / "a.html").read_text()


def test_the_result_is_written_before_a_pull_is_searched_for(light, tmp_path, monkeypatch):
    closed, _, dataset = light
    recording = SimpleNamespace(declaration=Declaration(), declared=True, camera=None, metadata={"name": "light"})

    def stopped(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(closing_run.Recording, "open", staticmethod(lambda *_, **__: recording))
    monkeypatch.setattr(closing_run, "check_before", lambda *_, **__: None)
    monkeypatch.setattr(closing_run, "collect_dataset", lambda *_, **__: dataset)
    monkeypatch.setattr(closing_run, "close_the_loop", lambda *_, **__: closed)
    monkeypatch.setattr(closing_run, "suggest", stopped)
    with pytest.raises(KeyboardInterrupt):
        closing_run.close_loop(tmp_path / "run.mcap", tmp_path / "closed", suggestion=True)
    kept = json.loads((tmp_path / "closed" / closing_run.DISCREPANCY).read_text())
    assert kept["verdict"] == closed.verdict and kept["suggestion"] is None
    assert "gravity" in (tmp_path / "closed" / closing_run.PAGE).read_text()


@pytest.mark.slow
def test_the_suggested_pull_distinguishes_better_than_the_first_lift(light):
    closed, dataset = light[0], light[2]
    with jax.enable_x64(True), one_thread():
        found = suggest(closed, dataset)
        assert found is not None and set(found.between) == {"gravity", "stretch"}
        fits = [one.fitted for one in (closed.accepted[0], *closed.rivals[0])]
        first = [one for one in dataset.frames if one.grasp == 1][:4]
        assert found.expected > expected_log_bayes_factor(closed.problem, fits, first) > 0
        assert expected_log_bayes_factor(closed.problem, [fits[0], fits[0]], first) == pytest.approx(0, abs=1)
    assert np.linalg.norm(found.pull) <= max(np.linalg.norm(one.frame.displacement) for one in dataset.frames) + 1e-9
    assert np.min(np.linalg.norm(sheet().rest - found.grasp, axis=1)) < 1e-3
    with_suggestion = discrepancy(closed, dataset) | {"suggestion": suggested(found)}
    time_of_hold = f" {found.hold:.0f} s"
    assert (time_of_hold in " ".join(story(with_suggestion))) == found.enough


def _sheet(closed):
    """Return the sheet of a closed loop."""
    return Sheet(rest=np.asarray(closed.problem.history.rest), faces=sheet().faces)
