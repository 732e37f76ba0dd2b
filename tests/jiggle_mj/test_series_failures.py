"""Workers that die and simulations that fail: nothing is lost or half written, and the rest continues."""

import itertools
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from types import SimpleNamespace

import pytest

from jiggle_mj.errors import RenderError, SceneError, SimulationError
from jiggle_mj.run_each import TRIES
from jiggle_mj.scenes import Reference, disturbed
from jiggle_mj.worker_processes import WorkerProcesses
from tests.support.series import (
    COUNT,
    Counting,
    Inside,
    Killing,
    contents,
    left_behind,
    marks,
    record,
)

FEW_FILES = 10
"""Files of the recordings that a thread completes before the others of a thousand are cancelled: usually two."""


@dataclass
class Failing(Executor):
    """Passes calls to an executor of one thread; the second step of one seed's simulation raises an error."""

    executor: Executor
    seed: int
    failure: Exception

    def submit(self, fn, /, *args, **kwargs):
        return self.executor.submit(self._call, fn, *args)

    def _call(self, fn, order):
        if order.seed != self.seed:
            return fn(order)
        step, steps = Reference.step, itertools.count()

        def failing(reference, action):
            if next(steps) == 1:
                raise self.failure
            return step(reference, action)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Reference, "step", failing)
            return fn(order)


def test_a_killed_worker_loses_its_own_recording_once(scene, one_by_one, tmp_path):
    """With two workers of which one dies, each order but the dead one's is executed once."""
    started = tmp_path / "started"
    with WorkerProcesses(2) as executor:
        series = record(scene, tmp_path / "out", Killing(Counting(executor, started), marks(tmp_path, 1)))
    assert contents(tmp_path / "out") == one_by_one and not series.failed
    assert sorted(started.read_text().split()) == ["0", "1", "1", "2", "3"]


def test_a_recording_that_kills_every_worker_is_given_up(scene, one_by_one, tmp_path):
    """After `TRIES` deaths it is reported by its seed, and nothing stands under its name; the others are there."""
    with WorkerProcesses(1) as executor:
        series = record(scene, tmp_path / "out", Killing(executor, marks(tmp_path, TRIES + 1)))
    assert list(series.failed) == [1] and "exit code -9" in series.failed[1]
    assert [path.name for path in (tmp_path / "marks").iterdir()] == [str(TRIES)]
    remaining = contents(tmp_path / "out")
    assert len(left_behind(tmp_path / "out")) == 1, "the unfinished recording of the last dead worker"
    assert {name: data for name, data in remaining.items() if name[0] != "."} == {
        name: data for name, data in one_by_one.items() if not name.startswith("000001")
    }


def test_an_executor_that_breaks_as_a_whole_is_reported_and_a_new_one_continues(scene, one_by_one, tmp_path):
    """ProcessPoolExecutor gives up when one process dies: every recording is complete, or reported."""
    out = tmp_path / "out"
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as executor:
        series = record(scene, out, Killing(executor, marks(tmp_path, 1)))
    assert set(series.failed) >= {1}
    assert len(series.recordings) + len(series.failed) == COUNT
    assert all(path.read_bytes() == one_by_one[path.name] for path in series.recordings)
    assert not record(scene, out, Inside()).failed
    assert contents(out) == one_by_one


@pytest.mark.parametrize("given_up_by_dask", [False, True])
def test_the_failure_of_one_recording_is_reported_by_seed(given_up_by_dask, scene, one_by_one, tmp_path):
    """A simulation that became unstable, or workers of a cluster that died at it."""
    from distributed import KilledWorker  # here, as the workers import this file

    killed = KilledWorker("record", SimpleNamespace(address="tcp://10.0.0.5:1"), 3)
    failure = killed if given_up_by_dask else SimulationError("unstable at t = 1 s")
    assert record(scene, tmp_path, Failing(Inside(), 2, failure)).failed == {2: str(failure)}
    assert contents(tmp_path) == {name: data for name, data in one_by_one.items() if not name.startswith("000002")}


def test_a_failure_of_every_recording_stops_the_series(scene, one_by_one, tmp_path):
    """Without OpenGL the error is raised at once, complete recordings stay, and the others are cancelled."""
    with ThreadPoolExecutor(1) as thread, pytest.raises(RenderError, match="no EGL device"):
        record(scene, tmp_path, Failing(thread, 1, RenderError("no EGL device")), count=1000)
    assert len(contents(tmp_path)) < FEW_FILES
    assert {
        name: contents(tmp_path)[name] for name in ("000000.mcap", "000000.truth.mcap")
    }.items() <= one_by_one.items()
    assert left_behind(tmp_path) == []


def test_the_state_of_an_unstable_simulation_is_kept_for_each_seed(scene, tmp_path, monkeypatch):
    from jiggle_mj.scenes.tissue import simulation

    monkeypatch.setattr(simulation, "MAX_SPEED", 1e-6)
    series = record(scene, tmp_path, Inside(), count=2)
    assert list(series.failed) == [0, 1]
    assert {path.name for path in tmp_path.iterdir()} == {"000000.failed", "000001.failed"}
    assert str(tmp_path / "000001.failed" / "unstable_state.npz") in series.failed[1]


def test_a_worker_process_raises_what_its_call_raised(scene, tmp_path):
    """A disturbance of images in a recording of particles is impossible: a SceneError, from another process."""
    with WorkerProcesses(1) as executor, pytest.raises(SceneError, match="needs sensing"):
        record(disturbed(scene, ["blur"]), tmp_path, executor)
    assert contents(tmp_path) == {}
