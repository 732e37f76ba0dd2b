"""A scene of 60 mm and about 90 vertices, and the command line called in this process."""

import sys
from pathlib import Path

import pytest

from jiggle_mj.cli import main

SCENE = """
seed = 3
[tissue]
size = [0.06, 0.06]
spacing = 7e-3
mesh = "unstructured"
seed = 3
[[attachments]]
shape = "disc"
centre = [0.0, 0.0]
radius = 0.012
stiffness = 3.0
[tweezer]
radius = 8e-3
[programme]
still_frames = 2
height = 0.03
increments = 3

"""


def scene_file(folder: Path, *, name: str = "tiny", text: str = SCENE) -> Path:
    path = folder / f"{name}.toml"
    path.write_text(text)
    return path


def call(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """The exit code of `jiggle-mj ARGUMENTS`."""
    monkeypatch.setattr(sys, "argv", ["jiggle-mj", *map(str, arguments)])
    try:
        main()
    except SystemExit as leave:
        return 0 if leave.code is None else int(leave.code)
    return 0
