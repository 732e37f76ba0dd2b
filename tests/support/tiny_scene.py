"""A scene file of a sheet of 60 mm with about 90 vertices, and calls of the command line in this process."""

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
    """Write a scene file into a folder and return its path."""
    path = folder / f"{name}.toml"
    path.write_text(text)
    return path


def call(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """Run `jiggle-mj ARGUMENTS` in this process and return its exit code."""
    monkeypatch.setattr(sys, "argv", ["jiggle-mj", *map(str, arguments)])
    try:
        main()
    except SystemExit as stopped:
        return 0 if stopped.code is None else int(stopped.code)
    return 0
