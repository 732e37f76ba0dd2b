"""Lost points: by a rule, a visibility array or a format; marks that nobody declared are refused; displacements."""

import numpy as np
import pytest

from jiggle_mj.errors import RecordingError
from tests.support.measured_folder import ROUNDING, TOML, bring_in, folder, grid

FILES = 'files = ["rest.xyz", "pulled_*.xyz"]'
SHAPE = (3, 12)
"""Frames and points of the sheet."""


def sheet() -> np.ndarray:
    """Three frames of the grid, moved off whole numbers, with a corner that rises [mm]."""
    frames = np.stack([grid() + 0.125] * 3)
    frames[1:, :2, 2] += 3
    return frames


def lost() -> np.ndarray:
    """Points 5 and 7 are lost in frame 1, point 5 in frame 2."""
    mask = np.zeros(SHAPE, bool)
    mask[1, [5, 7]] = mask[2, 5] = True
    return mask


def read(where) -> np.ndarray:
    """Positions of all frames [mm]."""
    _, recording = bring_in(where)
    return np.stack([observation.points.positions for observation in recording]) * 1e3


def archive(tmp_path, keys: str, **arrays: np.ndarray):
    """A folder with the arrays in an .npz, where `p` is the sheet unless it is given."""
    where = folder(tmp_path, toml=TOML.replace(FILES, f'files = ["d.npz"]\n{keys}'))
    np.savez(where / "d.npz", **{"p": sheet(), **arrays})
    return where


def dic(tmp_path, heading: str, values: np.ndarray, keys: str):
    """A folder with text tables of those columns, one a frame."""
    where = folder(tmp_path, toml=TOML.replace(FILES, f"{FILES}\n{keys}"))
    for name, frame in zip(("rest", "pulled_1", "pulled_2"), values, strict=True):
        np.savetxt(where / f"{name}.xyz", frame, delimiter=",", header=heading, comments="", fmt="%.6f")
    return where


def same(found: np.ndarray, unseen: np.ndarray) -> None:
    np.testing.assert_array_equal(np.isnan(found).any(axis=2), unseen)
    np.testing.assert_allclose(found[~unseen], sheet()[~unseen], atol=1e3 * ROUNDING)


@pytest.mark.parametrize("mark", [(0, 0, 0), (0, 0, -1), (-1, -1, -1), (-9999, -9999, -9999), (7.25, 7.25, 7.25)])
def test_points_at_one_place_are_refused_until_a_rule_names_it(tmp_path, mark):
    values = np.where(lost()[:, :, None], np.array(mark, float), sheet())
    (tmp_path / "asked").mkdir()
    with pytest.raises(RecordingError, match=r"d\.npz frame 1 has 2 points at exactly .*rows 5, 7 .*give missing = \["):
        read(archive(tmp_path / "asked", 'key = "p"', p=values))
    same(read(archive(tmp_path, f'key = "p"\nmissing = {list(mark)}', p=values)), lost())


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (sheet() - sheet()[0], r"all 12 points of d\.npz frame 0 are at exactly \(0, 0, 0\): are these displacements"),
        (
            sheet() + np.array([5e5, 5e9, 0]),
            "more than 1e.09 from the origin, as coordinates of a map are: subtract one offset",
        ),
        ((sheet() + np.array([0, 5e7, 0])).astype(np.float32), "the coordinates are rounded .*subtract a large offset"),
    ],
)
def test_displacements_and_coordinates_of_a_map_are_named(tmp_path, values, message):
    with pytest.raises(RecordingError, match=message):
        read(archive(tmp_path, 'key = "p"', p=values))


def test_one_point_that_jumps_to_the_origin_is_refused(tmp_path):
    values = sheet()
    values[2, 4] = 0
    with pytest.raises(RecordingError, match=r"frame 2 has 1 point at exactly \(0, 0, 0\), rows 4 .*elsewhere"):
        read(archive(tmp_path, 'key = "p"', p=values))


def test_a_point_that_rests_at_the_origin_is_a_point(tmp_path):
    values = sheet() - sheet()[0, 0]
    found = read(archive(tmp_path, 'key = "p"', p=values))
    np.testing.assert_allclose(found, values, atol=1e3 * ROUNDING)


def test_a_coordinate_beyond_any_sheet_is_refused(tmp_path):
    values = sheet()
    values[1, 3] = 1e10
    with pytest.raises(RecordingError, match=r"rows 3 .*too far away"):
        read(archive(tmp_path, 'key = "p"', p=values))


@pytest.mark.parametrize(
    ("keys", "seen"),
    [
        ('visibility = "visibs"', ~lost()),
        ('visibility = "visibs"', (~lost()).T),
        ('visibility = "visibs"', (~lost())[None, :, :, None]),
        ('visibility = "visibs"', (~lost()).astype(np.uint8)),
        ('visibility = "visibs"', np.where(lost(), 0.4, 0.9)),
        ('visibility = "visibs"\nvisibility_threshold = 0.95', np.where(lost(), 0.9, 0.99)),
        ('visibility = "not visibs"', lost()),
        ('missing = "visibs < 0.5"', np.where(lost(), -3.0, 3.0)),
        ('missing = "z == -1"', np.ones(1)),
    ],
)
def test_visibility_says_which_points_are_seen(tmp_path, keys, seen):
    values = np.where(lost()[:, :, None], [0.0, 0.0, -1.0], sheet())
    same(read(archive(tmp_path, f'key = "p"\n{keys}', p=values, visibs=seen)), lost())


def test_a_visibility_that_nobody_names_is_refused(tmp_path):
    """Lost points stay where they were last seen: nothing else shows that they are lost."""
    with pytest.raises(RecordingError, match=r'array occluded \(3, 12\).* give visibility = "not occluded"'):
        read(archive(tmp_path, 'key = "p"', occluded=lost()))


PERCENT = np.where(lost(), 20.0, 95.0)


@pytest.mark.parametrize(
    ("name", "values", "cure"),
    [
        ("quality", np.where(lost(), 0.1, 0.9), 'visibility = "quality"'),
        ("quality", PERCENT, 'values from 20 to 95, .*missing = "quality < NUMBER"'),
        ("confidence", PERCENT.T, 'missing = "confidence < NUMBER"'),
        ("score", np.where(lost(), np.nan, 0.9), 'visibility = "score"'),
        ("bad", lost().astype(np.uint8), 'visibility = "not bad"'),
        ("is_outlier", lost().astype(float), 'visibility = "not is_outlier"'),
        ("missing_flag", lost(), 'visibility = "not missing_flag"'),
        ("not_occluded", ~lost(), 'visibility = "not_occluded"'),
        ("ptsVisible", ~lost(), 'visibility = "ptsVisible"'),
        ("occlusion_prob", np.where(lost(), 0.9, 0.1), 'visibility = "not occlusion_prob"'),
        ("outlierScore", 100 - PERCENT, 'missing = "outlierScore > NUMBER"'),
    ],
)
def test_a_rating_that_nobody_names_is_refused_and_its_cure_works(tmp_path, name, values, cure):
    (tmp_path / "asked").mkdir()
    with pytest.raises(RecordingError, match=cure):
        read(archive(tmp_path / "asked", 'key = "p"', **{name: values}))
    key = cure.rpartition("*")[2].replace("NUMBER", "50")
    same(read(archive(tmp_path, f'key = "p"\n{key}', **{name: values})), lost())


@pytest.mark.parametrize(
    ("heading", "values", "rule"),
    [
        ("visible", ~lost(), "visible < 0.5"),
        ("occluded", lost(), "occluded >= 0.5"),
        ("likelihood", np.where(lost(), 0.3, 1.0), "likelihood < 0.5"),
        ("quality", PERCENT, "quality < NUMBER"),
    ],
)
def test_a_column_that_rates_the_points_is_refused_and_its_cure_works(tmp_path, heading, values, rule):
    table = np.concatenate([sheet(), values[:, :, None]], axis=2)
    (tmp_path / "asked").mkdir()
    with pytest.raises(RecordingError, match=f"a column '{heading}'.* give missing = \"{rule}\""):
        read(dic(tmp_path / "asked", f"x,y,z,{heading}", table, ""))
    same(read(dic(tmp_path, f"x,y,z,{heading}", table, f'missing = "{rule.replace("NUMBER", "50")}"')), lost())


def test_a_rating_that_tells_nothing_new_needs_no_key(tmp_path):
    """Alike for all, or low where the points have no position anyway; one of another shape is named."""
    values = np.where(lost()[:, :, None], np.nan, sheet())
    where = archive(tmp_path, 'key = "p"', p=values, quality=np.full(SHAPE, 100.0), lost=lost(), score=np.zeros((3, 4)))
    same(read(where), lost())
    (where / "run.mcap").unlink()
    (where / "run.truth.mcap").unlink()
    assert bring_in(where)[0].notes == ("score (3, 4) has no value for each frame and point, and is not used",)


@pytest.mark.parametrize("name", ["problem", "division", "failure_load", "mask_area", "viscosity", "reconfigured"])
def test_an_array_whose_name_holds_such_a_word_by_chance_rates_nothing(tmp_path, name):
    where = archive(tmp_path, 'key = "p"', **{name: PERCENT})
    (note,) = bring_in(where)[0].notes
    assert note.startswith(f"{name} (3, 12): one value for each frame and point, not used")


def test_ratings_of_another_name_are_noted_and_the_cure_works(tmp_path):
    (tmp_path / "asked").mkdir()
    where = archive(
        tmp_path / "asked", 'key = "p"', zncc=np.where(lost(), 0.1, 0.9), sigma=PERCENT.T, same=np.ones(SHAPE)
    )
    (note,) = bring_in(where)[0].notes
    assert note.startswith("zncc (3, 12), sigma (12, 3): one value") and 'visibility = "zncc"' in note
    same(read(archive(tmp_path, 'key = "p"\nvisibility = "zncc"', zncc=np.where(lost(), 0.1, 0.9))), lost())


def test_large_ratings_of_lost_points_named_as_visibility_get_the_right_sign(tmp_path):
    with pytest.raises(RecordingError, match='give missing = "ARRAY > NUMBER"'):
        read(archive(tmp_path, 'key = "p"\nvisibility = "not occluded"', occluded=PERCENT))


def test_a_visibility_named_as_its_opposite_is_refused(tmp_path):
    with pytest.raises(RecordingError, match='give visibility = "not occluded"'):
        read(archive(tmp_path, 'key = "p"\nvisibility = "occluded"', occluded=lost()))


def test_a_visibility_of_which_all_is_seen_needs_no_key(tmp_path):
    same(
        read(archive(tmp_path, 'key = "p"', visible=np.ones(SHAPE, bool), conf=np.full(SHAPE, 0.9))),
        np.zeros(SHAPE, bool),
    )


@pytest.mark.parametrize(
    ("visibility", "message"),
    [
        (np.ones((3, 11)), r"has shape \(3, 11\); visibility needs one value for each of 3 frames and 12 points"),
        (np.full(SHAPE, 7.0), r"holds values from 7 to 7; visibility is true or false, or a probability"),
    ],
)
def test_a_wrong_visibility_is_refused(tmp_path, visibility, message):
    with pytest.raises(RecordingError, match=message):
        read(archive(tmp_path, 'key = "p"\nvisibility = "v"', v=visibility))


@pytest.mark.parametrize(
    ("layout", "axes"),
    [("points, frames", (1, 0, 2)), ("frames, xyz, points", (0, 2, 1)), ("xyz, points, frames", (2, 1, 0))],
)
def test_a_layout_orders_the_axes(tmp_path, layout, axes):
    values, visible = sheet().transpose(axes), np.ones(SHAPE).T
    where = archive(tmp_path, f'key = "p"\nlayout = "{layout}"', p=values, visibility=visible)
    same(read(where), np.zeros(SHAPE, bool))


def test_points_first_is_noticed_and_asked_for(tmp_path):
    with pytest.raises(RecordingError, match=r'give layout = "points, frames" \(3 frames of 12 points\)'):
        read(archive(tmp_path, 'key = "p"', p=sheet().transpose(1, 0, 2)))


def test_times_decide_the_layout(tmp_path):
    where = archive(tmp_path, 'key = "p"\ntimes = "t"', p=sheet().transpose(1, 0, 2), t=np.arange(3.0))
    (where / "recording.toml").write_text((where / "recording.toml").read_text().replace("period = 0.5", ""))
    with pytest.raises(RecordingError, match=r"times has 3 entries: its points come first"):
        read(where)


def test_times_do_not_decide_between_as_many_frames_as_points(tmp_path):
    values = np.concatenate([sheet(), np.repeat(sheet()[-1:], 9, axis=0)])  # 12 frames of 12 points
    where = archive(tmp_path, 'key = "p"\ntimes = "t"', p=values.transpose(1, 0, 2), t=np.arange(12.0))
    (where / "recording.toml").write_text((where / "recording.toml").read_text().replace("period = 0.5", ""))
    with pytest.raises(RecordingError, match="points probably come first"):
        read(where)


def test_a_batch_of_one_and_separate_arrays_are_read(tmp_path):
    (tmp_path / "batch").mkdir()
    same(read(archive(tmp_path / "batch", 'key = "p"', p=sheet()[None])), np.zeros(SHAPE, bool))
    x, y, z = np.moveaxis(sheet(), 2, 0)
    same(read(archive(tmp_path, 'key = ["x", "y", "z"]', x=x, y=y, z=z)), np.zeros(SHAPE, bool))


REFERENCE = np.stack([sheet()[0]] * 3)


def test_displacements_are_added_to_reference_positions(tmp_path):
    values = np.concatenate([REFERENCE, sheet() - REFERENCE], axis=2)
    keys = 'columns = ["X", "Y", "Z"]\n'
    (tmp_path / "asked").mkdir()
    with pytest.raises(RecordingError, match=r'nothing moves in 3 frames.*displacements = \["U", "V", "W"\]'):
        read(dic(tmp_path / "asked", "X,Y,Z,U,V,W", values, keys))
    same(read(dic(tmp_path, "X,Y,Z,U,V,W", values, f'{keys}displacements = ["U", "V", "W"]')), np.zeros(SHAPE, bool))


@pytest.mark.parametrize("heading", ["x,y,z,dx,dy,dz", "x,y,z,Displacement X [mm],Displacement Y [mm],Displacement Z"])
def test_displacements_are_noticed_by_other_headings(tmp_path, heading):
    values = np.concatenate([REFERENCE, sheet() - REFERENCE], axis=2)
    with pytest.raises(RecordingError, match=r"nothing moves in 3 frames.*displacements = \["):
        read(dic(tmp_path, heading, values, ""))


def test_comments_that_differ_are_no_headings(tmp_path):
    """Each frame begins with its time, in as many words as there are columns."""
    where = dic(tmp_path, "", sheet(), "")
    for number, name in enumerate(("rest", "pulled_1", "pulled_2")):
        np.savetxt(where / f"{name}.xyz", sheet()[number], header=f"frame at {number}s")
    same(read(where), np.zeros(SHAPE, bool))


def test_displacements_that_count_twice_are_refused(tmp_path):
    values = np.concatenate([sheet(), sheet() - REFERENCE], axis=2)
    with pytest.raises(RecordingError, match="would count twice"):
        read(dic(tmp_path, "X,Y,Z,U,V,W", values, 'columns = ["X", "Y", "Z"]\ndisplacements = ["U", "V", "W"]'))


def test_displacements_of_an_archive_are_added(tmp_path):
    where = archive(tmp_path, 'key = "p"\ndisplacements = "u"', p=REFERENCE, u=sheet() - REFERENCE)
    same(read(where), np.zeros(SHAPE, bool))


@pytest.mark.parametrize("moving", [False, True])
def test_a_format_adds_displacements_only_to_reference_positions(tmp_path, moving):
    """VIC-3D writes either; a lost point has sigma -1."""
    sigma = np.where(lost(), -1.0, 0.01)[:, :, None]
    values = np.concatenate([sheet() if moving else REFERENCE, sheet() - REFERENCE, sigma], axis=2)
    same(read(dic(tmp_path, '"X [mm]","Y [mm]","Z [mm]",U,V,W,sigma', values, 'format = "vic-3d"')), lost())


def test_the_headings_of_a_known_program_are_named(tmp_path):
    axes = "XYZ"
    heading = ",".join([f"MODEL_COORDINATES_{a}" for a in axes] + [f"MODEL_DISPLACEMENT_{a}" for a in axes] + ["SIGMA"])
    values = np.concatenate([REFERENCE, sheet() - REFERENCE, np.full((*SHAPE, 1), 0.01)], axis=2)
    (tmp_path / "asked").mkdir()
    with pytest.raises(RecordingError, match='headings of a DIC export: give format = "dice"'):
        read(dic(tmp_path / "asked", heading, values, ""))
    same(read(dic(tmp_path, heading, values, 'format = "dice"')), np.zeros(SHAPE, bool))
