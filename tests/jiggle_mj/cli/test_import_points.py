"""The verb `import` keeps no points from which an estimate could not begin, and says why."""

import re

import numpy as np
import pytest

from tests.support.measured_folder import TOML, folder
from tests.support.tiny_scene import call

TOML_OF_ARRAY = TOML.replace('files = ["rest.xyz", "pulled_*.xyz"]', 'files = ["d.npz"]\nkey = "p"').split("[truth]")[0]


def lifted(columns: int = 8, rows: int = 6) -> np.ndarray:
    """A sheet of 5 mm pitch whose corner rises by 12 mm in six frames, with 0.05 mm of noise [mm]."""
    x, y = np.meshgrid(5.0 * np.arange(columns) + 30.4, 5.0 * np.arange(rows) + 20.3)
    rest = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 3.3)])
    decay = np.exp(-np.linalg.norm(rest - rest[0], axis=1) / 12)
    up = np.linspace(0, 12, 6)[:, None, None] * decay[:, None] * np.array([0, 0, 1.0])
    return rest + up + np.random.default_rng(7).normal(scale=0.05, size=up.shape)


def two_sheets() -> np.ndarray:
    other = lifted()[0] + [80.0, 0, 0]
    return np.concatenate([lifted(), np.repeat(other[np.newaxis], 6, axis=0)], axis=1)


@pytest.mark.parametrize(
    ("positions", "grasp", "why"),
    [
        (lifted(), "", None),
        (two_sheets(), "", r"not one sheet: the mesh has 2 disconnected sheets, of \[48, 48\]"),
        (lifted(40, 1) * [1, 0, 0], "", "not one sheet: 40 points make no sheet: three that are not on one line"),
        (lifted(4, 3), "", "not one sheet: 12 points are seen .* a sheet needs 20"),
        (lifted()[:1], "", "one-frame: one frame only"),
        (lifted(), 'rows = "near tool"\nradius = 1.0\ntool = "t"', "radius is 1 m, and the sheet is 0.0351 m large"),
    ],
)
def test_points_from_which_no_estimate_begins_are_not_kept(tmp_path, monkeypatch, capsys, positions, grasp, why):
    where = folder(tmp_path, toml=TOML_OF_ARRAY.replace("rows = [0, 1]", grasp or "rows = [0, 1]"))
    np.savez(where / "d.npz", p=positions, t=positions[:, 0])
    code = call(monkeypatch, "import", where, "--out", where / "run.mcap")
    assert (code, (where / "run.mcap").exists()) == ((0, True) if why is None else (1, False))
    assert re.search(why or "", capsys.readouterr().err)
