"""Closing the loop over many recordings: what is kept, what is done again, what fails alone, and what is refused.

The loop itself is `QuickLoop`; two real ones are in `tests/jiggle_mj/cli/test_close_loops.py`.
"""

import json
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import jiggle_mj as jm
from jiggle_mj.eval.report.comparison_page import summary_sentences
from jiggle_mj.eval.runs import closing_many, closing_order
from jiggle_mj.eval.runs.closing_many import PAGE, SUMMARY, close_loops, without_truth
from jiggle_mj.eval.runs.closing_order import JOB, LOG
from jiggle_mj.eval.runs.kept_files import FITS
from tests.support.closed_loops import QuickLoop, discrepancy, effect
from tests.support.lifted_recording import N_STILL, PERIOD_NS
from tests.support.series import Inside
from tests.support.small_sheet import DECLARATION, sheet


def recorded(path: Path, declaration: jm.Declaration = DECLARATION, *, noise: float = 0.0) -> Path:
    """Write a recording of a sheet that nobody touches."""
    tool = jm.ToolState(
        position=np.array([0.0, 0.0, 0.05]), quat_wxyz=np.array([1.0, 0, 0, 0]), closed=False, grasp=0, radius=5e-3
    )
    points = jm.MeasuredPoints(positions=sheet().rest + noise, track_id=np.arange(sheet().n), sd=1e-4)
    with jm.RecordingWriter(path, camera=None, declaration=declaration, metadata={}) as writer:
        for k in range(N_STILL):
            writer.write(jm.Observation(index=k, time=k * PERIOD_NS, tool=tool, points=points))
    return path


@pytest.fixture
def recordings(tmp_path: Path) -> list[Path]:
    """Three recordings of one sheet, a, b and c."""
    folder = tmp_path / "recordings"
    folder.mkdir()
    return [recorded(folder / f"{name}.mcap", noise=1e-6 * k) for k, name in enumerate("abc")]


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> QuickLoop:
    """A loop that finds gravity in a and b, and fails at nothing yet."""
    loop = QuickLoop(
        {"a": discrepancy(effect("gravity", [0.7], [0.1])), "b": discrepancy(effect("gravity", [0.8], [0.1]))}
    )
    monkeypatch.setattr(closing_order, "close_loop", loop)
    return loop


def closed(recordings: list[Path], out: Path, *, executor: Executor | None = None, **options) -> dict:
    return close_loops(recordings, out, executor=executor or Inside(), **options)


def test_each_recording_has_its_folder_and_all_are_compared(recordings, quick, tmp_path):
    out, lines = tmp_path / "out", []
    results = closed(recordings, out, log=lines.append)
    assert json.loads((out / SUMMARY).read_text()) == results
    assert {path.name for path in out.iterdir()} == {"a", "b", "c", SUMMARY, PAGE}
    assert {path.name for path in (out / "a").iterdir()} == {"discrepancy.json", JOB, LOG}
    assert (out / "a" / LOG).read_text() == "closed over a.mcap\n"
    assert [(row["verdict"], row["effects"], row["frames"]) for row in results["recordings"]] == [
        ("effect", ["gravity"], 9), ("effect", ["gravity"], 9), ("no-effect", [], 9)
    ]  # fmt: skip
    assert [row["posterior"][0] for row in results["recordings"]] == [
        {"effects": ["gravity"], "probability": 0.96}, {"effects": ["gravity"], "probability": 0.96},
        {"effects": [], "probability": 0.96}
    ]  # fmt: skip
    assert all(row["seconds"] > 0 and row["held_out"]["after_rms_m"] == 1e-3 for row in results["recordings"])
    (gravity,) = results["effects"]
    assert gravity["agree"] and gravity["mean"] == pytest.approx([0.75])
    assert lines == ["1 of 3: a: effect, gravity", "2 of 3: b: effect, gravity", "3 of 3: c: no-effect"]
    page = (out / PAGE).read_text()
    assert "gravity is added in 2 of 3; its sizes agree" in page and 'href="a/discrepancy.html"' in page
    assert "gravity 0.96, poisson 0.04" in page and "nothing 0.96, poisson 0.04" in page
    assert "0.70 ± 0.10" in page and "0.750 ± 0.071" in page


def test_what_is_complete_is_kept_and_what_was_interrupted_is_done_again(recordings, quick, tmp_path):
    """The loop over b is interrupted after it wrote a first result, as by a killed process; a and c are complete."""
    out, lines = tmp_path / "out", []
    quick.fails["b"] = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        closed(recordings, out)
    assert (out / "b" / "discrepancy.json").exists() and not (out / SUMMARY).exists()
    del quick.fails["b"]
    results = closed(recordings, out, log=lines.append)
    assert quick.seen == ["a", "b", "c", "b"]
    assert lines == ["2 of 3 are complete, and kept", "3 of 3: b: effect, gravity"]
    assert [row["name"] for row in results["recordings"]] == ["a", "b", "c"]
    assert closed(recordings, out) == results and quick.seen == ["a", "b", "c", "b"]
    closed(recordings, out, overwrite=True)
    assert quick.seen[-3:] == ["a", "b", "c"]


@pytest.mark.parametrize(
    ("failure", "why"),
    [
        (jm.PerceptionError("no frame could be used"), "no frame could be used"),
        (ZeroDivisionError("of zero"), "ZeroDivisionError: of zero; "),
    ],
)
def test_a_recording_that_fails_leaves_the_others_and_says_why(recordings, quick, tmp_path, failure, why):
    """Its log has the reason, of an unexpected failure with the place; the next call does it again, alone."""
    out, lines = tmp_path / "out", []
    quick.fails["a"] = failure
    results = closed(recordings, out, log=lines.append)
    failed, *others = results["recordings"]
    assert failed["failed"].startswith(why) and failed["verdict"] is None
    assert [row["failed"] for row in others] == [None, None] and len(results["effects"][0]["found"]) == 1
    assert lines[0].startswith(f"1 of 3: a: failed: {why}")
    assert ("Traceback" in (out / "a" / LOG).read_text()) == isinstance(failure, ZeroDivisionError)
    assert "1 of 3 failed: a." in (out / PAGE).read_text() and why in (out / PAGE).read_text()
    quick.fails.clear()
    assert closed(recordings, out)["recordings"][0]["failed"] is None
    assert quick.seen == ["a", "b", "c", "a"]


def test_a_recording_that_cannot_be_read_fails_alone(recordings, quick, tmp_path):
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(b"no recording")
    results = closed([*recordings, tmp_path / "missing.mcap", damaged], tmp_path / "out")
    assert [row["name"] for row in results["recordings"] if row["failed"]] == ["missing"]  # QuickLoop reads none
    assert "does not exist" in results["recordings"][3]["failed"]


def test_results_of_another_recording_or_of_other_settings_are_not_replaced(recordings, quick, tmp_path):
    out = tmp_path / "out"
    closed(recordings, out)
    for options in ({"suggestion": True}, {"declare": {"thickness": 2e-3}}, {"config": jm.EstimatorConfig(seed=3)}):
        with pytest.raises(jm.OutputError, match=r"holds results of other settings.*--overwrite"):
            closed(recordings, out, **options)
    recordings[1].unlink()
    recorded(recordings[1], noise=1e-3)
    with pytest.raises(jm.OutputError, match=r"out/b holds results of another recording"):
        closed(recordings, out)
    assert quick.seen == ["a", "b", "c"]
    assert closed(recordings, out, overwrite=True) and len(quick.seen) == 6


def test_results_of_a_single_run_are_not_replaced(recordings, quick, tmp_path):
    (tmp_path / "out" / "b").mkdir(parents=True)
    (tmp_path / "out" / "b" / "corrected.toml").write_text("mine")
    with pytest.raises(jm.OutputError, match=r"already holds corrected\.toml"):
        closed(recordings, tmp_path / "out")
    assert (tmp_path / "out" / "b" / "corrected.toml").read_text() == "mine" and not quick.seen


def test_nothing_and_the_same_name_twice_are_refused(recordings, quick, tmp_path):
    with pytest.raises(jm.OptionError, match="no recording is given"):
        closed([], tmp_path / "out")
    with pytest.raises(jm.OptionError, match="are both named 'a'"):
        closed([*recordings, tmp_path / "other" / "a.mcap"], tmp_path / "out")
    with pytest.raises(jm.OptionError, match="are both named 'a'"):
        closed([recordings[0], recordings[0]], tmp_path / "out")
    assert not quick.seen and not (tmp_path / "out").exists()


def test_a_folder_of_recordings_or_of_another_job_is_no_place_for_a_comparison(recordings, quick, tmp_path):
    for inside in (recordings[0].parent, tmp_path):
        with pytest.raises(jm.OutputError, match=r"holds the recording .*a\.mcap; give a folder of its own"):
            closed(recordings, inside)
    closed(recordings, tmp_path / "out")
    with pytest.raises(jm.OutputError, match=r"holds discrepancy\.json, job\.json of one recording"):
        closed(recordings, tmp_path / "out" / "a")
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / PAGE).write_text("mine")
    with pytest.raises(jm.OutputError, match=r"holds report\.html of something else"):
        closed(recordings, tmp_path / "foreign")


def test_recordings_of_sheets_that_are_declared_differently_are_refused(recordings, quick, tmp_path):
    other = recorded(tmp_path / "other.mcap", replace(DECLARATION, thickness=3e-3))
    with pytest.raises(jm.OptionError, match=r"a\.mcap and .*other\.mcap are not declared as one sheet: thickness is"):
        closed([*recordings, other], tmp_path / "out")
    assert closed([*recordings, other], tmp_path / "out", declare={"thickness": 1e-3})["recordings"][3]["verdict"]


def test_truth_files_that_a_pattern_gives_beside_their_recordings_are_left_out():
    given = [Path("r/a.mcap"), Path("r/a.truth.mcap"), Path("r/b.truth.mcap")]
    assert without_truth(given) == [given[0], given[2]]


def test_the_sentences_say_where_a_trivial_prediction_is_better_and_what_belongs_to_a_session():
    row = {"failed": None, "effects": ["tool_scale"], "name": "a", "held_out": discrepancy(error=3e-3)["held_out"]}
    found = [{"recording": name, "site": None, "theta": [0.1], "sd": [0.01]} for name in "ab"]
    tool = {"name": "tool_scale", "found": found, "this_session_alone": True, "same_site": True, "units": [""],
            "agree": False, "p_value": 0.001, "mean": [0.1], "mean_sd": [0.007]}  # fmt: skip
    text = " ".join(summary_sentences({"recordings": [row, row | {"name": "b"}], "effects": [tool]}))
    assert "its sizes differ (p = 0.001)" in text and "it may differ between sessions" in text
    assert "a: that nothing moves predicts the held-out part better than the model does." in text


def test_recordings_that_were_closed_are_fitted_together(recordings, quick, tmp_path, monkeypatch):
    """Those that failed are left out; what they say together is in the page and returned, and not in results.json."""
    together = {"verdict": "no-effect", "effects": [], "ambiguous_with": [], "recordings": [], "refused": []}
    together["posterior"] = [{"effects": [], "probability": 1.0, "log_evidence": 3.0, "recordings": {}}]
    seen = []
    monkeypatch.setattr(closing_many, "write_jointly", lambda where, orders, *rest: seen.append([*orders]) or together)
    quick.fails["a"] = jm.PerceptionError("no frame could be used")
    out = tmp_path / "out"
    results = closed(recordings, out, joint=True)
    assert seen == [["b", "c"]] and results["joint"] == together
    assert "joint" not in json.loads((out / SUMMARY).read_text())
    assert "All recordings together show no missing effect of the tissue." in (out / PAGE).read_text()
    quick.fails["b"] = quick.fails["a"]
    assert closed(recordings, out, joint=True, overwrite=True)["joint"] is None and len(seen) == 1


def test_what_was_closed_without_its_fits_is_closed_again_for_all_together(recordings, quick, tmp_path, monkeypatch):
    monkeypatch.setattr(closing_many, "write_jointly", lambda *arguments: None)
    out = tmp_path / "out"
    closed(recordings, out)
    (out / "b" / FITS).write_bytes(b"kept")
    closed(recordings, out, joint=True)
    assert quick.seen == ["a", "b", "c", "a", "c"]
    assert closed(recordings, out) and quick.seen == ["a", "b", "c", "a", "c"]


def test_a_single_recording_is_not_fitted_together_with_others(recordings, quick, tmp_path):
    with pytest.raises(jm.OptionError, match=r"joint: .*a\.mcap is a single recording.*give two or more"):
        closed(recordings[:1], tmp_path / "out", joint=True)
    assert not quick.seen and not (tmp_path / "out").exists()
