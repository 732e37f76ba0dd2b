"""The force on the tool is read in the world's axes, with its noise, or left out with a reason."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jiggle_mj.errors import ObservationError, RecordingError
from jiggle_mj.observation import Declaration, MeasuredForce, ToolState
from jiggle_mj.plausibility.force_problems import force_problems
from jiggle_mj.recording.force import FORCE_SCHEMA, TOOL, UNMEASURED, ToolForce, force_json, parse_force
from jiggle_mj.recording.frames import camera_transforms
from jiggle_mj.recording.reader import Recording
from jiggle_mj.recording.schemas import frame_transform
from jiggle_mj.recording.topics import FORCE, TF
from jiggle_mj.recording.writer import RecordingWriter
from tests.support.recordings import MS, ROUNDING, Bag, camera, observations, tool

ON_TOOL = np.array([0.1, -0.2, 0.3])


def test_a_force_is_read_as_it_was_written(tmp_path):
    seen = [replace(each, force=MeasuredForce(on_tool=ON_TOOL, sd=0.02)) for each in observations()]
    seen[1] = replace(seen[1], force=None)
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, camera=camera(), declaration=Declaration(), metadata={}) as writer:
        for each in seen:
            writer.write(each)
    recording = Recording.open(path, pose_age_ns=10**12)  # so that the force of the frame before is not too old
    forces = [each.force for each in recording]
    assert (
        recording.lost_forces == (1, 3)
        and forces[1] is None
        and [force.sd for force in forces if force] == [0.02, 0.02]
    )
    np.testing.assert_array_equal(forces[2].on_tool, ON_TOOL)


def recorded(path, *forces: ToolForce) -> Recording:
    """Return a recording of one frame at 0 and one at 10 ms, with forces in the frame of a robot."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    bag = Bag(path, cameras=camera())
    transforms = camera_transforms(camera())
    transforms.transforms.append(frame_transform("world", "robot", T))
    bag.output.message(TF, 0, transforms)
    for time in (0, 10 * MS):
        bag.tool(time)
        bag.pair(time)
    for force in forces:
        bag.output.json(FORCE, force.time, force_json(force), schema=FORCE_SCHEMA)
    bag.output.close()
    return Recording.open(path)


def measured(time: int, frame: str, force: tuple[float, float, float] = (1.0, 2.0, 3.0)) -> ToolForce:
    return ToolForce(time=time, force=force, torque=(0.0, 0.0, 0.0), frame_id=frame)


def test_the_latest_force_counts_in_the_axes_of_the_world_or_of_the_tool(tmp_path):
    """A quarter turn about z takes (x, y) to (-y, x)."""
    recording = recorded(tmp_path / "run.mcap", measured(0, "robot"), measured(12 * MS, TOOL))
    first, second = (each.force for each in recording)
    np.testing.assert_allclose(first.on_tool, [-2, 1, 3], atol=10 * ROUNDING)
    turned = Rotation.from_quat(tool().quat_wxyz, scalar_first=True).apply([1, 2, 3])
    np.testing.assert_allclose(second.on_tool, turned, atol=1e-11)  # the quaternion is rounded to twelve decimals
    assert first.sd is None and recording.why_no_force is None


def test_a_force_that_is_no_number_is_none_in_its_frame_and_is_counted(tmp_path):
    """An earlier force does not stand for it."""
    recording = recorded(tmp_path / "run.mcap", measured(0, "world"), measured(10 * MS, "world", UNMEASURED))
    first, second = (each.force for each in recording)
    assert second is None
    np.testing.assert_array_equal(first.on_tool, [1, 2, 3])
    (problem,) = force_problems(recording, [])
    assert problem.name == "force-missing" and not problem.refuses and problem.text.startswith("1 of 2 forces")


@pytest.mark.parametrize("lost", ["NaN", "Infinity", "-Infinity", "null"])
def test_what_programs_write_for_no_number_is_read(lost):
    """Also of a torque, which nothing is computed from."""
    message = f'{{"force": [0.5, {lost}, 1], "torque": [0, 0, {lost}], "frame_id": "world"}}'.encode()
    found = parse_force(message, 0)
    assert not found.is_measured and found.torque == (0, 0, 0)
    with pytest.raises(RecordingError, match="force"):
        parse_force(message.replace(b"0.5", b'"0.5"'), 0)


def test_a_recording_whose_forces_are_all_lost_is_refused(tmp_path):
    (problem,) = force_problems(recorded(tmp_path / "run.mcap", measured(0, "world", UNMEASURED)), [])
    assert problem.name == "force-missing" and problem.refuses


@pytest.mark.parametrize(("stated", "doubted"), [(1e-3, True), (1.0, False), (1.4, False), (4.0, True), (1e3, True)])
def test_a_stated_noise_of_the_force_that_open_jaws_contradict_is_doubted(tmp_path, stated, doubted):
    """Stated in multiples of the true one; 20 open frames give it to a tenth."""
    noise, offset = np.random.default_rng(1), np.array([0.3, 0.1, 1.0])
    frames = [
        (
            replace(tool(), closed=False),
            MeasuredForce(on_tool=offset + noise.normal(size=3) * SENSOR_SD, sd=stated * SENSOR_SD),
        )
        for _ in range(20)
    ]
    found = list(force_problems(recorded(tmp_path / "run.mcap", measured(0, "robot")), frames))
    assert [problem.name for problem in found] == ["force-noise"] * doubted


def test_a_force_in_an_unknown_frame_is_left_out_and_named(tmp_path):
    recording = recorded(tmp_path / "run.mcap", measured(0, "robot"), measured(0, "ft_sensor"))
    assert [each.force for each in recording] == [None, None]
    (problem,) = force_problems(recording, [])
    assert problem.name == "force-frame" and "'ft_sensor'" in problem.text


def test_an_old_force_is_not_used(tmp_path):
    """The tool reports anew in each frame, and the force is 10 ms old in the second."""
    recorded(tmp_path / "run.mcap", measured(0, "robot"))
    first, second = Recording.open(tmp_path / "run.mcap", pose_age_ns=9 * MS)
    assert first.force is not None and second.force is None


@pytest.mark.parametrize(
    ("force", "message"),
    [([1.0, 2.0], "force"), ([1.0, 2.0, 3e5], "is it in mN")],
)
def test_a_malformed_force_is_refused(tmp_path, force, message):
    bag = Bag(tmp_path / "run.mcap", cameras=camera())
    bag.output.json(FORCE, 0, {"force": force, "torque": [0, 0, 0], "frame_id": "world"}, schema=FORCE_SCHEMA)
    bag.output.close()
    with pytest.raises(RecordingError, match=message):
        Recording.open(bag.output.path)


def test_a_force_that_is_none_is_refused():
    with pytest.raises(ObservationError, match=r"MeasuredForce\.sd"):
        MeasuredForce(on_tool=ON_TOOL, sd=0.0)


SENSOR_SD = 1e-4
"""Noise of a component of the force [N]; the lifts pull with 0.2 N."""


def lift(force) -> list[tuple[ToolState, MeasuredForce | None]]:
    """Return an open frame, then ten of a lift by 9 mm, with the force on the tool by the height [m]."""
    closed, frames, noise = replace(tool(), closed=True), [], np.random.default_rng(0)
    for height in (None, *np.arange(10) * 1e-3):
        at = closed.position + np.array([0, 0, height or 0.0])
        on_tool = np.array(force(height or 0.0), dtype=float) + noise.normal(size=3) * SENSOR_SD
        frames.append((replace(closed, closed=height is not None, position=at), MeasuredForce(on_tool=on_tool)))
    return frames


@pytest.mark.parametrize(
    ("force", "names"),
    [
        (lambda z: [0.3, 0, 1 - 20 * z], []),
        (lambda z: [0.3, 0, 1 + 20 * z], ["force-sign"]),
        (lambda z: [0, 0, -2e4 * z], ["force-size"]),
        (lambda z: [0, 0, 0], []),
    ],
)
def test_a_force_that_does_negative_work_or_is_too_large_is_doubted(tmp_path, force, names):
    recording = recorded(tmp_path / "run.mcap", measured(0, "robot"))
    assert [problem.name for problem in force_problems(recording, lift(force))] == names


@pytest.mark.parametrize(
    ("measures", "words"),
    [
        ([0, 0, 0], "the same in all frames"),
        ([0, 0, 1], "along 1 of three axes"),
        ([1, 0, 1], "along 2 of three axes"),
    ],
)
def test_a_force_without_all_axes_is_doubted_in_any_frame(tmp_path, measures, words):
    R = Rotation.from_euler("xyz", [10, 20, 30], degrees=True)
    frames = [
        (tool, MeasuredForce(on_tool=R.apply(force.on_tool * measures + [0, 0.5, 0])))
        for tool, force in lift(lambda z: [0.3, 0, 1 - 20 * z])
        if force is not None
    ]
    (problem,) = force_problems(recorded(tmp_path / "run.mcap", measured(0, "robot")), frames)
    assert problem.name == "force-axes" and words in problem.text
