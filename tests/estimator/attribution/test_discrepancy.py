"""Content of discrepancy.json, its page, and the suggested pull."""

import dataclasses
import json

import jax
import numpy as np
import pytest

import jiggle_mj as jm
from jiggle_mj.estimate import Sheet
from jiggle_mj.estimator.attribution.corrected import corrected_parameters
from jiggle_mj.estimator.attribution.discrepancy import attachments, discrepancy, suggested
from jiggle_mj.estimator.attribution.suggestion import expected_log_bayes_factor, suggest
from jiggle_mj.estimator.blas import one_thread
from jiggle_mj.estimator.effects import LIBRARY
from jiggle_mj.estimator.effects.sensing import DRIFT_RATES
from jiggle_mj.eval.report.discrepancy_page import story, write_page
from jiggle_mj.eval.runs import closing_the_loop as closing_run
from jiggle_mj.eval.runs.corrected_files import CORRECTED
from tests.support.lifted_recording import observed
from tests.support.small_sheet import DECLARATION, attached, sheet


def test_the_file_and_the_page_hold_the_result(light, tmp_path):
    closed, found, _ = light
    assert json.loads(json.dumps(found)) == found
    assert {"verdict", "effects", "ambiguous_with", "tested", "held_out", "localisation"} <= set(found)
    assert found["force"] is None and "force_scale" not in found["tested"]
    assert any("relative" in line and "no force on the tool was measured" in line for line in story(found))
    correlations = found["localisation"]["correlates_with"]
    assert correlations["height"] is not None and abs(correlations["height"]) <= 1
    for name in ("a", "b"):
        write_page(tmp_path / f"{name}.html", name="light", sheet=_sheet(closed), found=found)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()
    assert f"Added: {found['effects'][0]['name']}" in (tmp_path / "a.html").read_text()


def test_the_page_says_by_how_much_errors_persist(light):
    """With the keys that the file has, for another autocorrelation."""
    _, found, _ = light
    persistent = found | {"noise": found["noise"] | {"autocorrelation": 0.99}}
    (sentence,) = set(story(persistent)) - set(story(found))
    assert sentence.startswith("Errors persist") and "0.99" in sentence


def test_the_probabilities_of_hypotheses_come_first(light):
    _, found, _ = light
    shares = [one["probability"] for one in found["posterior"]]
    assert shares == sorted(shares, reverse=True) and sum(shares) == pytest.approx(1)
    assert found["posterior"][0]["effects"] == [one["name"] for one in found["effects"]]
    assert story(found)[1].startswith(f"Probability of what is missing: {found['effects'][0]['name']}")
    doubtful = found | {"verdict": "ambiguous", "ambiguous_with": []}
    assert story(doubtful)[0].endswith("do not exclude that nothing is missing.")


@pytest.fixture(scope="module")
def stopped_run(light, tmp_path_factory):
    """Return the folder of a closed loop that was stopped as it began to search for a pull, and its recording."""
    closed, _, dataset = light
    folder = tmp_path_factory.mktemp("light")

    def stopped(*_, **__):
        raise KeyboardInterrupt

    with jm.RecordingWriter(folder / "run.mcap", camera=None, declaration=DECLARATION, metadata={}) as writer:
        for observation in observed(0.2):
            writer.write(observation)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(closing_run, "check_before", lambda *_, **__: None)
        patch.setattr(closing_run, "collect_dataset", lambda *_, **__: dataset)
        patch.setattr(closing_run, "close_the_loop", lambda *_, **__: closed)
        patch.setattr(closing_run, "suggest", stopped)
        with pytest.raises(KeyboardInterrupt):
            closing_run.close_loop(folder / "run.mcap", folder / "closed", suggestion=True)
    return folder / "closed", folder / "run.mcap"


def test_the_result_is_written_before_a_pull_is_searched_for(light, stopped_run):
    folder, _ = stopped_run
    kept = json.loads((folder / closing_run.DISCREPANCY).read_text())
    assert kept["verdict"] == light[0].verdict and kept["suggestion"] is None
    page = (folder / closing_run.PAGE).read_text()
    assert "gravity" in page and "corrected.toml" in page


def test_the_corrected_model_holds_the_fitted_effects_within_their_bounds(light, stopped_run):
    closed, found, _ = light
    declared = jm.read_declaration(stopped_run[0] / CORRECTED)
    assert declared["effects"] == {one["name"]: tuple(one["theta"]) for one in found["effects"]}
    assert declared["membrane_stiffness"] == DECLARATION.membrane_stiffness
    for name, one in corrected_parameters(closed, DECLARATION).items():
        sd = np.array(one.effect.prior_sd)
        np.testing.assert_array_equal(one.value, declared["effects"][name])
        np.testing.assert_allclose(one.max_value, 4 * sd)
        np.testing.assert_allclose(one.min_value, -4 * sd)


def test_the_bounds_of_a_parameter_are_those_of_its_site(light):
    drift = next(effect for effect in LIBRARY if effect.name == "camera_drift")
    (one,) = light[0].final.added
    score = dataclasses.replace(one.score, name="camera_drift", site=2)
    slow = dataclasses.replace(one, effect=drift, score=score, at=np.arange(len(drift.prior_sd)))
    final = dataclasses.replace(light[0].final, added=(slow,))
    found = corrected_parameters(dataclasses.replace(light[0], final=final), DECLARATION)["camera_drift.2"]
    assert found.max_value[0] == pytest.approx(4 * DRIFT_RATES[2])


def test_the_reported_attachments_are_those_of_an_estimate_under_the_corrected_model(stopped_run):
    folder, recording = stopped_run
    found = json.loads((folder / closing_run.DISCREPANCY).read_text())
    declared = dataclasses.replace(DECLARATION, **jm.read_declaration(folder / CORRECTED))
    estimator = jm.Estimator(declared)
    for observation in jm.Recording.open(recording):
        estimator.update(observation)
    estimator.release()
    assert found["attachments"] == {"from": "estimate", "why": None}
    assert found["localisation_after"]["particles"]["attached"] == estimator.detection.attached.tolist()
    assert np.sum(estimator.detection.attached != attached()) <= 2


def test_without_an_estimate_the_result_says_why(light):
    _, found, _ = light
    changed = found | attachments(found, "Declaration.effects: tool_latency cannot.")
    assert changed["localisation_after"] == found["localisation_after"]
    assert "those of the fit: Declaration.effects: tool_latency cannot." in " ".join(story(changed))


@pytest.mark.slow
def test_the_suggested_pull_distinguishes_better_than_the_first_lift(light):
    closed, dataset = light[0], light[2]
    with jax.enable_x64(True), one_thread():
        found = suggest(closed, dataset)
        assert found is not None and set(found.between) == {"gravity", "stretch"}
        fits = [one.fitted for one in (closed.final, *closed.rivals)]
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
