"""What makes the tool's motion another than that of the points that it holds is named; what may be so is not."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from jiggle_mj.observation import IDENTITY_WXYZ, Declaration, MeasuredPoints, Observation, ToolState
from jiggle_mj.plausibility.increments import follow_in_sum
from jiggle_mj.plausibility.problem import RecordingProblem
from jiggle_mj.plausibility.problems import problems
from jiggle_mj.plausibility.survey import survey
from jiggle_mj.recording.reader import Recording
from jiggle_mj.recording.writer import RecordingWriter

SPACING = 5e-3
"""Distance of the points at rest [m]."""
SD = 2e-4
"""Noise of a coordinate [m]."""
LIFT, LEAN = 20e-3, 0.2
"""Length of the lift [m] and its lean towards the middle [rad]."""
PERIOD, GRASP = 0.1, 5.0
"""Time from frame to frame, and of a grasp with the way to the next one [s]."""
REST = np.array([(SPACING * column, SPACING * row, 0.0) for row in range(10) for column in range(12)])
"""Points of the sheet at rest [m]."""
CORNERS = [0, 11, 119]
OUTLIER, LATE_JUMP = 62, 70
"""Frames in the middle of the second grasp: of one wrong report, and from which on all are wrong."""
IMPRECISION = 0.01
"""Tolerance of a fitted shift [s]: a tenth of the period."""


def smooth(share: float) -> float:
    """A step from 0 to 1 without jerk at its ends."""
    u = np.clip(share, 0, 1)
    return float(10 * u**3 - 15 * u**4 + 6 * u**5)


def tip(time: float) -> np.ndarray:
    """The path of the tool: each corner is lifted and lowered in 4 s, then the tool goes to the next one."""
    grasp = int(np.clip(time // GRASP, 0, len(CORNERS) - 1))
    corner, since = REST[CORNERS[grasp]], time - GRASP * grasp
    if since >= 4.2 and grasp + 1 < len(CORNERS):
        return corner + (REST[CORNERS[grasp + 1]] - corner) * smooth((since - 4.2) / 0.8)
    inward = (REST.mean(axis=0) - corner) / np.linalg.norm(REST.mean(axis=0) - corner)
    direction = np.array([0, 0, np.cos(LEAN)]) + np.sin(LEAN) * inward
    return corner + LIFT * smooth((since - 0.4) / 1.4) * (1 - smooth((since - 2.2) / 1.4)) * direction


def lifts(
    *,
    report: Callable[[np.ndarray], np.ndarray] = lambda place: place,
    late: float = 0.0,
    drift: float = 0.0,
    slip: float = 1.0,
    inverted: bool = False,
    sd: float = SD,
    points: Callable[[np.ndarray], np.ndarray] = lambda places: places,
) -> list[Observation]:
    """Three corners are lifted one after the other; each argument makes one mistake.

    Args:
        report: the reported position for the true one.
        late: age of a report [s].
        drift: age that a report gains in a second [s].
        slip: share of the tool's displacement that held points follow.
        inverted: whether the gripper reports open for closed.
        sd: noise of a coordinate [m].
        points: the measured positions for the true ones.
    """
    rng, frames = np.random.default_rng(5), list[Observation]()
    for index in range(round(GRASP * len(CORNERS) / PERIOD)):
        time = index * PERIOD
        grasp, since = int(time // GRASP + 1e-9), time % GRASP
        corner = REST[CORNERS[grasp]]
        distance = np.linalg.norm(REST - corner, axis=1)
        moved = tip(time) - corner if since < 4.2 else np.zeros(3)
        share = slip * np.exp(-np.maximum(0, distance - 6e-3) / 15e-3)
        closed = 0.15 <= since < 3.9
        held = tuple(np.flatnonzero(distance < 6e-3).tolist())
        frames.append(
            Observation(
                index=index,
                time=round(time * 1e9),
                tool=ToolState(
                    position=report(tip(max(0.0, time - late - drift * time))),
                    quat_wxyz=IDENTITY_WXYZ,
                    closed=closed != inverted,
                    grasp=grasp + (since >= 0.15),
                    radius=6e-3,
                    held_tracks=held if closed != inverted else (),
                ),
                points=MeasuredPoints(
                    positions=points(REST + share[:, None] * moved) + rng.normal(scale=sd, size=REST.shape),
                    track_id=np.arange(len(REST)),
                    sd=sd,
                ),
            )
        )
    return frames


def found(path, observations: list[Observation], **declared) -> dict[str, RecordingProblem]:
    with RecordingWriter(path / "run.mcap", camera=None, declaration=Declaration(**declared), metadata={}) as writer:
        for observation in observations:
            writer.write(observation)
    return {each.name: each for each in problems(survey(Recording.open(path / "run.mcap")))}


def turned(degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


@pytest.mark.parametrize(
    "mistake",
    [
        {},
        {"report": lambda place: place + np.array([3e-3, 0, 0])},  # as well as robots report their tip
        {"report": lambda place: turned(3.0) @ place},
        {"report": lambda place: 1.05 * place},
        {"late": 0.005},  # as closely as images and tool are paired
    ],
)
def test_what_the_estimator_allows_for_is_no_problem(tmp_path, mistake):
    assert found(tmp_path, lifts(**mistake)) == {}


def test_points_that_slip_are_explained_by_no_frame_and_no_clock(tmp_path):
    assert set(found(tmp_path, lifts(slip=0.3))) == {"tool-gap"}


@pytest.mark.parametrize("slip", [0.04, 0.1, 0.001])
def test_points_that_hardly_follow_over_several_grasps_are_no_unit(tmp_path, slip):
    """Within each grasp the tool's motion seems to be in inches or cm, and it goes with them to the next one."""
    assert "tool-unit" not in found(tmp_path, lifts(slip=slip, sd=2e-5))


def test_displacements_from_frame_to_frame_are_refused(tmp_path):
    """The tool speeds up, slows down and turns back, and so do they; no point that slips does."""
    frames = lifts()
    places = np.stack([frame.points.positions for frame in frames if frame.points is not None])
    steps = np.diff(places, axis=0, prepend=places[:1])
    wrong = [
        replace(frame, points=replace(frame.points, positions=REST + step))
        for frame, step in zip(frames, steps, strict=True)
    ]
    assert found(tmp_path, wrong)["increments"].refuses


def test_displacements_from_frame_to_frame_are_found_among_much_noise(tmp_path):
    """Over a hundred frames the noise of the first one adds up to the length of the lift, and may not hide it."""
    rng, height = np.random.default_rng(3), LIFT * np.sin(np.linspace(0, np.pi, 100))
    tool = height[:, None] * np.array([0, 0, 1.0])
    for _ in range(20):
        held = np.diff(tool, axis=0, prepend=0.0) + rng.normal(scale=SD / 2, size=tool.shape)
        assert follow_in_sum(held - held[0], tool) and not follow_in_sum(0.1 * tool + held * 0.1, tool)
        assert not follow_in_sum(rng.normal(scale=SD / 2, size=tool.shape), tool)


def test_points_that_friction_drags_along_are_not_refused(tmp_path):
    """They follow by a step's length, and return when the tool turns back: their sum follows it too."""
    up = np.array([0, 0, 1.0])
    frames = lifts()
    heights = np.array([frame.tool.position @ up for frame in frames])
    drag = 6e-4 * np.sign(np.round(np.diff(heights, prepend=0.0), 6))
    dragged = [
        replace(frame, points=replace(frame.points, positions=REST + by * up))
        for frame, by in zip(frames, drag, strict=True)
    ]
    assert not [each for each in found(tmp_path, dragged).values() if each.name == "increments" and each.refuses]


@pytest.mark.parametrize(
    ("report", "words"),
    [
        (lambda place: place * [-1, 1, 1], "(-x, y, z)"),
        (lambda place: place * [1, 1, -1], "(x, y, -z)"),
        (lambda place: place[[1, 0, 2]], "(y, x, z)"),
        (lambda place: place[[1, 2, 0]], "(z, x, y)"),
        (lambda place: turned(45.0) @ place, "rotated by 45 degrees about [0.0, 0.0, -1.0]"),
    ],
)
def test_other_axes_are_refused_with_what_undoes_them(tmp_path, report, words):
    """The inverse of what was done to the positions, about the sheet's corner as well as within each lift."""
    problem = found(tmp_path, lifts(report=report))["tool-axes"]
    assert problem.refuses
    assert words in problem.text.replace("-0.0", "0.0")


@pytest.mark.parametrize("factor", [1000.0, 100.0, 25.4, 10.0, 0.1, 1e-3])
def test_another_unit_is_refused_with_its_factor(tmp_path, factor):
    problem = found(tmp_path, lifts(report=lambda place: place * factor))["tool-unit"]
    assert problem.refuses
    assert (f"1/{factor:g} as large" if factor > 1 else f"{1 / factor:g} times as large") in problem.text


@pytest.mark.parametrize("late", [0.05, 0.1, -0.05, -0.1])
def test_another_clock_is_doubted_with_the_seconds_to_add(tmp_path, late):
    problems_found = found(tmp_path, lifts(late=late))
    assert set(problems_found) == {"tool-clock"}
    problem = problems_found["tool-clock"]
    said = re.search(r"add (-?[0-9.]+) to tool_clock_offset", problem.text)
    assert said is not None
    assert float(said[1]) == pytest.approx(-late, abs=IMPRECISION)
    assert not problem.refuses
    assert ("tool_latency" if late > 0 else "image_latency") in problem.text


def test_a_clock_that_runs_fast_is_named_with_its_rate(tmp_path):
    """A report shows the time t - 0.05 t, so the clock gains 0.05 / 0.95 = 5.3 % on what it should show."""
    assert "runs 5.3% fast" in found(tmp_path, lifts(drift=0.05))["tool-drift"].text


def test_a_report_that_jumps_away_and_back_is_named_with_its_time(tmp_path):
    frames = lifts()
    tool = frames[OUTLIER].tool
    frames[OUTLIER] = replace(frames[OUTLIER], tool=replace(tool, position=tool.position + np.array([0, 0.01, 0])))
    assert f"at {OUTLIER * PERIOD:g} s the tool jumps 10" in found(tmp_path, frames)["tool-outlier"].text


def test_a_tool_that_jumps_and_stays_has_no_outlier(tmp_path):
    frames = [
        replace(each, tool=replace(each.tool, position=each.tool.position + np.array([0, 0.01, 0])))
        if k >= LATE_JUMP
        else each
        for k, each in enumerate(lifts())
    ]
    assert "tool-outlier" not in found(tmp_path, frames)


@pytest.mark.parametrize("offset", [[0.015, 0, 0], [0, 0, -0.03], [0, 0.05, 0]])
def test_a_tip_beside_what_it_holds_is_doubted_with_the_offset(tmp_path, offset):
    """The three points of a corner are 2 mm from the tip, which does not take the offset's direction away."""
    problem = found(tmp_path, lifts(report=lambda place: place - offset))["tool-offset"]
    said = re.search(r"by \[(.*)\] mm on average", problem.text)
    assert said is not None
    assert not problem.refuses
    np.testing.assert_allclose([float(each) for each in said[1].split(",")], 1e3 * np.array(offset), atol=2.5)


def test_jaws_that_close_where_no_point_is_are_doubted(tmp_path):
    frames = [replace(frame, tool=replace(frame.tool, held_tracks=())) for frame in lifts()]
    up = np.array([0, 0, 0.03])
    away = [replace(each, tool=replace(each.tool, position=each.tool.position + up)) for each in frames]
    assert "grip-empty" not in found(tmp_path, frames)
    (tmp_path / "away").mkdir()
    assert "in 3 of 3 grasps the nearest point is 30" in found(tmp_path / "away", away)["grip-empty"].text


def test_an_inverted_gripper_is_refused_by_name(tmp_path):
    assert found(tmp_path, lifts(inverted=True))["gripper-inverted"].refuses


def test_a_sheet_that_is_lifted_along_gravity_has_its_bed_above(tmp_path):
    down = np.array([1.0, -1.0, -1.0])
    frames = lifts(report=lambda place: place * down, points=lambda places: places * down)
    assert "gravity = [0.0, 0.0, 9.81]" in found(tmp_path, frames)["bed-above"].text
    (tmp_path / "declared").mkdir()
    assert found(tmp_path / "declared", frames, gravity=(0.0, 0.0, 9.81)) == {}


def test_a_bed_at_right_angles_to_the_sheet_is_doubted(tmp_path):
    problem = found(tmp_path, lifts(), gravity=(-9.81, 0.0, 0.0))["bed-tilted"]
    assert "90 degrees" in problem.text
    assert "along z" in problem.text
    (tmp_path / "no_bed").mkdir()
    assert found(tmp_path / "no_bed", lifts(), gravity=(-9.81, 0.0, 0.0), bed=False) == {}
