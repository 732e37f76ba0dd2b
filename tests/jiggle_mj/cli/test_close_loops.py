"""`close-loop` of several recordings from the command line: exit codes, what is refused, and two real ones."""

import json
from contextlib import nullcontext

import pytest

from jiggle_mj.eval.runs.closing_many import PAGE, SUMMARY
from jiggle_mj.eval.runs.corrected_files import CORRECTED_JOINT
from jiggle_mj.eval.runs.joint_result import JOINT
from jiggle_mj.recording.declaration_file import read_declaration
from tests.support.dask_cluster import dask_cluster
from tests.support.tiny_scene import call, scene_file

SEEDS = 2
"""Recordings that the loop is closed over."""


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Recordings of the tiny scene whose tool reports 1.1 times its displacement, and their truths."""
    folder = tmp_path_factory.mktemp("recordings")
    arguments = ("--count", SEEDS, "--jobs", 1, "--sensing", "particles", "--disturb", "tool_scale=1.1")
    with pytest.MonkeyPatch.context() as patch:
        assert call(patch, "record", scene_file(folder), "--out", folder / "made", *arguments) == 0
    return sorted((folder / "made").glob("*.mcap"))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "no recording is given"),
        (("a.mcap", "b.mcap", "--truth", "a.truth.mcap"), "--truth a.truth.mcap: it is of one recording"),
        (("a.mcap", "--jobs", 1, "--truth", "a.truth.mcap"), "--truth a.truth.mcap: it is of one recording"),
        (("a.mcap", "b.mcap", "--jobs", 1, "--executor", "dask://x:1"), "give one of them"),
        (("a.mcap", "b.mcap", "--jobs", 0), "jobs"),
        (("a.mcap", "--joint"), "joint: a.mcap is a single recording"),
        (("a.mcap", "x/a.mcap"), "are both named 'a'"),
    ],
)
def test_what_cannot_be_done_is_refused_before_anything_is_written(arguments, words, tmp_path, monkeypatch, capsys):
    assert call(monkeypatch, "close-loop", *arguments, "--out", tmp_path / "out") == 2
    assert words in capsys.readouterr().err and not (tmp_path / "out").exists()


@pytest.mark.parametrize("on_cluster", [False, True], ids=["processes", "cluster"])
def test_recordings_that_fail_are_named_and_the_exit_code_says_so(on_cluster, tmp_path, monkeypatch, capsys):
    """In other processes; one file is missing, and one is no recording. All results are written all the same."""
    out = tmp_path / "out"
    (tmp_path / "torn.mcap").write_bytes(b"torn")
    arguments = (tmp_path / "missing.mcap", tmp_path / "torn.mcap", "--json", "--out", out)
    with dask_cluster(tmp_path, 1) if on_cluster else nullcontext() as cluster:
        workers = ("--jobs", 1) if cluster is None else ("--executor", cluster[0])
        assert call(monkeypatch, "close-loop", *arguments, *workers) == 1
    printed = capsys.readouterr()
    results = json.loads(printed.out)
    assert results == json.loads((out / SUMMARY).read_text())
    assert [row["name"] for row in results["recordings"] if row["failed"]] == ["missing", "torn"]
    assert " of 2: missing: failed" in printed.err and "2 of 2 failed: missing, torn." in printed.err
    assert "missing" in (out / PAGE).read_text()
    assert "torn.mcap" in (out / "torn" / "log.txt").read_text()


@pytest.mark.slow
def test_two_recordings_give_what_each_gives_alone_and_one_size(recordings, tmp_path, monkeypatch, capsys):
    """The truths that the pattern gives are left out, and the tool's scale is found in both, of one size.

    Together they share no effect of the tissue, and each keeps its tool's scale.
    """
    out, alone = tmp_path / "out", tmp_path / "alone"
    assert call(monkeypatch, "close-loop", *recordings, "--joint", "--out", out, "--json") == 0
    printed = capsys.readouterr()
    results = json.loads(printed.out)
    assert [row["name"] for row in results["recordings"]] == ["000000", "000001"]
    assert {path.name for path in out.iterdir()} == {"000000", "000001", SUMMARY, PAGE, JOINT}
    joint = json.loads((out / JOINT).read_text())
    assert results.pop("joint") == joint and joint["posterior"][0]["effects"] == []
    for one in joint["recordings"]:
        assert [effect["name"] for effect in one["own_effects"]] == ["tool_scale"]
        assert one["after_rms_m"] <= one["before_rms_m"]
        declared = read_declaration(out / one["name"] / CORRECTED_JOINT)
        assert declared["effects"]["tool_scale"] == pytest.approx(one["own_effects"][0]["theta"])
    (scale,) = [effect for effect in results["effects"] if effect["name"] == "tool_scale"]
    assert len(scale["found"]) == SEEDS and scale["agree"] and "its sizes agree" in printed.err
    assert call(monkeypatch, "close-loop", recordings[0], "--out", alone) == 0
    for path in alone.iterdir():
        assert path.read_bytes() == (out / "000000" / path.name).read_bytes(), path.name
    assert call(monkeypatch, "close-loop", *recordings, "--out", out) == 0
    assert "2 of 2 are complete, and kept" in capsys.readouterr().err
