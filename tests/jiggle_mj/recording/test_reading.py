"""Reading what robots write: other frames, stamps that differ, images of other encodings, frames that are skipped."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from scipy.spatial.transform import Rotation

from jiggle_mj.errors import RecordingError
from jiggle_mj.observation import (
    Declaration,
    MeasuredPoints,
)
from jiggle_mj.recording.frames import camera_transforms
from jiggle_mj.recording.images import decode_image
from jiggle_mj.recording.pairing import Stamped, group_messages
from jiggle_mj.recording.reader import Recording
from jiggle_mj.recording.schemas import (
    GRASP_SCHEMA,
    frame_transform,
    grasp_json,
    image_message,
    point_cloud,
    pose_message,
)
from jiggle_mj.recording.topics import GRASP, LEFT, POINTS, POSE, RIGHT, TF
from jiggle_mj.recording.writer import RecordingWriter
from tests.support.recordings import MS, ROUNDING, Bag, camera, image, malformed, read_all, tool

JPEG_LOSS = 3
"""Largest difference of a grey value that JPEG may make in a flat image."""


def test_other_topics_are_counted_and_ignored(tmp_path):
    bag = Bag(tmp_path / "robot.mcap", cameras=camera())
    bag.tool(0)
    bag.pair(0)
    for time in range(4):
        bag.output.json("/joint_states", time, {}, schema={"title": "joints"})
    bag.output.close()
    recording = Recording.open(bag.output.path)
    assert recording.ignored == {"/joint_states": 4} and len(list(recording)) == 1
    assert recording.declaration == Declaration() and recording.metadata == {}


def test_the_noise_of_points_is_that_of_those_seen_and_must_be_one_positive_number(tmp_path):
    """In turn: the first point's sd is NaN, every sd is 0, two sds differ."""
    xyz = dict(zip("xyz", np.random.default_rng(0).normal(size=(3, 4)), strict=True))
    bag = Bag(tmp_path / "noise.mcap")
    for number, sd in enumerate(([np.nan, 1e-3, 1e-3, 1e-3], [0.0] * 4, [1e-3, 2e-3, 1e-3, 1e-3])):
        bag.tool(number * MS)
        bag.output.message(POINTS, number * MS, point_cloud(number * MS, xyz | {"sd": np.array(sd)}))
    bag.output.close()
    recording = Recording.open(tmp_path / "noise.mcap")
    (kept,) = recording
    assert kept.points.sd == 1e-3
    (_, zero_sd), (_, two_sds) = recording.skipped
    assert "sd must be above 0 and finite, in m; got 0.0" in zero_sd and "from 0.001 to 0.002" in two_sds


def test_noise_that_neighbours_share_is_read_as_it_was_written_and_the_lack_of_a_statement_too(tmp_path):
    """In turn: all is stated; nothing; the shared noise is more than all noise together."""
    xyz = dict(zip("xyz", np.random.default_rng(0).normal(size=(3, 4)), strict=True))
    bag, stated = Bag(tmp_path / "noise.mcap"), [{"sd": 2e-4, "smooth_sd": 1e-4, "smooth_length": 0.01}, {}]
    for number, noise in enumerate([*stated, {"sd": 1e-4, "smooth_sd": 2e-4, "smooth_length": 0.01}]):
        bag.tool(number * MS)
        columns = {name: np.full(4, value) for name, value in noise.items()}
        bag.output.message(POINTS, number * MS, point_cloud(number * MS, xyz | columns))
    bag.output.close()
    recording = Recording.open(tmp_path / "noise.mcap")
    all_stated, none_stated = recording
    assert (all_stated.points.sd, all_stated.points.smooth_sd, all_stated.points.smooth_length) == (2e-4, 1e-4, 0.01)
    assert all_stated.points.sd_stated and not none_stated.points.sd_stated
    ((_, reason),) = recording.skipped
    assert "of which it is a part" in reason
    with RecordingWriter(tmp_path / "again.mcap", camera=None, declaration=Declaration(), metadata={}) as writer:
        for observation in (all_stated, none_stated):
            writer.write(observation)
    for one, other in zip(Recording.open(tmp_path / "again.mcap"), (all_stated, none_stated), strict=True):
        names = ("sd", "sd_stated", "smooth_sd", "smooth_length")
        assert [getattr(one.points, name) for name in names] == [getattr(other.points, name) for name in names]


def test_frames_that_fail_a_check_are_named_and_skipped(tmp_path):
    bag = Bag(tmp_path / "run.mcap", cameras=camera())
    times = iter(range(0, 2000 * MS, 100 * MS))
    expected = {}

    def next_time(index: int, why: str | None) -> int:
        if why:
            expected[index] = why
        return next(times)

    time = next_time(0, None)
    bag.tool(time)
    bag.pair(time)
    time = next_time(1, "missing half of the stereo pair: /camera/right/image_raw")
    bag.tool(time)
    bag.image(LEFT, time, image(0))
    time = next_time(2, "missing half of the stereo pair: /camera/left/image_raw")
    bag.tool(time)
    bag.image(RIGHT, time, image(0))
    time = next_time(3, "NaN in the pose")
    bag.tool(time, malformed(tool(), position=np.array([np.nan, 0, 0])))
    bag.pair(time)
    time = next_time(4, "/camera/right/image_raw is 20x24 and its calibration 32x24")
    bag.tool(time)
    bag.image(LEFT, time, image(0))
    bag.image(RIGHT, time, image(0, width=20))
    time = next_time(5, "/camera/left/image_raw cannot be decoded as png")
    bag.tool(time)
    broken = image_message(time, image(0), "left")
    broken.data = broken.data[:20]
    bag.output.message(LEFT, time, broken)
    bag.image(RIGHT, time, image(0))
    expected[6] = "time goes backwards, from 500000000 ns to 50000000 ns"
    bag.tool(50 * MS)
    bag.pair(50 * MS)
    time = next_time(7, "not of unit length")
    bag.tool(time, replace(tool(), quat_wxyz=np.array([2.0, 0, 0, 0])))
    bag.pair(time)
    time = next_time(8, None)
    bag.tool(time)
    bag.pair(time)
    bag.output.close()
    seen, skipped = read_all(bag.output.path)
    assert [observation.index for observation in seen] == [0, 8]
    assert [index for index, _ in skipped] == list(expected)
    for index, why in skipped:
        assert expected[index] in why and "\n" not in why


def test_stamps_within_the_tolerance_make_one_frame(tmp_path):
    """Right image 4 ms late, cloud 3 ms early, pose 2 ms late; times of a robot's clock start at 0 with the first."""
    start = 1_700_000_000 * 1000 * MS
    bag = Bag(tmp_path / "run.mcap", cameras=camera())
    for k in range(3):
        time = start + k * 100 * MS
        bag.points(time - 3 * MS, track_id=np.array([k, 11, 12], np.uint32))
        bag.image(LEFT, time, image(k))
        bag.tool(time + 2 * MS, tool(x=float(k)))
        bag.image(RIGHT, time + 4 * MS, image(10 + k))
    bag.output.close()
    seen, skipped = read_all(bag.output.path)
    assert skipped == [] and [observation.time for observation in seen] == [0, 100 * MS, 200 * MS]
    for k, observation in enumerate(seen):
        assert observation.tool.position[0] == k and observation.points.track_id[0] == k
        np.testing.assert_array_equal(observation.images.right, image(10 + k))
    with pytest.raises(RecordingError, match=r"no pair within 1 ms.* comes 4 ms later .*--pairing-tolerance 5 "):
        Recording.open(bag.output.path, tolerance_ns=1 * MS)


def test_an_old_tool_pose_does_not_say_where_the_tool_is(tmp_path):
    bag = Bag(tmp_path / "run.mcap", cameras=camera())
    bag.pair(0)
    bag.tool(50 * MS)
    for time in (100, 400):
        bag.pair(time * MS)
    bag.output.close()
    seen, skipped = read_all(bag.output.path)
    assert [observation.index for observation in seen] == [1]
    assert skipped == [(0, "no tool pose or grasp has come yet"), (2, "the latest tool pose is 350 ms old")]


def test_each_message_is_used_once_and_the_nearest_wins():
    """Two left images 2 ms apart and one right image between them: the first takes it, the second lacks its half."""
    stamped = [Stamped(stamp=stamp, ordinal=ordinal) for ordinal, stamp in enumerate((0, 2 * MS, 1 * MS))]
    groups = group_messages(left=stamped[:2], right=stamped[2:], points=[], pose=[], grasp=[], tolerance=5 * MS)
    assert [group.right for group in groups] == [stamped[2], None]


def test_points_and_tool_in_another_frame_are_transformed_to_the_world(tmp_path):
    """p_world = T_world_robot p_robot, with T a quarter turn about z and a shift."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("z", 90, degrees=True).as_matrix(), [1, 2, 3]
    bag = Bag(tmp_path / "run.mcap")
    transforms = camera_transforms(camera())
    transforms.transforms.append(frame_transform("world", "robot", T))
    bag.output.message(TF, 0, transforms)
    pose, cloud = pose_message(0, tool()), point_cloud(0, {a: np.ones(2, np.float32) * k for k, a in enumerate("xyz")})
    pose.frame_id = cloud.frame_id = "robot"
    bag.output.message(POSE, 0, pose)
    bag.output.json(GRASP, 0, grasp_json(tool()), schema=GRASP_SCHEMA)
    bag.output.message(POINTS, 0, cloud)
    bag.output.close()
    ((seen,), skipped) = read_all(bag.output.path)
    assert skipped == [] and seen.points.sd == MeasuredPoints(positions=np.zeros((1, 3))).sd
    np.testing.assert_allclose(seen.points.positions, [[1 - 1, 2 + 0, 3 + 2]] * 2, atol=ROUNDING)
    x, y, z = tool().position
    np.testing.assert_allclose(seen.tool.position, [1 - y, 2 + x, 3 + z], atol=ROUNDING)
    in_world = Rotation.from_quat(seen.tool.quat_wxyz, scalar_first=True)
    in_robot = Rotation.from_quat(tool().quat_wxyz, scalar_first=True)
    assert (in_world * in_robot.inv()).magnitude() == pytest.approx(np.pi / 2)


@pytest.mark.parametrize(("encoding", "channels"), [("rgb8", 3), ("bgr8", 3), ("mono8", 1)])
def test_raw_images_are_read_with_padded_rows(encoding, channels):
    rgb = image(5)
    if channels == 1:
        rgb = np.repeat(rgb[..., :1], 3, axis=2)
    stored = {"rgb8": rgb, "bgr8": rgb[..., ::-1], "mono8": rgb[..., :1]}[encoding].reshape(24, -1)
    padded = np.pad(stored, ((0, 0), (0, 7)))
    message = RawImage(width=32, height=24, encoding=encoding, step=padded.shape[1], data=padded.tobytes())
    np.testing.assert_array_equal(decode_image(message), rgb)
    message.data = message.data[:-1]
    with pytest.raises(RecordingError, match="need more"):
        decode_image(message)
    message.encoding = "yuv422"
    with pytest.raises(RecordingError, match="'yuv422'; rgb8"):
        decode_image(message)


def test_a_jpeg_is_read(tmp_path):
    flat = np.full((24, 32, 3), (200, 80, 20), np.uint8)
    message = image_message(0, flat, "left")
    message.data, message.format = cv2.imencode(".jpg", flat[..., ::-1])[1].tobytes(), "jpeg"
    assert np.abs(decode_image(message).astype(int) - flat).max() <= JPEG_LOSS


def test_a_cloud_without_z_is_skipped_by_name(tmp_path):
    bag = Bag(tmp_path / "run.mcap")
    bag.tool(0)
    bag.output.message(POINTS, 0, point_cloud(0, {"x": np.zeros(2), "y": np.zeros(2)}))
    bag.output.close()
    assert read_all(bag.output.path) == ([], [(0, "/tissue/points lacks the fields ['z']; it has ['x', 'y'].")])


def test_reports_during_an_unusable_frame_go_to_the_next_one(tmp_path):
    bag = Bag(tmp_path / "run.mcap")
    for time, x in ((0, 0.0), (40, 1.0), (100, 2.0), (140, np.nan), (160, 3.0), (200, 4.0)):
        state = malformed(tool(), position=np.array([x, 0.0, 0.0]))
        bag.tool(time * MS, state)
        if time in (0, 200):
            bag.points(time * MS)
        elif time == 100:
            bag.points(time * MS, sd=np.array([1.0, 2.0, 3.0]))
    bag.output.close()
    seen, skipped = read_all(bag.output.path)
    assert [index for index, _ in skipped] == [1]
    assert [(report.time, report.position[0]) for report in seen[1].reports] == [
        (40 * MS, 1.0),
        (100 * MS, 2.0),
        (160 * MS, 3.0),
    ]
