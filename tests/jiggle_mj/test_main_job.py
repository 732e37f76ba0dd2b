"""The main job: rendered stereo in, attachments out."""

import json
from pathlib import Path

import pytest

from jiggle_mj.eval.runs.experiment import run_scene
from jiggle_mj.eval.studies.main_table import MAIN, MainRow
from jiggle_mj.scenes import load_scene

MAX_TRACKING_RMS = 0.6e-3
"""Largest RMS distance of seen particles from their material points [m]."""
MIN_WITHIN_RING = 0.95
"""Least PCD and PUG within a ring of the mesh."""
MIN_EXACT = {"particles": 0.95, "stereo": 0.75}
"""Least PCD and PUG without a ring, by sensing: images are less precise than particles."""
NEES_RANGE = (0.4, 3.0)
"""Range of the NEES per degree of freedom of the attached particles, 1 for a calibrated belief."""


@pytest.mark.slow
@pytest.mark.render
@pytest.mark.parametrize("row", MAIN, ids=lambda row: f"{row.scene}-{row.sensing}")
def test_each_row_of_the_main_table_keeps_its_bars(row: MainRow, tmp_path: Path):
    """PCD and PUG within a ring of the mesh, tracking RMS, and no detection where nothing is attached.

    Scenes of b* = k / 30 also keep the bars without a ring and for NEES. The pulls of the soft arc are too weak to show
    from particles, given their noise; its PUG is not tested there.
    """
    run_scene(load_scene(row.scene), tmp_path, sensing=row.sensing)
    figures = json.loads((tmp_path / "result.json").read_text())
    assert figures["tracking"]["rms_m"] <= MAX_TRACKING_RMS
    if row.scene == "free":
        assert figures["detection"]["n_detected"] == 0
        return
    exact, ring = (figures["detection"]["by_dilation"][rings] for rings in "01")
    assert ring["pcd"] >= MIN_WITHIN_RING
    if row != MainRow(scene="arc_soft", sensing="particles"):
        assert ring["pug"] >= MIN_WITHIN_RING
    if row.scene not in ("arc_soft", "arc_stiff", "arc_weld"):
        assert min(exact["pcd"], exact["pug"]) >= MIN_EXACT[row.sensing]
        low, high = NEES_RANGE
        assert low <= figures["calibration"]["nees_attached"] <= high
