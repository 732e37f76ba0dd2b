"""Many recordings of a scene: the same bytes from every executor, and a series that continues where it stopped."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

from jiggle_mj.errors import OptionError, OutputError
from jiggle_mj.worker_processes import WorkerProcesses
from tests.support.series import COUNT, Inside, contents, record


@pytest.mark.parametrize(
    "make", [lambda: WorkerProcesses(1), lambda: WorkerProcesses(2), lambda: ThreadPoolExecutor(2)]
)
def test_the_bytes_are_those_of_one_by_one_for_any_number_of_jobs(make, scene, one_by_one, tmp_path):
    reported = []
    with make() as executor:
        series = record(scene, tmp_path / "out", executor, on_done=reported.append)
    assert contents(tmp_path / "out") == one_by_one
    assert series.recordings == tuple(tmp_path / "out" / f"{seed:06d}.mcap" for seed in range(COUNT))
    assert (series.failed, series.n_kept) == ({}, 0)
    assert sorted(reported) == list(range(COUNT))


def test_an_interrupted_series_continues(scene, one_by_one, tmp_path):
    """A recording without its truth, a truth without its recording and what a killed worker left are made anew."""
    for name, data in one_by_one.items():
        (tmp_path / name).write_bytes(data)
    (tmp_path / "000001.mcap").unlink()
    (tmp_path / "000002.truth.mcap").unlink()
    (tmp_path / "000003.mcap").unlink()
    (tmp_path / "000003.truth.mcap").unlink()
    (tmp_path / ".000003-killed").mkdir()
    (tmp_path / ".000003-killed" / "000003.mcap").write_bytes(b"half")
    before = (tmp_path / "000000.mcap").stat().st_mtime_ns
    started = []
    series = record(scene, tmp_path, Inside(lambda order: started.append(order.seed)))
    assert started == [1, 2, 3] and series.n_kept == 1
    assert contents(tmp_path) == one_by_one
    assert (tmp_path / "000000.mcap").stat().st_mtime_ns == before
    assert record(scene, tmp_path, Inside(started.append)).n_kept == COUNT and len(started) == 3


def test_the_truth_gets_its_name_before_the_recording(scene, tmp_path, monkeypatch):
    """Killed in between, what stands under a recording's name still has its truth."""

    give_name = Path.replace

    def killed_at_the_recording(self, name):
        if name.name == "000000.mcap":
            raise SystemExit
        give_name(self, name)

    monkeypatch.setattr(Path, "replace", killed_at_the_recording)
    with pytest.raises(SystemExit):
        record(scene, tmp_path, Inside(), count=1)
    assert list(contents(tmp_path)) == ["000000.truth.mcap"]


def test_a_later_seed_gives_the_same_bytes_alone(scene, one_by_one, tmp_path):
    record(scene, tmp_path, Inside(), count=1, seed=2)
    assert contents(tmp_path) == {name: one_by_one[name] for name in ("000002.mcap", "000002.truth.mcap")}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sensing": "points"}, "'sensing': 'particles', 'seed': '0'}, not {'name': 'small', 'sensing': 'points'"),
        ({"scene": "other"}, "is a recording of a scene of that name with other contents or disturbances"),
        ({"damage": b""}, "is not an MCAP file"),
        ({"damage": 200}, "is truncated"),
    ],
)
def test_other_files_under_these_names_are_refused_and_left(change, message, scene, one_by_one, tmp_path):
    path, data = tmp_path / "000000.mcap", one_by_one["000000.mcap"]
    damage = change.get("damage", len(data))
    path.write_bytes(data[:damage] if isinstance(damage, int) else damage)
    before = contents(tmp_path)
    other_scene = replace(scene, seed=7) if change.get("scene") else scene
    with pytest.raises(OutputError, match=message) as refused:
        record(other_scene, tmp_path, Inside(pytest.fail), sensing=change.get("sensing", "particles"))
    assert "another folder or pass --overwrite" in str(refused.value)
    assert contents(tmp_path) == before


def test_overwrite_replaces_another_scene(scene, one_by_one, tmp_path):
    (tmp_path / "000000.mcap").write_bytes(one_by_one["000001.mcap"])
    record(scene, tmp_path, Inside(), count=1, overwrite=True)
    assert (tmp_path / "000000.mcap").read_bytes() == one_by_one["000000.mcap"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"count": 0}, "count = 0: must be an integer of at least 1"),
        ({"count": 10**12}, "at most 100000 recordings are made"),
        ({"seed": -1}, "seed = -1: must be an integer of at least 0"),
    ],
)
def test_numbers_out_of_range_are_refused_before_anything_is_written(options, message, scene, tmp_path):
    with pytest.raises(OptionError, match=message):
        record(scene, tmp_path / "out", Inside(pytest.fail), **options)
    assert contents(tmp_path) == {}
