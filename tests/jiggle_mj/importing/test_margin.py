"""Sheet beyond the view: a margin, or an outline."""

import numpy as np
import pytest

from jiggle_mj.errors import MeshError, RecordingError
from tests.support.measured_folder import TOML, bring_in, folder

ROUNDING = 1e-12
"""Absolute tolerance of coordinates of a few cm [m]."""


def with_mesh(lines: str) -> str:
    return TOML.replace("[grasp]", f"[mesh]\n{lines}\n[grasp]", 1)


def test_a_margin_surrounds_the_seen_points(tmp_path):
    """The grid is 6 x 4 mm; 5 mm around it make 16 x 14 mm, all in its plane, and each point keeps its place."""
    _, recording = bring_in(folder(tmp_path, toml=with_mesh("margin = 5e-3")))
    mesh = recording.declaration.mesh
    np.testing.assert_allclose(mesh.vertices.min(axis=0), [-5e-3, -5e-3, 5e-3], atol=ROUNDING)
    np.testing.assert_allclose(mesh.vertices.max(axis=0), [11e-3, 9e-3, 5e-3], atol=ROUNDING)
    assert sorted(mesh.track_id[mesh.track_id >= 0]) == list(range(12))
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    assert np.cross(b - a, c - a)[:, 2].sum() / 2 == pytest.approx(16e-3 * 14e-3, rel=1e-6)  # no hole, no overlap


def test_an_outline_in_the_world_bounds_the_sheet(tmp_path):
    """A triangle around the grid; the truth may name vertices that are not seen."""
    lines = "outline = [[-4e-3, -3e-3], [20e-3, -3e-3], [-4e-3, 20e-3]]\nspacing = 1.5e-3"
    toml = with_mesh(lines).replace(
        "attached_rows = [11, 12]\nattached_rows_first = 1",
        "attached_at = [20e-3, -3e-3, 5e-3]\nattached_within = 2e-3",
    )
    summary, recording = bring_in(folder(tmp_path, toml=toml))
    x, y, z = recording.declaration.mesh.vertices.T
    assert x.max() == pytest.approx(20e-3) and y.max() == pytest.approx(20e-3) and np.ptp(z) < ROUNDING
    assert ((x + 4e-3) / 24e-3 + (y + 3e-3) / 23e-3 <= 1 + 1e-9).all()
    assert summary.n_attached in range(1, 7)


@pytest.mark.parametrize(
    ("lines", "error", "message"),
    [
        ("margin = 5e-3\noutline = [[0, 0], [1, 0], [0, 1]]", RecordingError, "both margin and outline"),
        ("outline = [[0, 0], [1, 0]]", RecordingError, "outline must be a list of 3 to"),
        ("outline = [[0, 0], [1, 0], [0, 1, 2]]", RecordingError, r"all \[x, y\] or all \[x, y, z\]"),
        ("spacing = 1e-3", RecordingError, "give margin or outline as well"),
        ("margin = 1e308", RecordingError, "above 0 and up to 10; got 1e\\+308"),
        ("outline = [[0, 0], [1e308, 0], [0, 1]]", RecordingError, "within 1e\\+06 m of the origin"),
        ("margin = 5e-3\nspacing = 1e-6", MeshError, "at most 20000 are allowed: give a larger spacing"),
        ("margin = -1", RecordingError, "margin must be a number above 0"),
        (
            "outline = [[-4e-3, -3e-3], [10e-3, 9e-3], [10e-3, -3e-3], [-4e-3, 9e-3]]",
            RecordingError,
            r"crosses itself: edges from corners 0 and 2 \(from 0\) intersect; give the corners in turn",
        ),
        (
            "outline = [[-9e-3, -3e-3], [1e-3, -3e-3], [1e-3, 9e-3], [-9e-3, 9e-3]]",
            RecordingError,
            r"outline leaves out 6 of 12 points; it must surround what is seen",
        ),
    ],
)
def test_what_is_wrong_with_a_margin_is_named(tmp_path, lines, error, message):
    with pytest.raises(error, match=message):
        bring_in(folder(tmp_path, toml=with_mesh(lines)))


def test_an_outline_through_the_outermost_points_surrounds_them(tmp_path):
    """The grid is 6 x 4 mm, with points on three sides of the outline; the fourth is 4 mm further."""
    lines = "outline = [[0, 0], [10e-3, 0], [10e-3, 4e-3], [0, 4e-3]]"
    _, recording = bring_in(folder(tmp_path, toml=with_mesh(lines)))
    np.testing.assert_allclose(recording.declaration.mesh.vertices.max(axis=0), [10e-3, 4e-3, 5e-3], atol=ROUNDING)
