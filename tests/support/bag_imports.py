"""Bags of several parts, and what becomes of them when they are imported."""

from collections.abc import Callable
from pathlib import Path

import pytest

from jiggle_mj import Recording
from jiggle_mj.errors import RecordingError
from jiggle_mj.importing.bags.importer import BagSummary, import_bag
from jiggle_mj.importing.bags.settings import BagSettings
from tests.support.robot_bags import RobotBag, small_camera


def bag(path: Path, *parts: Callable[[RobotBag], object]) -> Path:
    with RobotBag(path / "bag") as made:
        for part in parts:
            part(made)
    return made.path


def cameras(made: RobotBag) -> None:
    made.cameras(small_camera())


def imported(path: Path, **settings) -> tuple[BagSummary, Recording]:
    summary = import_bag(path, path.parent / "run.mcap", BagSettings(**settings), overwrite=True)
    return summary, Recording.open(path.parent / "run.mcap")


def refused(path: Path, **settings) -> str:
    with pytest.raises(RecordingError) as failure:
        imported(path, **settings)
    assert not (path.parent / "run.mcap").exists() and "\n" not in str(failure.value)
    return str(failure.value)
