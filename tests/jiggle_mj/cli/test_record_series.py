"""`record --count`: options, output, Ctrl-C, and a secret scene in no log."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from jiggle_mj.episode import recording_identity
from jiggle_mj.recording.declaration import METADATA
from jiggle_mj.recording.mcap_files import truth_path
from jiggle_mj.recording.reader import Recording
from jiggle_mj.recording.truth import read_truth
from jiggle_mj.scenes import disturbed, load_scene
from tests.support.mcap_edits import records_of
from tests.support.series import (
    SCENE,
    Inside,
    contents,
    left_behind,
    record,
    until,
    write_scene,
)
from tests.support.tiny_scene import call


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (("--jobs", 2), 2, "--jobs is for several recordings: give --count as well"),
        (("--executor", "dask://localhost:1"), 2, "--executor is for several recordings: give --count as well"),
        (("--count", 0), 2, "count = 0: must be an integer of at least 1"),
        (("--count", 1, "--jobs", 0), 2, "jobs = 0: must be an integer of at least 1"),
        (("--count", 1, "--jobs", 1, "--executor", "dask://localhost:1"), 2, "give one of them"),
        (("--count", 1, "--executor", "localhost:8786"), 2, "'localhost:8786': must be dask://HOST:PORT"),
        (("--count", 1, "--executor", "dask://localhost"), 2, "must be dask://HOST:PORT"),
        (("--count", 1, "--executor", "dask://localhost:99999"), 2, "must be dask://HOST:PORT"),
    ],
)
def test_options_that_do_not_fit_are_refused_in_words(options, code, message, tmp_path, monkeypatch, capsys):
    assert call(monkeypatch, "record", write_scene(tmp_path), "--out", tmp_path / "out", *options) == code
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_series_from_the_command_line(one_by_one, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    arguments = ("record", write_scene(tmp_path), "--out", out, "--sensing", "particles", "--json")
    assert call(monkeypatch, *arguments, "--count", 2, "--jobs", 1) == 0
    printed = capsys.readouterr()
    names = [str(out / "000000.mcap"), str(out / "000001.mcap")]
    assert json.loads(printed.out) == {"folder": str(out), "recordings": names, "failed": []}
    assert "2 recordings made, 0 kept" in printed.err
    assert contents(out) == {name: one_by_one[name] for name in contents(out)} and len(contents(out)) == 4
    assert call(monkeypatch, *arguments, "--count", 2) == 0
    assert "0 recordings made, 2 kept" in capsys.readouterr().err


def test_a_secret_is_in_no_recording_and_no_log(tmp_path, monkeypatch, capsys):
    """Neither the printed lines nor the log of a cluster, which has the repr of an order, name the disturbance."""
    path = write_scene(tmp_path)
    path.write_text("secret = true\n" + SCENE)
    out, shown = tmp_path / "out", []
    arguments = ("record", path, "--out", out, "--sensing", "particles", "--disturb", "gravity=0.5")
    assert call(monkeypatch, *arguments, "--count", 1, "--jobs", 1) == 0
    logging = Inside(lambda order: shown.append(repr(order)))
    record(disturbed(load_scene(path), ["gravity=0.5"]), tmp_path / "again", logging, count=1)
    printed = "".join(capsys.readouterr()) + "".join(shown) + str([*out.iterdir()])
    assert len(shown) == 1
    assert "gravity" not in printed.lower() and "disturb" not in printed.lower()
    assert b"disturb" not in (out / "000000.mcap").read_bytes()
    assert "seed" not in Recording.open(out / "000000.mcap").metadata
    details = json.dumps(read_truth(truth_path(out / "000000.mcap")).details)
    assert '"name": "gravity"' in details and '"seed": 0' in details


def test_a_secret_scene_recorded_again_differs_in_its_identity_alone(tmp_path):
    """The salt is random, so that nobody finds the scene by trying out digests; a series knows its own by the truth."""
    path = write_scene(tmp_path)
    path.write_text("secret = true\n" + SCENE)
    scene, identities, rest = load_scene(path), [], []
    for folder in (tmp_path / "one", tmp_path / "other"):
        record(scene, folder, Inside(lambda _: None), count=1)
        assert record(scene, folder, Inside(lambda _: None), count=1).n_kept == 1
        records = records_of((folder / "000000.mcap").read_bytes())
        identities += [each.entries.pop("identity") for each in records if each.name == METADATA]
        rest.append(records)
        assert read_truth(truth_path(folder / "000000.mcap")).identity == identities[-1]
    assert rest[0] == rest[1] and identities[0] != identities[1]
    assert recording_identity(scene, "particles", 0) not in identities


def test_ctrl_c_leaves_complete_recordings_and_says_how_to_continue(one_by_one, tmp_path):
    """SIGINT to the command alone ends its workers, which clean up."""
    out = tmp_path / "out"
    command = [sys.executable, "-m", "jiggle_mj", "record", str(write_scene(tmp_path)), "--out", str(out)]
    command += ["--sensing", "particles", "--count", "1000", "--jobs", "2"]
    # The background jobs of a shell ignore SIGINT, and a process inherits that.
    previous = signal.signal(signal.SIGINT, signal.default_int_handler)
    running = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    signal.signal(signal.SIGINT, previous)
    until(lambda: (out / "000001.mcap").exists())
    children = Path(f"/proc/{running.pid}/task").glob("*/children")
    workers = " ".join(path.read_text() for path in children).split()
    running.send_signal(signal.SIGINT)
    _, printed = running.communicate(timeout=120)
    assert running.returncode == 130
    assert "the same command, without --overwrite, continues" in printed and "Traceback" not in printed
    assert len(workers) >= 2
    until(lambda: not [worker for worker in workers if Path("/proc", worker).exists()])
    assert left_behind(out) == []
    recorded = contents(out)
    assert (
        recorded and {name: data for name, data in recorded.items() if name in one_by_one}.items() <= one_by_one.items()
    )
    assert all(truth_path(path).exists() for path in out.glob("[0-9]*.mcap") if "truth" not in path.name)
