"""The measured data that docs/RECORDINGS.md describes, where a machine has them."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jiggle_mj.importing.folder import import_folder
from jiggle_mj.recording.reader import Recording
from jiggle_mj.recording.truth import read_truth

CHECKOUT = Path(__file__).parents[3]
DOCUMENTED = CHECKOUT / "docs" / "recordings"
MEASURED = os.environ.get("JIGGLE_MJ_MEASURED")
MILLIMETRE = 1e-3
"""Absolute tolerance of lengths that the documents give in whole millimetres [m]."""
FORCE_ROUNDING = 5e-4
"""Absolute tolerance of a force that a document gives in whole millinewtons [N]."""
PATH_ROUNDING = 1e-9
"""Absolute tolerance of a point of a given path of 19 mm [m]: its direction is given with three digits."""


def measured(name: str) -> Path:
    if MEASURED is None:
        pytest.skip("measured data is not part of the project; JIGGLE_MJ_MEASURED names the folder that holds it")
    return Path(MEASURED) / name


def test_the_documented_chicken_skin_is_imported(tmp_path):
    """240 nodes of about 44 x 37 mm; the grasped corner moves most; 30 declared fixed nodes, none of them grasped."""
    summary = import_folder(measured("chicken_skin"), DOCUMENTED / "chicken_skin.toml", tmp_path / "run.mcap")
    recording = Recording.open(summary.recording)
    seen = list(recording)
    assert (summary.n_frames, summary.n_points, summary.n_unseen, summary.n_attached) == (4, 240, 2, 30)
    rest = seen[0].points.positions
    assert np.allclose(np.ptp(rest, axis=0)[:2], [0.044, 0.037], atol=MILLIMETRE)
    held = list(seen[0].tool.held_tracks)
    assert held == [26, 40, 41, 56]
    truth = read_truth(summary.truth)
    for observation in seen[1:]:
        displacement = np.linalg.norm(observation.points.positions - rest, axis=1)
        assert np.median(displacement[held]) > 2 * np.nanmedian(displacement)
    assert len(truth.rest) == 240 and not truth.attached[held].any()
    assert recording.declaration.gravity == (0, 0, 0) and not recording.declaration.bed


def test_the_documented_rubber_strip_reaches_both_grips(tmp_path):
    """The mesh reaches from -70 to 20 mm, the view from -43 to 5.5 mm; displacement there extrapolates to the pull.

    A line through displacement over station reaches 0 at the declared hold and the full 19 mm at the declared grip,
    to 1 mm: the strip stretches nearly uniformly.
    """
    summary = import_folder(measured("rubber_strip"), DOCUMENTED / "rubber_strip.toml", tmp_path / "run.mcap")
    recording = Recording.open(summary.recording)
    mesh, seen = recording.declaration.mesh, list(recording)
    assert (summary.n_frames, summary.n_points, summary.n_unseen) == (20, 435, 2)
    assert np.isclose(mesh.vertices[:, 0].min(), -0.070, atol=MILLIMETRE)
    assert np.isclose(mesh.vertices[:, 0].max(), 0.020, atol=MILLIMETRE)
    assert sorted(mesh.track_id[mesh.track_id >= 0]) == list(range(435))
    assert (mesh.track_id[mesh.held] == -1).all() and mesh.held.sum() >= 5
    axis = np.array([0.968, -0.031, 0.249]) / np.linalg.norm([0.968, -0.031, 0.249])
    np.testing.assert_allclose(seen[19].tool.position - seen[0].tool.position, 0.019 * axis, atol=PATH_ROUNDING)
    rest, last = seen[0].points.positions, seen[19].points.positions
    gradient, offset = np.polyfit(rest[:, 0], (last - rest) @ axis, 1)
    assert -offset / gradient == pytest.approx(-0.054, abs=MILLIMETRE)
    assert (0.019 - offset) / gradient == pytest.approx(0.016, abs=MILLIMETRE)
    truth = read_truth(summary.truth)
    assert truth.rest[truth.attached, 0].max() < -0.053 and not (truth.attached & mesh.held).any()


@pytest.mark.parametrize(
    ("name", "n_frames", "n_points", "held", "n_attached"),
    [
        ("skin_1013", 22, 240, [26, 40, 41, 56], 30),
        ("skin_1014", 19, 239, None, 28),
        ("lift_4", 23, 354, [90, 91, 112, 113], 64),
    ],
)
def test_descriptions_that_init_began_are_imported(tmp_path, name, n_frames, n_points, held, n_attached):
    summary = import_folder(measured(name), DOCUMENTED / f"{name}.toml", tmp_path / "run.mcap")
    assert (summary.n_frames, summary.n_points, summary.n_attached) == (n_frames, n_points, n_attached)
    first = next(iter(Recording.open(summary.recording)))
    assert held is None or list(first.tool.held_tracks) == held


def test_the_human_skin_has_the_force_of_each_frame(tmp_path):
    """The pad pulls towards -x, at first with nothing; at 3.82 mm the force is 73 mN, and acts against it."""
    folder = tmp_path / "human_skin"
    shutil.copytree(measured("human_skin"), folder)
    subprocess.run([sys.executable, CHECKOUT / "tools" / "force_of_frames.py", folder], check=True)
    summary = import_folder(folder, DOCUMENTED / "human_skin.toml", tmp_path / "run.mcap")
    assert (summary.n_frames, summary.n_points, summary.n_attached) == (50, 537, 34)
    seen = list(Recording.open(summary.recording))
    forces = np.array([one.force.on_tool for one in seen])
    assert not seen[0].tool.held_tracks and not forces[0].any() and not forces[:, 1:].any()
    assert forces[-1, 0] == pytest.approx(0.073, abs=FORCE_ROUNDING) and (np.diff(forces[:, 0]) > 0).all()
