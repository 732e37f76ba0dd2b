"""The command line: exit codes, what goes to stdout, what is refused, and one complete run."""

import json
import shutil
import subprocess
import sys

import mujoco
import numpy as np
import pytest

from jiggle_mj.recording.estimate import EstimateWriter, read_estimate
from tests.support.result_keys import KEYS, KEYS_OF_POINTS, keys
from tests.support.tiny_scene import SCENE, call, scene_file

MIN_COVERAGE = 0.95
"""Least PCD and PUG within a ring of the mesh, as in `test_main_job`."""
MAX_TRACKING_RMS = 0.6e-3
"""Largest RMS distance of seen particles from their material points [m], as in `test_main_job`."""
SAME_RUN = 1e-12
"""Relative difference of a figure that is computed from an estimate in memory and from its file."""
FILES = {"run.mcap", "run.truth.mcap", "estimate.mcap", "result.json", "report.html"}


@pytest.fixture(scope="module", params=[pytest.param("stereo", marks=pytest.mark.render)])
def complete_run(request, tmp_path_factory):
    """`run` on a tiny scene, from images: exit code, scene and folder."""
    folder = tmp_path_factory.mktemp("complete_run")
    monkeypatch = pytest.MonkeyPatch()
    scene, out = scene_file(folder, text=SCENE.replace("spacing = 7e-3", "spacing = 4.5e-3")), folder / "out"
    with monkeypatch.context() as patch:
        code = call(patch, "run", scene, "--out", out, "--sensing", request.param)
    return code, scene, out


@pytest.fixture(scope="module")
def particles(tmp_path_factory):
    """A recording of the tiny scene, of particles."""
    folder = tmp_path_factory.mktemp("particles")
    with pytest.MonkeyPatch.context() as patch:
        assert call(patch, "record", scene_file(folder), "--out", folder / "run.mcap", "--sensing", "particles") == 0
    return folder / "run.mcap"


def test_run_fills_the_folder_with_five_files(complete_run):
    code, _, out = complete_run
    assert code == 0
    assert {path.name for path in out.iterdir()} == FILES
    assert "<html" in (out / "report.html").read_text()[:500]


def test_result_json_has_exactly_the_documented_keys(complete_run):
    _, _, out = complete_run
    figures = json.loads((out / "result.json").read_text())
    assert keys(figures) == KEYS
    assert figures["scene"] == "tiny" and figures["sensing"] == "stereo"
    assert figures["n_frames"] > figures["frames"]["used"] > 0 and not figures["frames"]["skipped"]
    assert figures["detection"]["n_attached"] > 0


def test_the_disc_of_the_tiny_scene_is_found_from_images_alone(complete_run):
    """The reported particles lie within a ring of the disc and cover it within a ring; the report has pictures."""
    figures = json.loads((complete_run[2] / "result.json").read_text())
    ring = figures["detection"]["by_dilation"]["1"]
    assert ring["pcd"] >= MIN_COVERAGE and ring["pug"] >= MIN_COVERAGE
    assert figures["tracking"]["rms_m"] <= MAX_TRACKING_RMS
    page = (complete_run[2] / "report.html").read_text()
    assert "data:image/jpeg" in page and "Reliability of P(attached)" in page


def test_estimate_then_score_with_json_print_json_and_nothing_else(complete_run, tmp_path, monkeypatch, capsys):
    _, _, made = complete_run
    out = tmp_path / "again"
    assert call(monkeypatch, "estimate", made / "run.mcap", "--out", out, "--json") == 0
    printed = capsys.readouterr()
    figures = json.loads(printed.out)
    assert keys(figures) == KEYS
    assert figures["detection"]["n_attached"] is None
    assert "report" in printed.err
    assert call(monkeypatch, "score", out, "--truth", made / "run.truth.mcap", "--json") == 0
    scored = json.loads(capsys.readouterr().out)
    reference = json.loads((made / "result.json").read_text())
    assert scored["detection"] == reference["detection"]
    assert np.isclose(scored["tracking"]["rms_m"], reference["tracking"]["rms_m"], rtol=SAME_RUN)


def test_a_truth_of_the_same_name_but_another_scene_is_refused_and_changes_nothing(
    complete_run, tmp_path, monkeypatch, capsys
):
    _, scene, made = complete_run
    moved = tmp_path / scene.name
    moved.write_text(scene.read_text().replace("centre = [0.0, 0.0]", "centre = [0.01, 0.0]"))
    assert call(monkeypatch, "record", moved, "--out", tmp_path / "run.mcap", "--sensing", "particles") == 0
    before = (made / "result.json").read_bytes()
    assert call(monkeypatch, "score", made, "--truth", tmp_path / "run.truth.mcap") == 1
    assert "truth of another recording of 'tiny'" in capsys.readouterr().err
    right = made / "run.truth.mcap"
    assert call(monkeypatch, "score", made, "--truth", right, "--recording", tmp_path / "run.mcap") == 1
    assert "not the recording that" in capsys.readouterr().err
    assert (made / "result.json").read_bytes() == before


def test_a_folder_with_results_is_refused_with_2_and_replaced_on_demand(particles, tmp_path, monkeypatch, capsys):
    out = tmp_path / "old"
    shutil.copytree(particles.parent, out)
    (out / "result.json").write_text("old")
    assert call(monkeypatch, "run", out / "tiny.toml", "--out", out) == 2
    assert "pass --overwrite" in capsys.readouterr().err
    assert (out / "result.json").read_text() == "old"
    assert call(monkeypatch, "estimate", out / "run.mcap", "--out", out, "--overwrite") == 0
    assert keys(json.loads((out / "result.json").read_text())) == KEYS_OF_POINTS
    assert (out / "run.mcap").exists() and (out / "run.truth.mcap").exists()


@pytest.fixture(scope="module")
def estimated(particles):
    """The folder of an estimate of the recording of particles."""
    out = particles.parent / "estimated"
    with pytest.MonkeyPatch.context() as patch:
        assert call(patch, "estimate", particles, "--out", out) == 0
    return out


def check_material(material: dict, names: set[str], said: str) -> None:
    assert set(material["ratios"]) == names and "membrane stiffness" in material["refused"]
    for name, ratio in material["ratios"].items():
        assert ratio["log_sd"] > 0 and ratio["trades_with"] and 0 <= ratio["correlation"] <= 1
        assert (ratio["factor"] is None) == (ratio["refused"] is not None) == (name in material["refused"])
        assert ratio["factor"] is None or ratio["factor"] > 0
    assert "membrane stiffness: not identified" in said and "pass 1: " in said


def test_identify_uses_an_estimate_again_and_says_what_it_cannot_know(estimated, monkeypatch, capsys):
    assert call(monkeypatch, "identify", estimated, "--json") == 0
    printed = capsys.readouterr()
    said = " ".join(printed.err.split())
    check_material(json.loads(printed.out), {"weight", "bending"}, said)
    assert "are used again" in said and "1/m" in said


@pytest.mark.slow
def test_identify_finds_the_same_from_the_recording_and_one_parameter_alone(particles, estimated, monkeypatch, capsys):
    """The same frames within the length of the last step, a tenth of the standard error, from either side."""
    found = []
    for source in (particles, estimated):
        assert call(monkeypatch, "identify", source, "--json", "--parameter", "weight") == 0
        printed = capsys.readouterr()
        check_material(json.loads(printed.out), {"weight"}, printed.err)
        found.append(json.loads(printed.out)["ratios"]["weight"])
    assert abs(np.log(found[0]["factor"] / found[1]["factor"])) < 0.2 * found[0]["log_sd"]
    assert np.isclose(found[0]["log_sd"], found[1]["log_sd"], rtol=0.1)


@pytest.mark.parametrize(
    ("options", "code", "said"),
    [
        (("--parameter", "bending_ratio"), 2, "did you mean 'bending'?"),
        (("--parameter", "gravity"), 2, "only weight and bending can be identified"),
        (("--mask", "grabcut"), 2, "--mask: an estimate is used as it was made"),
        (("--set", "spacing=0.01"), 2, "--set: an estimate is used as it was made"),
        (("--allow-truncated",), 2, "--allow-truncated: an estimate is used as it was made"),
    ],
)
def test_what_cannot_be_asked_of_an_estimate_is_refused_in_one_line(
    options, code, said, estimated, monkeypatch, capsys
):
    assert call(monkeypatch, "identify", estimated, *options) == code
    assert said in one_line(capsys.readouterr().err)


def test_a_folder_without_kept_frames_is_refused_with_what_to_give_instead(estimated, tmp_path, monkeypatch, capsys):
    read = read_estimate(estimated / "estimate.mcap")
    with EstimateWriter(tmp_path / "estimate.mcap", read.sheet, read.metadata) as writer:
        for each in read.estimates:
            writer.write(each)
        writer.finish(read.belief, read.detection)
    shutil.copy(estimated / "result.json", tmp_path)
    assert call(monkeypatch, "identify", tmp_path) == 2
    assert "does not keep its frames" in one_line(capsys.readouterr().err)
    assert call(monkeypatch, "identify", tmp_path / "nothing") == 1
    assert "nothing" in one_line(capsys.readouterr().err)


def test_a_run_that_cannot_begin_leaves_the_old_results(complete_run, monkeypatch, capsys):
    _, scene, made = complete_run
    before = {path.name: path.read_bytes() for path in made.iterdir()}
    arguments = ("run", scene, "--out", made, "--overwrite", "--seed", "-1")
    assert call(monkeypatch, *arguments) == 2
    assert "seed = -1: must be" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in made.iterdir()} == before


def one_line(text: str) -> str:
    lines = [line for line in text.splitlines() if line.strip()]
    assert len(lines) == 1, text
    return lines[0]


def test_estimating_from_the_truth_is_refused_in_one_line(complete_run, tmp_path, monkeypatch, capsys):
    code = call(monkeypatch, "estimate", complete_run[2] / "run.truth.mcap", "--out", tmp_path / "cheat")
    assert code == 1
    assert "truth" in one_line(capsys.readouterr().err)
    assert not (tmp_path / "cheat").exists()


@pytest.mark.parametrize(
    ("arguments", "code", "name"),
    [
        (("run", "nosuchscene", "--out", "x"), 2, "nosuchscene"),
        (("run", "nosuch.toml", "--out", "x"), 2, r"nosuch.toml"),
        (("estimate", "nosuch.mcap", "--out", "x"), 1, "nosuch.mcap"),
        (("score", "nosuchfolder", "--truth", "nosuch.truth.mcap"), 2, "nosuchfolder"),
        (("import", "nosuchfolder", "--out", "x.mcap"), 2, "nosuchfolder"),
    ],
)
def test_what_is_not_there_is_named_in_one_line(arguments, code, name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert call(monkeypatch, *arguments) == code
    printed = capsys.readouterr()
    assert name in one_line(printed.err)
    assert printed.out == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("seeds", "message"), [((), "--seeds without a seed"), ((0, -1), "--seeds = -1: must be")])
def test_a_table_of_no_seeds_is_refused_before_it_begins(seeds, message, tmp_path, monkeypatch, capsys):
    out = tmp_path / "table"
    assert call(monkeypatch, "table", "calibration", "--out", out, "--seeds", *seeds) == 2
    assert message in capsys.readouterr().err and not out.exists()


@pytest.mark.parametrize("arguments", [("nosuchverb",), ("run",), ("run", "arc", "--out", "x", "--sensing", "smell")])
def test_bad_usage_exits_with_2(arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert call(monkeypatch, *arguments) == 2
    assert capsys.readouterr().err


def test_without_opengl_the_message_says_what_to_install(tmp_path, monkeypatch, capsys):
    def fail(*_: object) -> None:
        raise RuntimeError("no EGL device")

    monkeypatch.setattr(mujoco, "Renderer", fail)
    assert call(monkeypatch, "record", scene_file(tmp_path), "--out", tmp_path / "run.mcap") == 1
    assert "no EGL device). Install libegl1" in capsys.readouterr().err
    assert not (tmp_path / "run.mcap").exists()


def test_record_writes_observations_and_truth_to_two_files(complete_run, tmp_path, monkeypatch, capsys):
    _, scene, made = complete_run
    out = tmp_path / "run.mcap"
    assert call(monkeypatch, "record", scene, "--out", out, "--json") == 0
    written = json.loads(capsys.readouterr().out)
    assert (written["recording"], written["truth"]) == (str(out), str(tmp_path / "run.truth.mcap"))
    assert written["n_frames"] > 12
    assert {path.name for path in tmp_path.iterdir()} == {"run.mcap", "run.truth.mcap"}
    # The same seed gives the same bytes, whichever verb recorded.
    assert out.read_bytes() == (made / "run.mcap").read_bytes()
    assert call(monkeypatch, "record", scene, "--out", out) == 2


def test_the_module_can_be_run():
    done = subprocess.run([sys.executable, "-m", "jiggle_mj", "--help"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0
    for verb in ("run", "record", "import", "estimate", "score", "doctor"):
        assert verb in done.stdout


@pytest.mark.slow
def test_close_loop_writes_a_verdict_and_a_page(complete_run, tmp_path, monkeypatch, capsys):
    _, _, made = complete_run
    arguments = (made / "run.mcap", "--truth", made / "run.truth.mcap", "--out", tmp_path / "closed", "--json")
    assert call(monkeypatch, "close-loop", *arguments) == 0
    printed = capsys.readouterr()
    discrepancy = json.loads(printed.out)
    assert discrepancy == json.loads((tmp_path / "closed" / "discrepancy.json").read_text())
    assert discrepancy["detection_after"]["n_attached"] > 0
    assert "scores: " in printed.err and discrepancy["verdict"] in printed.err
    assert discrepancy["verdict"] in (tmp_path / "closed" / "discrepancy.html").read_text()
    assert call(monkeypatch, "close-loop", *arguments) == 2  # existing results are not replaced without --overwrite
