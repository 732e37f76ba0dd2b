"""A folder of measured points of a small sheet, which tests import."""

from pathlib import Path

import numpy as np

from jiggle_mj.importing.folder import ImportSummary, import_folder
from jiggle_mj.recording.reader import Recording

ROUNDING = 1e-15
"""Absolute tolerance of coordinates of a few cm [m], once scaled and rotated."""
TOML = """
name = "grid"
unit = "mm"
period = 0.5
noise_sd = 1e-4
[points]
files = ["rest.xyz", "pulled_*.xyz"]
[grasp]
rows = [0, 1]
[truth]
attached_rows = [11, 12]
attached_rows_first = 1
[declaration]
gravity = [0.0, 0.0, 0.0]
bed = false
"""


def grid() -> np.ndarray:
    """A 4 x 3 sheet of 2 mm pitch [mm]; row 0 is a corner."""
    x, y = np.meshgrid(np.arange(4) * 2.0, np.arange(3) * 2.0)
    return np.column_stack([x.ravel(), y.ravel(), np.full(12, 5.0)])


GRID_FACES = [
    triangle
    for row in range(2)
    for i in range(4 * row, 4 * row + 3)
    for triangle in ([i, i + 1, i + 4], [i + 1, i + 5, i + 4])
]


def folder(tmp_path: Path, *, toml: str = TOML, frames: list[np.ndarray] | None = None) -> Path:
    where = tmp_path / "data"
    where.mkdir()
    lifted = grid()
    lifted[:2, 2] += 3
    for name, points in zip(("rest", "pulled_1", "pulled_2"), frames or [grid(), lifted, lifted + 1], strict=True):
        np.savetxt(where / f"{name}.xyz", points)
    (where / "recording.toml").write_text(toml)
    return where


def bring_in(where: Path, **settings) -> tuple[ImportSummary, Recording]:
    summary = import_folder(where, None, where / "run.mcap", **settings)
    return summary, Recording.open(summary.recording)


def npz_folder(tmp_path: Path, *, faces: list[list[int]], mesh: str = 'faces = "f"') -> Path:
    """The same grid as an .npz, row 11 unseen at rest."""
    points = np.stack([grid(), grid() + 1])
    points[0, 11] = np.nan
    old = 'files = ["rest.xyz", "pulled_*.xyz"]'
    toml = TOML.replace(old, 'files = ["d.npz"]\nkey = "p"').replace("[grasp]", f"[mesh]\n{mesh}\n[grasp]")
    where = folder(tmp_path, toml=toml)
    np.savez(where / "d.npz", p=points, f=np.array(faces))
    return where
