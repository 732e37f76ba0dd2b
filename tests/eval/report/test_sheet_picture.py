"""The picture of a closed loop: what it shows where, its size, and what it refuses."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from jiggle_mj.errors import OutputError, RecordingError
from jiggle_mj.eval.report.discrepancy_page import BEFORE, TRIVIAL
from jiggle_mj.eval.report.sheet_picture import (
    GAP,
    LEFT,
    PANELS,
    RIGHT,
    SHEET_ROW,
    TOP,
    WIDTH,
    write_sheet_picture,
)

REST = np.stack([*np.meshgrid(np.arange(20) * 2e-3, np.arange(18) * 2e-3), np.zeros((18, 20))], axis=-1).reshape(-1, 3)
SAME, OTHER = 2.0, 8.0
"""Mean differences of pixels that a lossy picture makes of the same panel, and that another panel exceeds."""


def result(*, before: float, error: float | None = 2e-3) -> dict[str, Any]:
    """Return what the picture needs of a result: a bulge of 10 mm that is predicted to be of `before` mm."""
    bulge = np.exp(-np.sum((REST[:, :2] - 0.02) ** 2, axis=1) / 1e-4)[:, None] * np.array([1e-3, 0, 1e-3])
    positions = {f"{name}_m": (REST + 10 * bulge).tolist() for name in PANELS}
    positions |= {"before_m": (REST + before * bulge).tolist()}
    frame = {f"{name}_rms_m": 1e-3 for name in (*TRIVIAL, "after", "with_remainder")} | {"before_rms_m": error}
    fits = {
        "frames": [{"time_s": 1.0, "rms_m": error}, {"time_s": 2.0, "rms_m": error}, {"time_s": 2.5, "rms_m": 1e-17}]
    }
    return {
        "verdict": "effect",
        "effects": [{}],
        "noise": {"sd_m": 1e-4},
        "localisation": fits | {"particles": {"rest_m": REST.tolist()}},
        "localisation_after": {"frames": [{"time_s": 1.0, "rms_m": 1e-4}]},
        "held_out": {
            "frames": [{"time_s": 3.0, **frame}, {"time_s": 4.0, **frame}],
            "shown": [{"index": 9, "time_s": 3.0, **positions}],
        },
    }


def drawn(folder: Path, found: dict[str, Any]) -> np.ndarray:
    """Return the picture of a result."""
    (folder / "discrepancy.json").write_text(json.dumps(found))
    write_sheet_picture(folder, folder / "a.webp", title="a sheet")
    return cv2.imread(str(folder / "a.webp")).astype(float)


def panel(picture: np.ndarray, column: int, *, of: int = len(PANELS)) -> np.ndarray:
    """Return the sheet in one column at an eighth of its size, without the words above it."""
    width = (WIDTH - LEFT - RIGHT - GAP * (of - 1)) // of
    left = LEFT + column * (width + GAP)
    sheet = picture[TOP + 36 : TOP + SHEET_ROW, left : left + width]
    return cv2.resize(sheet, None, fx=1 / 8, fy=1 / 8, interpolation=cv2.INTER_AREA)


def test_a_prediction_looks_like_what_is_observed_where_it_is_right(tmp_path):
    right, wrong = (drawn(tmp_path, result(before=bulge)) for bulge in (10.0, 2.0))
    assert np.abs(panel(right, 0) - panel(right, 1)).mean() < SAME
    assert np.abs(panel(wrong, 0) - panel(wrong, 1)).mean() > OTHER
    assert np.abs(panel(wrong, 0) - panel(wrong, 2)).mean() < SAME


def test_where_nothing_is_named_there_is_no_prediction_with_it(tmp_path):
    """The third panel is then that of the remainder, which is right here, and wider."""
    found = result(before=2.0)
    found["held_out"]["shown"][0]["after_m"] = found["held_out"]["shown"][0]["before_m"]
    named, nothing = (drawn(tmp_path, found | {"effects": effects}) for effects in ([{}], []))
    assert np.abs(panel(named, 1) - panel(named, 2)).mean() < SAME
    assert np.abs(panel(nothing, 1, of=3) - panel(nothing, 2, of=3)).mean() > OTHER
    assert np.abs(panel(nothing, 0, of=3) - panel(nothing, 2, of=3)).mean() < SAME


def test_each_error_is_drawn_over_time_where_it_is_known(tmp_path):
    """The colour of the errors before, in the legend and the plot, and in the legend alone."""
    red, green, blue = bytes.fromhex(BEFORE[1:])

    def pixels(error: float | None) -> int:
        below = drawn(tmp_path, result(before=2.0, error=error))[TOP + SHEET_ROW :]
        return int(np.sum(np.abs(below - [blue, green, red]).max(axis=2) < 40))

    assert pixels(2e-3) > 4 * pixels(None) > 0


def test_the_same_result_gives_the_same_small_file(tmp_path):
    first = drawn(tmp_path, result(before=2.0)).shape, (tmp_path / "a.webp").read_bytes()
    assert (drawn(tmp_path, result(before=2.0)).shape, (tmp_path / "a.webp").read_bytes()) == first
    assert len(first[1]) < 120_000


def test_a_folder_without_a_reported_part_is_refused(tmp_path):
    with pytest.raises(RecordingError, match="give a folder that close-loop wrote"):
        write_sheet_picture(tmp_path, tmp_path / "a.webp", title="")
    with pytest.raises(RecordingError, match="reports no part"):
        drawn(tmp_path, {"held_out": {"shown": []}})
    (tmp_path / "discrepancy.json").write_text(json.dumps(result(before=2.0)))
    with pytest.raises(OutputError, match="cannot be written"):
        write_sheet_picture(tmp_path, tmp_path / "missing" / "a.webp", title="")
