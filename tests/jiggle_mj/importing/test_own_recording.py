"""docs/OWN_RECORDING.md: the sample folder and the lines of Python give the attachments of the sample."""

import re
from pathlib import Path

import numpy as np

from jiggle_mj.importing.folder import import_folder
from jiggle_mj.recording.reader import Recording
from jiggle_mj.recording.truth import read_truth

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "OWN_RECORDING.md").read_text(encoding="utf-8")
ROUNDING = 1e-6
"""Absolute tolerance of positions that the archive holds to 1 um [m]."""


def test_the_lines_of_python_find_the_attachments_of_the_sample(tmp_path, monkeypatch, capsys):
    """At least 11 of 12 points are right, and at most one is wrong: one may be at the threshold of 0.5."""
    (program,) = re.findall(r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    monkeypatch.chdir(ROOT)
    names: dict = {}
    exec(compile(program, "example", "exec"), names)
    assert "points attached" in capsys.readouterr().out
    attached = np.loadtxt("docs/recordings/sample/attached.txt", dtype=int)
    found = names["estimator"].track_ids[names["attached"]]
    assert len(np.intersect1d(found, attached)) >= 11 and len(found) <= 13
    assert 1.5 < names["b"][names["attached"]].mean() < 6  # the sample's 3 N/m, within a factor of 2


def test_the_sample_folder_is_imported_as_the_arrays_are(tmp_path):
    summary = import_folder(ROOT / "docs" / "recordings" / "sample", None, tmp_path / "run.mcap")
    arrays, seen = (
        np.load(ROOT / "docs" / "recordings" / "sample" / "tracks.npz"),
        list(Recording.open(tmp_path / "run.mcap")),
    )
    assert (summary.n_frames, summary.n_points, summary.n_attached) == (24, 115, 12)
    assert [frame.tool.grasp for frame in seen] == arrays["run"].tolist()
    assert [frame.time for frame in seen] == (1_000_000 * arrays["time_ms"]).tolist()
    for frame, points, tip in zip(seen, arrays["tracks_mm"], arrays["tool_mm"], strict=True):
        np.testing.assert_allclose(frame.points.positions, 1e-3 * points, atol=ROUNDING)
        np.testing.assert_allclose(frame.tool.position, 1e-3 * tip, atol=ROUNDING)
    truth = read_truth(summary.truth)
    assert np.linalg.norm(truth.rest[truth.attached][:, :2], axis=1).max() < 0.0125  # a disc of 12 mm, and noise
