"""The file of a small scene, the contents of folders, and executors that count calls or kill their workers."""

import os
import signal
import time
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from jiggle_mj.scenes import Reference
from jiggle_mj.series import record_series
from tests.support.tiny_scene import scene_file

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
"""Recordings of a series."""


def write_scene(folder: Path) -> Path:
    return scene_file(folder, name="small", text=SCENE)


def contents(folder: Path) -> dict[str, bytes]:
    """Return name and bytes of everything in a folder, hidden files and folders included."""
    return {path.name: path.read_bytes() if path.is_file() else b"a folder" for path in folder.iterdir()}


def record(scene, folder, executor, **options):
    return record_series(scene, folder, **{"count": COUNT, "sensing": "particles", "executor": executor} | options)


@dataclass
class Inside(Executor):
    """Runs each call at once in a thread, after a function of the test saw its order."""

    before: object = None

    def submit(self, fn, /, *args, **kwargs):
        with ThreadPoolExecutor(1) as thread:
            if self.before is not None:
                self.before(*args)
            return thread.submit(fn, *args, **kwargs)


@dataclass(frozen=True)
class Deadly:
    """A call that kills its own process during the recording of one seed, as long as there are marks."""

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
    """Passes calls to another executor; the calls of one seed kill their worker as often as there are marks."""

    executor: Executor
    marks: Path
    seed: int = 1

    def submit(self, fn, /, *args, **kwargs):
        return self.executor.submit(Deadly(fn, self.marks, self.seed), *args, **kwargs)


@dataclass
class Counting(Executor):
    """Passes calls to another executor, and writes down their seeds."""

    executor: Executor
    notes: Path

    def submit(self, fn, /, *args, **kwargs):
        with self.notes.open("a") as file:
            file.write(f"{args[0].seed}\n")
        return self.executor.submit(fn, *args, **kwargs)


def marks(folder: Path, n: int) -> Path:
    """Make a folder with n files, one for each worker to kill."""
    marks_folder = folder / "marks"
    marks_folder.mkdir()
    for k in range(n):
        (marks_folder / str(k)).touch()
    return marks_folder


def left_behind(folder: Path) -> list[str]:
    """Return the hidden files and folders of a series."""
    return [path.name for path in folder.iterdir() if path.name.startswith(".")]


def until(holds, seconds: float = 60.0) -> None:
    """Wait until a condition holds."""
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "the condition never held"
        time.sleep(0.02)
