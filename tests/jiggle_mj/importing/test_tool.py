"""The tool of measured data: at the grasped points, on a given path, or from its reports."""

from pathlib import Path

import numpy as np
import pytest

from jiggle_mj.errors import RecordingError
from tests.support.measured_folder import TOML, bring_in, folder, grid


def test_a_given_path_counts_its_steps_from_the_rest_frame_wherever_that_is(tmp_path):
    path = "start = [0.0, 0.0, 0.0]\ndirection = [0.0, 0.0, 1.0]\nstep = 1e-3"
    toml = TOML.replace("rows = [0, 1]", path, 1).replace('"]\n[grasp]', '"]\nrest = 1\n[grasp]')
    _, recording = bring_in(folder(tmp_path, toml=toml))
    assert [round(1e3 * frame.tool.position[2]) for frame in recording] == [0, -1, 1]
    assert [frame.points.positions[0, 2] for frame in recording] == pytest.approx([8e-3, 5e-3, 9e-3])


def test_a_grasped_point_unseen_at_rest_leaves_the_tool_to_the_others(tmp_path):
    rest = grid()
    rest[0] = np.nan
    summary, recording = bring_in(folder(tmp_path, frames=[rest, grid(), grid() + 1]))
    np.testing.assert_allclose([frame.tool.position for frame in recording], 1e-3 * (grid()[1] + [[0], [0], [1]]))
    assert not summary.skipped


def test_a_rest_frame_without_any_grasped_point_is_refused(tmp_path):
    rest = grid()
    rest[:2] = np.nan
    with pytest.raises(RecordingError, match=r"rest\.xyz shows none of the 2 grasped points.*another rest"):
        bring_in(folder(tmp_path, frames=[rest, grid(), grid() + 1]))


INTERPOLATION = 1e-12
"""Absolute tolerance of interpolated positions of a few cm [m]: roundings of times and positions."""
SLERP_ERROR = 1e-9
"""Absolute tolerance of interpolated angles [rad]: roundings of products of quaternions."""

REPORTED = """
name = "runs"
unit = "mm"
noise_sd = 1e-4
[points]
files = ["d.npz"]
key = "p"
times = "t"
runs = "r"
[frame]
rotation = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
[grasp]
rows = [0, 1]
tool = "tip"
tool_times = "at"
tool_turns = "turn"
after = 0.5
[truth]
attached_rows = []
"""


def reported_folder(tmp_path: Path, *, toml: str = REPORTED, **arrays) -> Path:
    """Two runs of three frames at 2 Hz; points and tool move along x at 10 mm/s, it turns about z at 0.1 rad/s."""
    where = tmp_path / "data"
    where.mkdir()
    at = np.arange(0, 4.01, 0.2)
    quaternions = np.column_stack([np.cos(0.05 * at), 0 * at, 0 * at, np.sin(0.05 * at)])
    seconds = np.array([0.0, 0.5, 1.0, 2.0, 2.5, 3.0])
    given = {
        "p": grid() + 10 * seconds[:, np.newaxis, np.newaxis] * [1, 0, 0],
        "t": 7.0 + seconds,
        "r": np.array([1, 1, 1, 2, 2, 2]),
        "tip": np.column_stack([10 * at, 0 * at, 0 * at]),
        "at": 7.0 + at,
        "turn": quaternions,
    }
    np.savez(where / "d.npz", **(given | arrays))
    (where / "recording.toml").write_text(toml)
    return where


def test_runs_with_a_tool_that_reported_become_grasps(tmp_path):
    """The world is rotated by 90 degrees about z: motion along x of the data is motion along y."""
    summary, recording = bring_in(reported_folder(tmp_path))
    seen = list(recording)
    assert summary.n_attached == 0
    assert [round(each.time / 1e9, 6) for each in seen] == [0, 0.5, 1, 2, 2.5, 3]
    assert [each.tool.closed for each in seen] == [False, True, True, False, True, True]
    assert [each.tool.grasp for each in seen] == [0, 1, 1, 1, 2, 2]
    for each in seen:
        time = each.time / 1e9
        np.testing.assert_allclose(each.tool.position, [0, 0.01 * time, 0], atol=INTERPOLATION)
        angle = 2 * np.arctan2(each.tool.quat_wxyz[3], each.tool.quat_wxyz[0])
        assert angle == pytest.approx(np.pi / 2 + 0.1 * time, abs=SLERP_ERROR)
        assert not each.tool.by_points
    times = [round(report.time / 1e9, 6) for report in seen[3].reports]
    assert times == [1.2, 1.4, 1.6, 1.8]
    np.testing.assert_allclose(seen[3].reports[0].position, [0, 0.012, 0], atol=INTERPOLATION)


@pytest.mark.parametrize(
    ("changed", "arrays", "message"),
    [
        (("after = 0.5", 'after = "soon"'), {}, "after must be a number"),
        (('times = "t"\nruns', "runs"), {}, "runs needs times"),
        (('times = "t"\nruns = "r"', ""), {}, "lacks the key 'period'"),
        (('times = "t"\nruns = "r"', "rest = 1"), {}, "lacks the key 'period'"),
        (('runs = "r"', "rest = 1"), {}, "rest must be 0 where frames have times; got 1"),
        (('times = "t"', 'times = "u"'), {}, "has no array 'u'"),
        (("", ""), {"t": np.zeros(6)}, "times must increase"),
        (("", ""), {"r": np.zeros(5)}, "one entry for each of the 6 frames"),
        (("", ""), {"at": np.zeros(21)}, r"at \(reports,\) must increase; entry 1 is 0.0 after 0.0"),
        (("", ""), {"turn": np.ones((21, 3))}, r"turn must have shape \(21, 4\), w first"),
    ],
)
def test_what_is_wrong_with_runs_and_reports_is_named(tmp_path, changed, arrays, message):
    where = reported_folder(tmp_path, toml=REPORTED.replace(*changed) if changed[0] else REPORTED, **arrays)
    with pytest.raises(RecordingError, match=message):
        bring_in(where)


@pytest.mark.parametrize(("per_second", "stated", "right"), [(1e3, "s", "ms"), (1e6, "ms", "us"), (1.0, "ms", "s")])
def test_the_unit_in_which_the_reports_last_as_long_as_the_frames_is_named(tmp_path, per_second, stated, right):
    """4 s of reports for 3 s of frames; in a unit that is too large their times cover those of the frames."""
    toml = REPORTED.replace("after = 0.5", f'after = 0.5\ntool_time_unit = "{stated}"')
    at = per_second * np.arange(0, 4.01, 0.2)
    with pytest.raises(RecordingError, match=f'give tool_time_unit = "{right}"'):
        bring_in(reported_folder(tmp_path, toml=toml, t=np.array([0.0, 0.5, 1.0, 2.0, 2.5, 3.0]), at=at))


def test_a_long_log_of_another_clock_has_no_other_unit(tmp_path):
    """50 reports a second over half an hour would be 50 000 a second in milliseconds: the clocks differ."""
    at = 1e6 + np.arange(0, 1800, 0.02)
    tip, turn = np.zeros((len(at), 3)), np.tile([1.0, 0, 0, 0], (len(at), 1))
    with pytest.raises(RecordingError, match="tool_clock_offset, what is added"):
        bring_in(reported_folder(tmp_path, at=at, tip=tip, turn=turn))


def test_a_clock_offset_that_is_no_number_is_refused_as_such(tmp_path):
    """NaN differs from itself, and so from that of another grasp too."""
    one = REPORTED.replace("[grasp]", "[[grasp]]\nrun = 1").replace("after = 0.5", "tool_clock_offset = nan")
    grasp = one[one.index("[[grasp]]") : one.index("[truth]")]
    toml = one.replace("[truth]", grasp.replace("run = 1", "run = 2") + "[truth]")
    with pytest.raises(RecordingError, match=r"tool_clock_offset must be a number.*got nan"):
        bring_in(reported_folder(tmp_path, toml=toml))


def test_reports_that_end_too_early_have_no_other_clock(tmp_path):
    """Those of the first second of three: an offset of 0 would be no cure."""
    at = 7.0 + np.arange(0, 1.01, 0.2)
    arrays = {"at": at, "tip": np.zeros((len(at), 3)), "turn": np.tile([1.0, 0, 0, 0], (len(at), 1))}
    with pytest.raises(RecordingError, match=r"end after 1 s, the frames after 3 s.*leave out the frames"):
        bring_in(reported_folder(tmp_path, **arrays))


def test_a_quaternion_of_zeros_is_named_with_its_report(tmp_path):
    turn = np.tile([1.0, 0, 0, 0], (21, 1))
    turn[3] = 0
    with pytest.raises(RecordingError, match=r"report 3 \(from 0\) is \[0\.0, 0\.0, 0\.0, 0\.0\]"):
        bring_in(reported_folder(tmp_path, turn=turn))
