"""Many recordings of a scene: the same bytes from every executor, and nothing lost or half written when one dies."""

import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace

import pytest

from jiggle_mj.cluster import cluster
from jiggle_mj.episode import observe
from jiggle_mj.errors import ClusterError, OptionError, OutputError, RenderError, SceneError, SimulationError
from jiggle_mj.recording.mcap_files import truth_path
from jiggle_mj.recording.truth import read_truth
from jiggle_mj.scenes import Reference, disturbed, load_scene, programme
from jiggle_mj.series import TRIES, record_series
from jiggle_mj.worker_processes import WorkerProcesses
from tests.support.tiny_scene import call, scene_file

SCENE = """
[tissue]
size = [0.06, 0.06]
spacing = 1e-2
[[attachments]]
shape = "disc"
centre = [0.0, 0.0]
radius = 0.012
stiffness = 3.0
[tweezer]
radius = 8e-3
[programme]
still_frames = 1
points = [[-0.027, -0.027]]
height = 0.02
increments = 1
"""
COUNT = 4


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return load_scene(write_scene(tmp_path_factory.mktemp("scene")))


def write_scene(folder: Path) -> Path:
    return scene_file(folder, name="small", text=SCENE)


@pytest.fixture(scope="module")
def one_by_one(scene, tmp_path_factory):
    """Name to bytes, by the loop that `jiggle-mj record` has without --count."""
    folder = tmp_path_factory.mktemp("one_by_one")
    for seed in range(COUNT):
        with Reference(scene, seed=seed, sensing="particles") as reference:
            for _ in observe(reference, programme(scene), folder / f"{seed:06d}.mcap", seed=seed):
                pass
    return contents(folder)


def contents(folder: Path) -> dict[str, bytes]:
    """Of everything in a folder, hidden files and folders included."""
    return {path.name: path.read_bytes() if path.is_file() else b"a folder" for path in folder.iterdir()}


def record(scene, folder, executor, **options):
    return record_series(scene, folder, **{"count": COUNT, "sensing": "particles", "executor": executor} | options)


@dataclass
class Inside(Executor):
    """Runs a call where it is submitted, after what a test does to it; `None` stands for an executor that is left."""

    before: object = None

    def submit(self, fn, /, *args, **kwargs):
        with ThreadPoolExecutor(1) as thread:
            if self.before is not None:
                self.before(*args)
            return thread.submit(fn, *args, **kwargs)


@dataclass(frozen=True)
class Deadly:
    """A call that kills its own process in the midst of a recording, as long as the marks last."""

    fn: object
    marks: Path
    seed: int

    def __call__(self, order):
        marks = sorted(self.marks.iterdir())
        if order.seed == self.seed and marks:
            marks[0].unlink()
            Reference.truth_frame = lambda _: os.kill(os.getpid(), signal.SIGKILL)  # pyright: ignore
        return self.fn(order)


@dataclass
class Killing(Executor):
    """Hands on to another executor calls of which one seed's kills its worker as often as there are marks."""

    executor: Executor
    marks: Path
    seed: int = 1

    def submit(self, fn, /, *args, **kwargs):
        return self.executor.submit(Deadly(fn, self.marks, self.seed), *args, **kwargs)


def marks(folder: Path, n: int) -> Path:
    made = folder / "marks"
    made.mkdir()
    for k in range(n):
        (made / str(k)).touch()
    return made


def left_behind(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir() if path.name.startswith(".")]


@pytest.mark.parametrize(
    "make", [lambda: WorkerProcesses(1), lambda: WorkerProcesses(2), lambda: ThreadPoolExecutor(2)]
)
def test_the_bytes_are_those_of_one_by_one_for_any_number_of_jobs(make, scene, one_by_one, tmp_path):
    told = []
    with make() as executor:
        series = record(scene, tmp_path / "out", executor, on_done=told.append)
    assert contents(tmp_path / "out") == one_by_one
    assert series.recordings == tuple(tmp_path / "out" / f"{seed:06d}.mcap" for seed in range(COUNT))
    assert (series.failed, series.n_kept) == ({}, 0)
    assert sorted(told) == list(range(COUNT))


def test_a_series_goes_on_where_it_was(scene, one_by_one, tmp_path):
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


def test_more_of_a_series_leaves_what_is_there(scene, one_by_one, tmp_path):
    record(scene, tmp_path, Inside(), count=1, seed=2)
    assert contents(tmp_path) == {name: one_by_one[name] for name in ("000002.mcap", "000002.truth.mcap")}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"sensing": "points"}, "'sensing': 'particles', 'seed': '0'}, not {'name': 'small', 'sensing': 'points'"),
        ({"scene": "other"}, "is of a scene of that name with other contents or disturbances"),
        ({"damage": b""}, "is not an MCAP file"),
        ({"damage": 200}, "is truncated"),
    ],
)
def test_other_files_under_these_names_are_refused_and_left(change, says, scene, one_by_one, tmp_path):
    path, data = tmp_path / "000000.mcap", one_by_one["000000.mcap"]
    damage = change.get("damage", len(data))
    path.write_bytes(data[:damage] if isinstance(damage, int) else damage)
    before = contents(tmp_path)
    other = replace(scene, seed=7) if change.get("scene") else scene
    with pytest.raises(OutputError, match=says) as refused:
        record(other, tmp_path, Inside(pytest.fail), sensing=change.get("sensing", "particles"))
    assert "another folder or pass --overwrite" in str(refused.value)
    assert contents(tmp_path) == before


def test_overwrite_replaces_another_scene(scene, one_by_one, tmp_path):
    (tmp_path / "000000.mcap").write_bytes(one_by_one["000001.mcap"])
    record(scene, tmp_path, Inside(), count=1, overwrite=True)
    assert (tmp_path / "000000.mcap").read_bytes() == one_by_one["000000.mcap"]


def test_a_killed_worker_loses_its_own_recording_once(scene, one_by_one, tmp_path):
    """With two workers of which one dies, each order but the dead one's is carried out once."""
    started = tmp_path / "started"
    with WorkerProcesses(2) as executor:
        series = record(scene, tmp_path / "out", Killing(Counting(executor, started), marks(tmp_path, 1)))
    assert contents(tmp_path / "out") == one_by_one and not series.failed
    assert sorted(started.read_text().split()) == ["0", "1", "1", "2", "3"]


@dataclass
class Counting(Executor):
    """Hands on to another executor, and notes the seeds."""

    executor: Executor
    notes: Path

    def submit(self, fn, /, *args, **kwargs):
        with self.notes.open("a") as file:
            file.write(f"{args[0].seed}\n")
        return self.executor.submit(fn, *args, **kwargs)


def test_a_recording_that_kills_every_worker_is_given_up(scene, one_by_one, tmp_path):
    """After `TRIES` deaths it is reported by its seed, and nothing stands under its name; the others are there."""
    with WorkerProcesses(1) as executor:
        series = record(scene, tmp_path / "out", Killing(executor, marks(tmp_path, TRIES + 1)))
    assert list(series.failed) == [1] and "exit code -9" in series.failed[1]
    assert [path.name for path in (tmp_path / "marks").iterdir()] == [str(TRIES)]
    found = contents(tmp_path / "out")
    assert len(left_behind(tmp_path / "out")) == 1, "what the last dead worker was at"
    assert {name: data for name, data in found.items() if name[0] != "."} == {
        name: data for name, data in one_by_one.items() if not name.startswith("000001")
    }


def test_an_executor_that_breaks_as_a_whole_is_reported_and_a_new_one_goes_on(scene, one_by_one, tmp_path):
    """ProcessPoolExecutor gives up when one process dies: every recording is whole, or reported."""
    out = tmp_path / "out"
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as executor:
        series = record(scene, out, Killing(executor, marks(tmp_path, 1)))
    assert set(series.failed) >= {1}
    assert len(series.recordings) + len(series.failed) == COUNT
    assert all(path.read_bytes() == one_by_one[path.name] for path in series.recordings)
    assert not record(scene, out, Inside()).failed
    assert contents(out) == one_by_one


def fail_at(seed, failure, monkeypatch):
    """Make the second step of a seed's simulation fail."""
    step = Reference.step

    def failing(self, action):
        if self._observer._rng.bit_generator.seed_seq.entropy[1] == seed and self._index == 1:
            raise failure
        return step(self, action)

    monkeypatch.setattr(Reference, "step", failing)


@pytest.mark.parametrize("given_up_by_dask", [False, True])
def test_what_befalls_one_recording_is_reported_by_seed(given_up_by_dask, scene, one_by_one, tmp_path, monkeypatch):
    """A simulation that became unstable, or workers of a cluster that died at it."""
    from distributed import KilledWorker  # here, as the workers import this file

    killed = KilledWorker("record", SimpleNamespace(address="tcp://10.0.0.5:1"), 3)
    failure = killed if given_up_by_dask else SimulationError("unstable at t = 1 s")
    fail_at(2, failure, monkeypatch)
    assert record(scene, tmp_path, Inside()).failed == {2: str(failure)}
    assert contents(tmp_path) == {name: data for name, data in one_by_one.items() if not name.startswith("000002")}


def test_what_would_befall_every_recording_stops_the_series(scene, one_by_one, tmp_path, monkeypatch):
    """No OpenGL: it is raised at once, what is whole stays, what has not begun is cancelled."""
    fail_at(1, RenderError("no EGL device"), monkeypatch)
    with ThreadPoolExecutor(1) as thread, pytest.raises(RenderError, match="no EGL device"):
        record(scene, tmp_path, thread, count=1000)
    assert len(contents(tmp_path)) < 10
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


@pytest.mark.parametrize(
    ("options", "says"),
    [({"count": 0}, "count = 0: must be at least 1"), ({"seed": -1}, "seed = -1: must be an integer of at least 0")],
)
def test_numbers_out_of_range_are_refused_before_anything_is_written(options, says, scene, tmp_path):
    with pytest.raises(OptionError, match=says):
        record(scene, tmp_path / "out", Inside(pytest.fail), **options)
    assert contents(tmp_path) == {}


# The command line


@pytest.mark.parametrize(
    ("options", "code", "says"),
    [
        (("--jobs", 2), 2, "--jobs is for many recordings: give --count too"),
        (("--executor", "dask://localhost:1"), 2, "--executor is for many recordings: give --count too"),
        (("--count", 0), 2, "count = 0: must be at least 1"),
        (("--count", 1, "--jobs", 0), 2, "jobs = 0: must be at least 1"),
        (("--count", 1, "--jobs", 1, "--executor", "dask://localhost:1"), 2, "give one of them"),
        (("--count", 1, "--executor", "localhost:8786"), 2, "'localhost:8786': must be dask://HOST:PORT"),
        (("--count", 1, "--executor", "dask://localhost"), 2, "must be dask://HOST:PORT"),
        (("--count", 1, "--executor", "dask://localhost:99999"), 2, "must be dask://HOST:PORT"),
    ],
)
def test_options_that_do_not_fit_are_refused_in_words(options, code, says, tmp_path, monkeypatch, capsys):
    assert call(monkeypatch, "record", write_scene(tmp_path), "--out", tmp_path / "out", *options) == code
    assert says in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_series_from_the_command_line(one_by_one, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    order = ("record", write_scene(tmp_path), "--out", out, "--sensing", "particles", "--json")
    assert call(monkeypatch, *order, "--count", 2, "--jobs", 1) == 0
    printed = capsys.readouterr()
    names = [str(out / "000000.mcap"), str(out / "000001.mcap")]
    assert json.loads(printed.out) == {"folder": str(out), "recordings": names, "failed": []}
    assert "2 recordings made, 0 kept" in printed.err
    assert contents(out) == {name: one_by_one[name] for name in contents(out)} and len(contents(out)) == 4
    assert call(monkeypatch, *order, "--count", 2) == 0
    assert "0 recordings made, 2 kept" in capsys.readouterr().err


def test_a_secret_is_in_no_recording_and_no_log(tmp_path, monkeypatch, capsys):
    """Neither in what is printed nor in what a cluster would log of a call: the repr of its argument."""
    path = write_scene(tmp_path)
    path.write_text("secret = true\n" + SCENE)
    out, shown = tmp_path / "out", []
    order = ("record", path, "--out", out, "--sensing", "particles", "--disturb", "gravity=0.5")
    assert call(monkeypatch, *order, "--count", 1, "--jobs", 1) == 0
    logging = Inside(lambda one: shown.append(repr(one)))
    record(disturbed(load_scene(path), ["gravity=0.5"]), tmp_path / "again", logging, count=1)
    told = "".join(capsys.readouterr()) + "".join(shown) + str([*out.iterdir()])
    assert len(shown) == 1
    assert "gravity" not in told.lower() and "disturb" not in told.lower()
    recorded = (out / "000000.mcap").read_bytes()
    assert recorded == (tmp_path / "again" / "000000.mcap").read_bytes() and b"disturb" not in recorded
    told_by_truth = json.dumps(read_truth(truth_path(out / "000000.mcap")).details)
    assert '"name": "gravity"' in told_by_truth


def test_ctrl_c_leaves_whole_recordings_and_says_how_to_go_on(one_by_one, tmp_path):
    """SIGINT to the command alone: it ends its workers, which clean up; the same command then goes on."""
    out = tmp_path / "out"
    command = [sys.executable, "-m", "jiggle_mj", "record", str(write_scene(tmp_path)), "--out", str(out)]
    command += ["--sensing", "particles", "--count", "1000", "--jobs", "2"]
    heard = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs inherit deaf ears
    running = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    signal.signal(signal.SIGINT, heard)
    until(lambda: (out / "000001.mcap").exists())
    children = Path(f"/proc/{running.pid}/task").glob("*/children")
    workers = " ".join(path.read_text() for path in children).split()
    running.send_signal(signal.SIGINT)
    _, told = running.communicate(timeout=120)
    assert running.returncode == 130
    assert "the same command, without --overwrite, goes on" in told and "Traceback" not in told
    assert len(workers) >= 2
    until(lambda: not [worker for worker in workers if Path("/proc", worker).exists()])
    assert left_behind(out) == []
    found = contents(out)
    assert found and {name: data for name, data in found.items() if name in one_by_one}.items() <= one_by_one.items()
    assert all(truth_path(path).exists() for path in out.glob("[0-9]*.mcap") if "truth" not in path.name)


def until(holds, seconds: float = 60.0) -> None:
    """Wait until something holds."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "it never came to hold"
        time.sleep(0.02)


# A cluster


def open_files(pid: int) -> list[str]:
    """What a process holds open; nothing where that closes in the meantime."""
    try:
        return [os.readlink(link) for link in Path(f"/proc/{pid}/fd").iterdir()]
    except FileNotFoundError:
        return []


@contextmanager
def dask_cluster(folder: Path, n_workers: int):
    """A scheduler and workers without nannies, each a process on loopback: the URL and the workers' processes."""
    address = folder / "scheduler.json"
    started, log = [], (folder / "dask.log").open("w")

    def start(*words):
        command = [sys.executable, "-m", "distributed.cli." + words[0], *words[1:]]
        started.append(subprocess.Popen(command, stdout=log, stderr=log, cwd=folder))

    try:
        start(
            "dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(address)
        )
        until(lambda: address.exists() and address.read_text().endswith("}"))
        for _ in range(n_workers):
            start("dask_worker", "--scheduler-file", str(address), "--no-nanny", "--nthreads", "1", "--no-dashboard")
        yield json.loads(address.read_text())["address"].replace("tcp://", "dask://"), started[1:]
    finally:
        for one in started:
            one.kill()
            one.wait()
        log.close()


def test_a_cluster_of_which_a_worker_is_killed_makes_the_same_recordings(one_by_one, tmp_path, monkeypatch, capsys):
    """A real scheduler and two workers; the first that is at a recording is killed in its midst."""
    out = tmp_path / "out"
    with dask_cluster(tmp_path, 2) as (url, workers):
        killed = []

        def kill_one():
            """The worker whose process holds an unfinished recording open."""
            busy = [one for one in workers if any(f"{out}/." in path for path in open_files(one.pid))]
            if busy and not killed:
                killed.append(busy[0])
                busy[0].kill()
            return bool(killed)

        with ThreadPoolExecutor(1) as watch:
            watched = watch.submit(until, kill_one)
            arguments = ("--out", out, "--sensing", "particles", "--count", COUNT, "--executor", url, "--json")
            assert call(monkeypatch, "record", write_scene(tmp_path), *arguments) == 0
            watched.result()
        assert [one.poll() for one in workers if one not in killed] == [None]
    assert killed[0].returncode == -signal.SIGKILL
    assert len(json.loads(capsys.readouterr().out)["recordings"]) == COUNT
    assert contents(out) == one_by_one


def test_a_scheduler_without_workers_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("jiggle_mj.cluster.WORKERS_WITHIN", 1)
    with (
        dask_cluster(tmp_path, 0) as (url, _),
        pytest.raises(ClusterError, match=rf"the scheduler at {url} has no workers. Start some"),
        cluster(url),
    ):
        pass


def test_a_scheduler_that_does_not_answer_is_named(monkeypatch):
    monkeypatch.setattr("jiggle_mj.cluster.PATIENCE", "300ms")
    with (
        pytest.raises(ClusterError, match="no Dask scheduler answers at dask://localhost:9"),
        cluster("dask://localhost:9"),
    ):
        pass


def test_without_dask_the_message_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "distributed", None)
    order = (
        "record",
        write_scene(tmp_path),
        "--out",
        tmp_path / "out",
        "--count",
        1,
        "--executor",
        "dask://localhost:1",
    )
    assert call(monkeypatch, *order) == 1
    assert "pip install 'jiggle-mj[cluster]'" in capsys.readouterr().err
