"""A Dask cluster as the executor: a killed worker, no workers, no scheduler, no Dask."""

import json
import os
import signal
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from jiggle_mj.cluster import cluster
from jiggle_mj.errors import ClusterError
from tests.support.dask_cluster import dask_cluster
from tests.support.series import (
    COUNT,
    contents,
    until,
    write_scene,
)
from tests.support.tiny_scene import call


def open_files(pid: int) -> list[str]:
    """Return the files that a process holds open; none where it closes one in the meantime."""
    try:
        return [os.readlink(link) for link in Path(f"/proc/{pid}/fd").iterdir()]
    except FileNotFoundError:
        return []


def test_a_cluster_of_which_a_worker_is_killed_makes_the_same_recordings(one_by_one, tmp_path, monkeypatch, capsys):
    """A scheduler and two workers; the first one that makes a recording is killed while it does."""
    out = tmp_path / "out"
    with dask_cluster(tmp_path, 2) as (url, workers):
        killed = []

        def kill_one():
            """Kill the worker whose process holds an unfinished recording open."""
            busy = [each for each in workers if any(f"{out}/." in path for path in open_files(each.pid))]
            if busy and not killed:
                killed.append(busy[0])
                busy[0].kill()
            return bool(killed)

        with ThreadPoolExecutor(1) as watch:
            watched = watch.submit(until, kill_one)
            arguments = ("--out", out, "--sensing", "particles", "--count", COUNT, "--executor", url, "--json")
            assert call(monkeypatch, "record", write_scene(tmp_path), *arguments) == 0
            watched.result()
        assert [each.poll() for each in workers if each not in killed] == [None]
    assert killed[0].returncode == -signal.SIGKILL
    assert len(json.loads(capsys.readouterr().out)["recordings"]) == COUNT
    assert contents(out) == one_by_one


def test_a_scheduler_without_workers_is_refused(tmp_path):
    with (
        dask_cluster(tmp_path, 0) as (url, _),
        pytest.raises(ClusterError, match=rf"the scheduler at {url} has no workers. Start some"),
        cluster(url, worker_timeout_s=1.0),
    ):
        pass


def test_a_scheduler_that_does_not_answer_is_named():
    with (
        pytest.raises(ClusterError, match="no Dask scheduler answers at dask://localhost:9"),
        cluster("dask://localhost:9", connect_timeout_s=0.3),
    ):
        pass


def test_without_dask_the_message_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "distributed", None)
    arguments = (
        "record",
        write_scene(tmp_path),
        "--out",
        tmp_path / "out",
        "--count",
        1,
        "--executor",
        "dask://localhost:1",
    )
    assert call(monkeypatch, *arguments) == 1
    assert "pip install 'jiggle-mj[cluster]'" in capsys.readouterr().err
