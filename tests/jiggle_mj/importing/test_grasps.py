"""Grasps of measured data: which frames and points each has, and refusals where the points do not follow the tool."""

from pathlib import Path

import numpy as np
import pytest

from jiggle_mj.errors import RecordingError
from jiggle_mj.plausibility.problems import problems
from jiggle_mj.plausibility.survey import survey
from tests.support.measured_folder import bring_in

PULL = 30.0
"""Lift of a corner [mm]."""
TWO_PULLS = """
name = "two pulls"
unit = "mm"
noise_sd = 1e-4
[points]
files = ["d.npz"]
key = "p"
times = "t"
runs = "r"
[[grasp]]
run = 7
rows = [0, 1, 6, 7]
{first}
[[grasp]]
run = 9
{second}
"""
TOOL = 'tool = "tip"\ntool_times = "at"'


def sheet() -> np.ndarray:
    """Return a 6 x 6 sheet of 10 mm pitch [mm]."""
    x, y = np.meshgrid(10.0 * np.arange(6), 10.0 * np.arange(6))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(36)])


NEAR_FIRST, NEAR_LAST = [0, 1, 6, 7], [28, 29, 34, 35]
"""Rows of two opposite corners."""


def two_pulls(tmp_path: Path, toml: str, **arrays: np.ndarray) -> Path:
    """Return a folder of two runs of four frames; each lifts another corner by 10 mm a frame, and a tool reports."""
    where = tmp_path / "data"
    where.mkdir()
    points, tip = np.tile(sheet(), (8, 1, 1)), np.zeros((8, 3))
    for run, (rows, corner) in enumerate(((NEAR_FIRST, [5.0, 5.0]), (NEAR_LAST, [45.0, 45.0]))):
        for step in range(4):
            points[4 * run + step, rows, 2] += PULL / 3 * step
            tip[4 * run + step] = [*corner, PULL / 3 * step]
    given = {"p": points, "t": 0.5 * np.arange(8), "r": np.repeat([7, 9], 4), "tip": tip, "at": 0.5 * np.arange(8)}
    np.savez(where / "d.npz", **(given | arrays))
    (where / "recording.toml").write_text(toml)
    return where


@pytest.mark.parametrize("tool", ["", TOOL])
@pytest.mark.parametrize(
    "second",
    ["rows = [28, 29, 34, 35]", "at = [0.045, 0.045, 0.0]\nradius = 8e-3", 'rows = "near tool"\nradius = 8e-3'],
)
def test_each_run_has_its_own_held_points(tmp_path, tool, second):
    if "near tool" in second and not tool:
        pytest.skip("needs a tool")
    _, recording = bring_in(two_pulls(tmp_path, TWO_PULLS.format(first=tool, second=second)))
    seen = list(recording)
    assert [frame.tool.grasp for frame in seen] == [1] * 4 + [2] * 4
    assert [list(frame.tool.held_tracks) for frame in seen] == [NEAR_FIRST] * 4 + [NEAR_LAST] * 4
    np.testing.assert_allclose(seen[7].tool.position, [0.045, 0.045, 0.03], atol=1e-9)  # roundings of 30 mm


@pytest.mark.parametrize(("first", "second"), [("frames = [0, 3]", "frames = [5, 7]"), ("end = 2.0", "begin = 2.5")])
def test_frames_and_times_limit_grasps_and_the_jaws_are_open_between(tmp_path, first, second):
    toml = TWO_PULLS.replace("run = 7", first).replace("run = 9", second).replace('runs = "r"\n', "")
    _, recording = bring_in(two_pulls(tmp_path, toml.format(first=TOOL, second="rows = [28, 29, 34, 35]")))
    assert [frame.tool.closed for frame in recording] == [True] * 4 + [False] + [True] * 3
    assert [frame.tool.grasp for frame in recording] == [1] * 5 + [2] * 3


ONE_LIST = TWO_PULLS[: TWO_PULLS.index("[[grasp]]")] + "[grasp]\nrows = [{rows}]\n{tool}\n"


@pytest.mark.parametrize("tool", ["", TOOL])
@pytest.mark.parametrize("rows", ["0, 1, 6, 7", "0, 1, 6, 7, 28, 29, 34, 35"])
def test_one_list_for_pulls_at_two_corners_is_refused_with_the_cure(tmp_path, tool, rows):
    with pytest.raises(RecordingError, match=r"held points stand still while .* went 30 mm.*\[\[grasp\]\]"):
        bring_in(two_pulls(tmp_path, ONE_LIST.format(rows=rows, tool=tool)))


@pytest.mark.parametrize(
    ("tool", "second", "message"),
    [
        (TOOL, "rows = [28, 29]\nrun = 7", "TOML"),
        (TOOL, "rows = [28, 29]\ntool = 'other'", "tool differs from that of another grasp"),
        (TOOL, "", "needs one of rows, rows_file, at"),
        (TOOL, "at = [0.2, 0.2, 0.0]\nradius = 1e-3", r"holds nothing: .* the nearest is 212 mm away"),
        ("", 'rows = "near tool"\nradius = 8e-3', "needs tool"),
        (TOOL, 'rows = "near tool"', "needs radius"),
        (TOOL, "rows = [28, 29]\nafter = -1.0", "after must be a number from 0"),
        (TOOL, "rows = [28, 29]\nstep = 1e-3", "step is that of a straight pull"),
        (TOOL, "rows = [28, 29]\nafter = 5.0", "the jaws never close: after is 5 s"),
        (TOOL + '\ntool_unit = "m"', "rows = [28, 29]", 'the tool is 7.* m from the nearest.*tool_unit = "mm"'),
        (TOOL + "\ntool_clock_offset = 60", "rows = [28, 29]", 'do not overlap.*tool_clock_offset.*[(]0, or "start'),
        (TOOL + '\ntool_clock_offset = "soon"', "rows = [28, 29]", 'must be a number .*, or "start together"'),
    ],
)
def test_what_is_wrong_with_a_grasp_is_named(tmp_path, tool, second, message):
    with pytest.raises(RecordingError, match=message):
        bring_in(two_pulls(tmp_path, TWO_PULLS.format(first=tool, second=second)))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("run = 9", "run = 8", "number 2 covers no frame: .* runs 7, 9"),
        ("run = 9", "run = 7", "both cover d.npz frame 0"),
        ("run = 9", "", "needs run, begin and end, or frames: there are 2 grasps"),
        ("run = 9", "run = 9\nbegin = 1.0", "has several of run, begin and end, and frames"),
        ("noise_sd = 1e-4", "noise_sd = 0.1", "noise_sd is 0.1 m, and the sheet is 0.05 m large"),
        ("run = 9", "frames = [3, 1]", "frames must be two whole numbers"),
    ],
)
def test_grasps_that_cover_no_frame_or_the_same_and_large_noise_are_refused(tmp_path, old, new, message):
    toml = TWO_PULLS.format(first=TOOL, second="rows = [28, 29, 34, 35]").replace(old, new)
    with pytest.raises(RecordingError, match=message):
        bring_in(two_pulls(tmp_path, toml))


@pytest.mark.parametrize(("offset", "shift"), [("-2.5", 2.5), ('"start together"', 1e9)])
def test_a_second_clock_is_brought_to_that_of_the_frames(tmp_path, offset, shift):
    toml = TWO_PULLS.format(first=f"{TOOL}\ntool_clock_offset = {offset}", second="rows = [28, 29, 34, 35]")
    _, recording = bring_in(two_pulls(tmp_path, toml, at=shift + 0.5 * np.arange(8)))
    np.testing.assert_allclose([frame.tool.position[2] for frame in recording], [0, 0.01, 0.02, 0.03] * 2, atol=1e-9)


@pytest.mark.parametrize(
    ("per_metre", "cure"),
    [(1e3, 'tool_unit = "mm"'), (1e2, 'tool_unit = "cm"'), (1e6, 'tool_unit = "um"'),
     (1 / 0.0254, "convert its positions from inches to m"), (10, "convert its positions from decimetres to m")],
)  # fmt: skip
def test_the_unit_in_which_the_tool_stays_at_its_points_is_the_cure(tmp_path, per_metre, cure):
    """The first tip is 7 mm from the origin, so that every smaller unit puts it near its points as well."""
    where = two_pulls(tmp_path, TWO_PULLS.format(first=TOOL + '\ntool_unit = "m"', second="rows = [28, 29, 34, 35]"))
    with np.load(where / "d.npz") as arrays:
        np.savez(where / "d.npz", **(dict(arrays) | {"tip": 1e-3 * arrays["tip"] * per_metre}))
    with pytest.raises(RecordingError, match=cure):
        bring_in(where)


def test_jaws_that_close_on_no_seen_point_are_refused(tmp_path):
    where = two_pulls(tmp_path, TWO_PULLS.format(first="", second="at = [0.045, 0.045, 0.0]\nradius = 8e-3"))
    with np.load(where / "d.npz") as arrays:
        points = arrays["p"].copy()
        points[4] = np.nan
        np.savez(where / "d.npz", **(dict(arrays) | {"p": points}))
    with pytest.raises(RecordingError, match="frame 4, in which the jaws close, shows no point; choose another after"):
        bring_in(where)


def test_a_mirrored_tool_does_not_make_its_points_stand_still(tmp_path):
    """They follow the points that move most; that the tool goes down is for the survey to say."""
    where = two_pulls(tmp_path, TWO_PULLS.format(first=TOOL, second="rows = [28, 29, 34, 35]"))
    with np.load(where / "d.npz") as arrays:
        np.savez(where / "d.npz", **(dict(arrays) | {"tip": arrays["tip"] * [1, 1, -1]}))
    summary, recording = bring_in(where)
    assert summary.n_frames == 8
    assert "tool-axes" in {problem.name for problem in problems(survey(recording))}
