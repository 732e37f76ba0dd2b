"""Points that are other points, or none, in some frames are found by name; noise, drift and unseen points are not."""

from collections.abc import Callable

import numpy as np
import pytest

from jiggle_mj.observation import IDENTITY_WXYZ, Declaration, MeasuredPoints, Observation, ToolState
from jiggle_mj.plausibility.problems import problems
from jiggle_mj.plausibility.survey import survey
from jiggle_mj.recording.reader import Recording
from jiggle_mj.recording.writer import RecordingWriter

SPACING, LIFT = 5e-3, 20e-3
"""Distance of the points at rest, and height of the lift [m]."""
SD = 2e-4
"""Noise of a coordinate [m]."""
REST = np.array([(SPACING * column, SPACING * row, 0.0) for row in range(10) for column in range(12)])
"""Points of the sheet at rest [m]."""
HELD = (0, 1, 12, 13)
N_STILL, N_CLOSED = 4, 10
HEIGHT = LIFT * np.maximum(np.arange(-N_STILL, N_CLOSED), 0) / (N_CLOSED - 1)
"""Height of the tool in each frame [m]."""
PLACE = np.array([21e-3, 18e-3, 1e-3])
"""A place inside the sheet, where no point is at rest [m]."""

Edit = Callable[[np.ndarray], np.ndarray]


def lifted(sd: float = SD) -> np.ndarray:
    """Return a lift of a corner, shape (frames, points, 3) [m]."""
    decay = np.exp(-np.linalg.norm(REST - REST[list(HELD)].mean(axis=0), axis=1) / 0.015)
    up = HEIGHT[:, None, None] * decay[:, None] * np.array([0, 0, 1.0])
    return REST + up + np.random.default_rng(3).normal(scale=sd, size=up.shape)


def found(
    tmp_path,
    positions: np.ndarray,
    *,
    tracks: list[np.ndarray] | None = None,
    sd: float = SD,
    radius: float | None = None,
    second: int = 10_000,
):
    """Return the survey and the names of what refuses and what is doubted, but that there is one grasp.

    A second grasp, if any, begins in the frame `second`, half way up.
    """
    tip = REST[list(HELD)].mean(axis=0)
    with RecordingWriter(
        tmp_path / "run.mcap", camera=None, declaration=Declaration(), metadata={}, overwrite=True
    ) as writer:
        for k, points in enumerate(positions):
            rows = np.arange(len(REST)) if tracks is None else tracks[k]
            closed, height = k >= N_STILL, HEIGHT[k if k < second else N_STILL + 4 + k - second]
            writer.write(
                Observation(
                    index=k,
                    time=k * 200_000_000,
                    tool=ToolState(
                        position=tip + height * np.array([0, 0, 1.0]),
                        quat_wxyz=IDENTITY_WXYZ,
                        closed=closed,
                        grasp=int(closed) + (k >= second),
                        radius=radius or 2e-3,
                        held_tracks=HELD if closed and radius is None else (),
                    ),
                    points=MeasuredPoints(positions=points[rows], track_id=rows, sd=sd),
                )
            )
    surveyed = survey(Recording.open(tmp_path / "run.mcap"))
    listed = [each for each in problems(surveyed) if each.name != "one-grasp"]
    return surveyed, {each.name for each in listed if each.refuses}, {each.name for each in listed if not each.refuses}


@pytest.mark.parametrize(
    ("radius", "refused", "doubted"), [(1.0, True, False), (0.04, False, True), (6e-3, False, False)]
)
def test_a_grip_as_large_as_the_sheet_is_named(tmp_path, radius, refused, doubted):
    """The sheet is 55 x 45 mm, and held at a corner."""
    _, refuses, doubts = found(tmp_path, lifted(), radius=radius)
    assert ("grip-share" in refuses, "grip-share" in doubts) == (refused, doubted)


def test_one_frame_is_refused(tmp_path):
    assert found(tmp_path, lifted()[:1])[1] == {"one-frame"}


def changed(edit: Callable[[np.ndarray], None]) -> np.ndarray:
    positions = lifted()
    edit(positions)
    return positions


def exchange(positions: np.ndarray) -> None:
    positions[8:, [70, 71]] = positions[8:, [71, 70]]


def lose_one_a_frame(positions: np.ndarray) -> None:
    for k in range(1, len(positions)):
        positions[k, 7 * k % len(REST)] = PLACE


def never_find(positions: np.ndarray) -> None:
    positions[:, 70] = -1.0


def lose_depths(positions: np.ndarray) -> None:
    positions += [0, 0, 0.15]
    for k in range(1, len(positions)):
        positions[k, 7 * k % len(REST), 2] = 0.0


def go_wild(positions: np.ndarray) -> None:
    rng = np.random.default_rng(5)
    wild = rng.random(positions.shape[:2]) < 0.03
    wild[:, list(HELD)] = wild[0] = False
    positions[wild] += rng.normal(scale=0.1, size=(int(wild.sum()), 3))


def repeat_the_last(positions: np.ndarray) -> None:
    """Half of the points near the held ones are lost half way up."""
    near = np.flatnonzero(np.linalg.norm(REST, axis=1) < 20e-3)
    positions[9:, near[::3]] = positions[8, near[::3]]


def shift_rows(positions: np.ndarray) -> None:
    positions[8:] = np.roll(positions[8:], 1, axis=1)


def in_order_of_x(positions: np.ndarray) -> None:
    for frame in positions:
        frame[:] = frame[np.argsort(frame[:, 0])]


def each_from_the_last(positions: np.ndarray) -> None:
    positions[1:] = positions[0] + np.diff(positions, axis=0)


@pytest.mark.parametrize(
    ("edit", "refused", "doubted"),
    [
        (exchange, set(), {"identities"}),
        (lose_one_a_frame, {"lost-mark"}, set()),
        (never_find, set(), {"isolated"}),
        (go_wild, set(), {"wild"}),
        (repeat_the_last, set(), {"repeated"}),
    ],
)
def test_a_point_that_is_another_or_none_is_named(tmp_path, edit, refused, doubted):
    assert found(tmp_path, changed(edit))[1:] == (refused, doubted)


@pytest.mark.parametrize(
    ("edit", "name"), [(in_order_of_x, "identities"), (shift_rows, "identities"), (lose_depths, "lost-mark")]
)
def test_points_of_which_most_are_wrong_are_refused(tmp_path, edit, name):
    assert name in found(tmp_path, changed(edit))[1]


def test_a_sheet_that_is_carried_from_0_has_no_lost_depth(tmp_path):
    """Also where single points are wild meanwhile."""
    positions = lifted(sd=0.0)
    positions[5:] += [0, 0, 0.2]
    positions[8, 3], positions[9, 50] = [0.3, 0.1, 0.0], [0.2, 0.3, 0.0]
    assert "lost-mark" not in found(tmp_path, np.delete(positions, 5, axis=0))[1]


def test_displacements_from_frame_to_frame_are_doubted_at_a_constant_speed(tmp_path):
    """A point that slips after one step looks the same."""
    _, refused, doubted = found(tmp_path, changed(each_from_the_last))
    assert ("increments" in refused, "increments" in doubted) == (False, True)


@pytest.mark.parametrize("rounded", [None, 5, 4])
def test_a_patch_that_the_jaws_carry_up_and_down_is_no_mark(tmp_path, rounded):
    """Nothing around it moves, and it goes by several spacings from frame to frame, again and again to one height."""
    rng, patch = np.random.default_rng(3), np.linalg.norm(REST - REST[65], axis=1) < 9e-3
    height = 25e-3 * (np.arange(-N_STILL, N_CLOSED) % 2) * (np.arange(-N_STILL, N_CLOSED) > 0)
    positions = REST + height[:, None, None] * patch[:, None] * np.array([0, 0, 1.0])
    positions += 0.0 if rounded is None else rng.normal(scale=1e-4, size=positions.shape)
    positions = positions if rounded is None else np.round(positions, rounded)
    names = {each.name for each in found(tmp_path, positions)[0].doubts}
    assert not names & {"lost-mark", "identities", "wild"}


@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_depths_that_are_lost_behind_the_tool_are_found(tmp_path, noise):
    """A disc of 8 mm goes over the sheet, and what it hides has depth 0: neighbours jump alike."""
    rng, across = np.random.default_rng(3), np.linspace(5e-3, 50e-3, N_STILL + N_CLOSED)
    positions = lifted(sd=0.0) + rng.normal(scale=noise, size=lifted().shape) + np.array([0, 0, 0.15])
    for frame, x in zip(positions[1:], across[1:], strict=True):
        frame[np.linalg.norm(REST[:, :2] - (x, 30e-3), axis=1) < 8e-3, 2] = 0.0
    assert "lost-mark" in found(tmp_path, positions)[1]


def test_an_exchange_is_counted(tmp_path):
    """Two of 120 points take each other's place in one step."""
    (text,) = [each.text for each in found(tmp_path, changed(exchange))[0].doubts]
    assert text.startswith("2 points take places of others, up to 2% of a frame's points, in 1 frames")


def unseen(positions: np.ndarray) -> None:
    positions[np.random.default_rng(5).random(positions.shape[:2]) < 0.4] = np.nan


def drift(positions: np.ndarray) -> None:
    rates = np.random.default_rng(5).normal(scale=2e-3, size=REST.shape)
    positions += np.linspace(0, 1, len(positions))[:, None, None] * rates


def move_by_a_spacing(positions: np.ndarray) -> None:
    positions += SPACING * np.arange(len(positions))[:, None, None] * np.array([1.0, 0, 0])


@pytest.mark.parametrize("edit", [unseen, drift, move_by_a_spacing])
def test_points_that_are_the_same_are_not_doubted(tmp_path, edit):
    """Also where every point comes to the very place of its neighbour, as all do."""
    doubted = {problem.name for problem in found(tmp_path, changed(edit))[0].doubts}
    assert not doubted & {"identities", "lost-mark", "isolated", "increments"}


def test_attached_points_without_noise_are_not_repeated(tmp_path):
    """As a simulation writes them: they never move, and those that the lift does not reach hardly do."""
    positions = np.round(lifted(sd=0.0), 6)
    positions[:, 2:4] = REST[2:4]
    assert "repeated" not in found(tmp_path, positions)[2]


def test_a_tracker_that_starts_anew_is_named(tmp_path):
    rows = np.arange(len(REST))
    tracks = [rows[:60] if k < 8 else rows[60:] for k in range(N_STILL + N_CLOSED)]
    assert "new-tracks" in found(tmp_path, lifted(), tracks=tracks)[2]


def test_noise_of_a_fifth_of_the_spacing_is_no_exchange(tmp_path):
    assert found(tmp_path, lifted(sd=1e-3), sd=1e-3)[1:] == (set(), set())


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_points_that_stay_after_some_steps_are_not_refused(tmp_path, steps):
    positions = lifted()
    positions[N_STILL + steps + 1 :] = positions[N_STILL + steps]
    assert "increments" not in found(tmp_path, positions)[1]


@pytest.mark.parametrize("share", [0.15, 0.2, 0.22, 0.25, 0.3])
def test_points_that_follow_by_a_share_are_not_refused(tmp_path, share):
    """Over ten frames the sum of a fifth of the tool's displacement comes near to it."""
    assert "increments" not in found(tmp_path, REST + share * (lifted(sd=0.0) - REST), sd=1e-5)[1]


def test_a_tool_that_hides_points_loses_none(tmp_path):
    """A disc of 15 mm goes over a sheet that is carried by 1 mm a frame; positions are rounded to 1 mm."""
    carried = 1e-3 * np.arange(N_STILL + N_CLOSED)[:, None, None] * np.array([1.0, 0, 0])
    positions = np.round(REST + carried, 3)
    hides = np.stack([5e-3 * np.arange(len(positions)), np.full(len(positions), 20e-3)], axis=1)
    positions[np.linalg.norm(REST[:, :2] - hides[:, None], axis=2) < 15e-3] = np.nan
    doubted = {problem.name for problem in found(tmp_path, positions)[0].doubts}
    assert not doubted & {"identities", "lost-mark"}


def test_a_tool_that_hides_what_it_does_not_hold_in_one_grasp_holds_no_more(tmp_path):
    positions = lifted()
    positions[N_STILL, [row for row in range(len(REST)) if row not in HELD]] = np.nan
    assert not {"grip-share"} & set.union(*found(tmp_path, positions, radius=6e-3)[1:])


def test_a_grasp_that_begins_unseen_is_not_compared_with_the_last_one(tmp_path):
    """A second grasp at the same place begins without points, half way up."""
    positions = np.concatenate([lifted(), lifted()[N_STILL + 4 :]])
    again, rows = N_STILL + N_CLOSED, np.arange(len(REST))
    tracks = [rows[:0] if k == again else rows for k in range(len(positions))]
    surveyed = found(tmp_path, positions, tracks=tracks, second=again)[0]
    assert surveyed.tool_gap_m == found(tmp_path, lifted())[0].tool_gap_m


def test_points_that_come_later_count(tmp_path):
    """Half the tracks begin in frame 2; then all are seen, and their motion is in the numbers."""
    rows = np.arange(len(REST))
    tracks = [rows[60:] if k < 2 else rows for k in range(N_STILL + N_CLOSED)]
    whole = found(tmp_path, lifted())[0]
    surveyed, refused, doubted = found(tmp_path, lifted(), tracks=tracks)
    assert (refused, doubted) == (set(), set())
    assert surveyed.points == len(REST) and surveyed.unseen == 0
    assert surveyed.held_motion_m == whole.held_motion_m == pytest.approx(0.8 * LIFT, rel=0.05)
    assert surveyed.points_motion_m == pytest.approx(whole.points_motion_m, rel=0.05)
