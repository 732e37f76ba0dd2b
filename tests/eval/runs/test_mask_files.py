"""Masks from files, and the refusal of a colour mask in doubt."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from jiggle_mj.errors import MaskError, OptionError, PerceptionError
from jiggle_mj.estimator import Estimator
from jiggle_mj.estimator.perception import FrameMask, GrabCut, StereoTracker
from jiggle_mj.eval.runs.mask_files import SHOWN, mask_named, mask_shown
from jiggle_mj.observation import Declaration, Observation, StereoPair
from tests.support.perception_plane import HEIGHT, WIDTH, PlaneSheet, camera, stereo
from tests.support.recordings import tool

WOOD, SHEET = (150, 95, 60), (235, 232, 228)
"""Colours of a table and of a pale sheet, RGB."""
MIN_OVERLAP = 0.95
"""Least intersection over union of GrabCut with a rectangle: its border of one pixel is 4 % of the rectangle."""


def table_with_a_sheet(*, at_border: bool = False):
    """Return a picture of wood with a pale sheet, and the pixels of the sheet."""
    noise = np.random.default_rng(0).normal(scale=3, size=(HEIGHT, WIDTH, 3))
    sheet = np.zeros((HEIGHT, WIDTH), bool)
    sheet[90 - 90 * at_border : 210, 130:270] = True
    picture = np.where(sheet[..., None], SHEET, WOOD) + noise
    return picture.clip(0, 255).astype(np.uint8), sheet


@pytest.mark.parametrize("at_border", [False, True])
def test_a_table_is_not_taken_for_the_sheet(tmp_path, at_border):
    picture, sheet = table_with_a_sheet(at_border=at_border)
    with pytest.raises(PerceptionError, match="Is it the table") as refused, mask_shown(tmp_path / "out"):
        StereoTracker(camera()).start(StereoPair(left=picture, right=picture), tool())
    shown = cv2.imread(str(tmp_path / "out" / SHOWN), cv2.IMREAD_GRAYSCALE)
    assert shown is not None
    assert SHOWN in str(refused.value)
    assert (shown > 0)[:5, :5].all()
    assert not (shown > 0)[150, 200]
    found = GrabCut()(picture)
    if not at_border:  # GrabCut's rectangle leaves the border out
        assert (found & sheet).sum() / (found | sheet).sum() > MIN_OVERLAP


def test_a_red_sheet_on_a_bed_is_not_doubted():
    assert len(StereoTracker(camera()).start(stereo(PlaneSheet()), tool()).rest) > 0


def test_grey_images_need_a_mask(tmp_path):
    pair = stereo(PlaneSheet())
    left, right = (np.repeat(side[..., :1], 3, axis=2) for side in (pair.left, pair.right))
    grey = StereoPair(left=left, right=right)
    with pytest.raises(MaskError, match="images are grey"):
        StereoTracker(camera()).start(grey, tool())
    inside = np.zeros((HEIGHT, WIDTH), np.uint8)
    inside[65:235, 115:285] = 255
    cv2.imwrite(str(tmp_path / "mask.png"), inside)
    np.save(tmp_path / "mask.npy", inside > 0)
    np.savez(tmp_path / "mask.npz", left=inside[None] > 0, right=inside[None] > 0)
    (tmp_path / "all").mkdir()
    for side in ("left", "right"):
        cv2.imwrite(str(tmp_path / "all" / f"{side}_000000.png"), inside)
    for name, right in (("mask.png", 255), ("mask.npy", 255), ("mask.npz", inside), ("all", inside)):
        mask = mask_named(str(tmp_path / name))
        assert isinstance(mask, FrameMask)
        np.testing.assert_array_equal(mask.at(0, "left", rest=True), inside > 0)
        np.testing.assert_array_equal(mask.at(0, "right", rest=True), np.broadcast_to(right, inside.shape) > 0)
    tracker = StereoTracker(camera(), mask=mask_named(str(tmp_path / "mask.npz")))
    assert len(tracker.start(grey, tool()).rest) > 0


def test_the_estimator_takes_the_mask_of_a_file(tmp_path):
    pair = stereo(PlaneSheet())
    grey = StereoPair(left=np.repeat(pair.left[..., :1], 3, axis=2), right=np.repeat(pair.right[..., :1], 3, axis=2))
    inside = np.zeros((HEIGHT, WIDTH), np.uint8)
    inside[65:235, 115:285] = 255
    cv2.imwrite(str(tmp_path / "mask.png"), inside)
    estimator = Estimator(Declaration(), camera(), mask=mask_named(str(tmp_path / "mask.png")))
    still = replace(tool(), closed=False)
    assert estimator.update(Observation(index=0, time=0, tool=still, images=grey)) is None
    assert estimator.skipped == []


def test_a_mask_that_cannot_be_used_is_refused_by_name(tmp_path):
    (tmp_path / "text.png").write_text("no image")
    np.savez(tmp_path / "one.npz", left=np.zeros((1, 2, 2), bool))
    np.save(tmp_path / "line.npy", np.zeros(3))
    (tmp_path / "empty").mkdir()
    np.savez(tmp_path / "cut.npz", left=np.zeros((9, 9, 9), bool))
    (tmp_path / "cut.npz").write_bytes((tmp_path / "cut.npz").read_bytes()[:200])
    (tmp_path / "text.npy").write_text("no array")
    for name, why in (
        ("cut.npz", "is not an npz of arrays"),
        ("text.npy", "cannot be read"),
        ("none.png", "no such file"),
        ("text.png", "is no image"),
        ("one.npz", "lacks the array 'right'"),
        ("line.npy", "must be \\(height, width\\)"),
        ("empty", "left_000000.png"),
    ):
        with pytest.raises(OptionError, match=why):
            mask_named(str(tmp_path / name))
    cv2.imwrite(str(tmp_path / "small.png"), np.full((10, 10), 255, np.uint8))
    with pytest.raises(PerceptionError, match="10x10 px and the image"):
        StereoTracker(camera(), mask=mask_named(str(tmp_path / "small.png"))).start(stereo(PlaneSheet()), tool())


def test_a_spacing_that_would_give_too_many_particles_is_refused():
    """A sheet of 5 cm at 0.1 mm has about 290 000 particles."""
    with pytest.raises(PerceptionError, match="at most 20000 can be estimated"):
        StereoTracker(camera(), spacing=1e-4).start(stereo(PlaneSheet()), tool())
