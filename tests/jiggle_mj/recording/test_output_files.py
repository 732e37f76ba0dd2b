"""A file has its name when it is complete, two writers refuse each other, and a killed one loses and blocks nothing."""

import multiprocessing
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from jiggle_mj.errors import OutputError, RecordingError
from jiggle_mj.recording.output_files import discard, folder_lock, partial_path, write_text
from jiggle_mj.recording.reader import Recording
from jiggle_mj.recording.truth import TruthWriter, read_truth
from tests.support.recordings import observations, read_all, truth, write

WRITE_AND_WAIT = """
import sys
from tests.support.recordings import observations
from jiggle_mj.observation import Declaration
from jiggle_mj.recording.writer import RecordingWriter
writer = RecordingWriter(sys.argv[1], camera=None, declaration=Declaration(), metadata={})
from dataclasses import replace
writer.write(replace(observations(1)[0], images=None))
print("written", flush=True)
sys.stdin.read()
"""
"""Script that writes a frame and waits to be killed."""


def killed_writer(path: Path, while_it_writes) -> None:
    """Write a frame in another process, call a function while it writes, and kill it."""
    process = subprocess.Popen(
        [sys.executable, "-c", WRITE_AND_WAIT, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[3])},
    )
    assert process.stdout is not None and process.stdout.readline() == b"written\n"
    while_it_writes()
    process.send_signal(signal.SIGKILL)
    process.communicate()


def test_what_a_killed_process_wrote_is_read_and_blocks_nobody(tmp_path):
    path = tmp_path / "run.mcap"

    def second_writer() -> None:
        for overwrite in (False, True):
            with pytest.raises(OutputError, match="being written by another process"):
                write(path, observations(1), overwrite=overwrite)
        with pytest.raises(OutputError, match="being written by another process"):
            discard(path)

    killed_writer(path, second_writer)
    assert not path.exists()
    with pytest.raises(RecordingError, match=r"not complete.*--allow-truncated from .*run\.mcap\.part"):
        Recording.open(path)
    seen, skipped = read_all(partial_path(path), allow_truncated=True)
    assert len(seen) == 1 and skipped == []
    with pytest.raises(OutputError, match="an interrupted run left"):
        write(path, observations(1))
    write(path, observations(2), overwrite=True)
    assert len(Recording.open(path)) == 2 and not partial_path(path).exists()


def test_the_truth_of_a_killed_run_can_be_read(tmp_path):
    given = truth()
    writer = TruthWriter(
        tmp_path / "run.truth.mcap",
        rest=given.rest,
        faces=given.faces,
        attached=given.attached,
        scene="arc",
        details={},
    )
    writer.write(given.frames[0])
    partial = partial_path(tmp_path / "run.truth.mcap")
    with pytest.raises(RecordingError, match=r"truncated.*--allow-truncated"):
        read_truth(partial)
    assert len(read_truth(partial, allow_truncated=True).frames) == 1
    writer.close()


def test_a_text_is_written_whole_or_not_at_all(tmp_path):
    path = tmp_path / "result.json"
    path.write_text("old")
    with pytest.raises(UnicodeEncodeError):
        write_text(path, "new \udc80")
    assert path.read_text() == "old"
    write_text(path, "new")
    assert path.read_text() == "new" and [each.name for each in tmp_path.iterdir()] == ["result.json"]
    with pytest.raises(OutputError, match="cannot be written"):
        write_text(tmp_path / "no" / "result.json", "new")


def _hold(folder: Path, held, release) -> None:
    with folder_lock(folder):
        held.set()
        release.wait()


def test_two_jobs_cannot_fill_one_folder(tmp_path):
    """The lock is the operating system's, so that a killed job does not keep it."""
    folder, context = tmp_path / "out", multiprocessing.get_context("spawn")
    held, release = context.Event(), context.Event()
    other = context.Process(target=_hold, args=(folder, held, release))
    other.start()
    assert held.wait(60)
    with pytest.raises(OutputError, match="another process writes its results"), folder_lock(folder):
        pass
    other.kill()
    other.join()
    with folder_lock(folder):
        (folder / "kept").touch()
    assert folder.exists()
    with folder_lock(tmp_path / "new"):
        pass
    assert not (tmp_path / "new").exists(), "a folder that a job left empty is removed again"


def test_a_link_keeps_its_place(tmp_path):
    (tmp_path / "disk").mkdir()
    link = tmp_path / "run.mcap"
    link.symlink_to(tmp_path / "disk" / "there.mcap")
    write(link, observations(1))
    assert link.is_symlink() and len(Recording.open(tmp_path / "disk" / "there.mcap")) == 1
