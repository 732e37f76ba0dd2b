"""Recordings: what is written is read back, in the same bytes; what is wrong is refused or named."""

import hashlib
import json
from dataclasses import fields, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory
from scipy.spatial.transform import Rotation

from jiggle_mj.camera import CameraCalibration, StereoCamera, as_recorded
from jiggle_mj.errors import OutputError, RecordingError
from jiggle_mj.observation import (
    Declaration,
    DeclaredMesh,
    MeasuredPoints,
    Observation,
    StereoPair,
    ToolReport,
    ToolState,
)
from jiggle_mj.recording.contents import GRASP, LEFT, LEFT_INFO, POINTS, POSE, RIGHT, RIGHT_INFO, SCHEMAS, TF
from jiggle_mj.recording.declaration import DECLARATION, MESH
from jiggle_mj.recording.frames import camera_transforms
from jiggle_mj.recording.mcap_files import McapOutput
from jiggle_mj.recording.pairing import Stamped, group_moments
from jiggle_mj.recording.reader import Recording, RecordingWriter
from jiggle_mj.recording.schemas import (
    GRASP_SCHEMA,
    calibration_message,
    decode_image,
    frame_transform,
    grasp_json,
    image_message,
    parse_transform,
    point_cloud,
    pose_message,
    timestamp,
)
from jiggle_mj.recording.truth import TruthWriter, read_truth, write_truth
from jiggle_mj.truth import Truth, TruthFrame

ROUNDING = 1e-14
"""A rotation goes through a quaternion and back: a few roundings of numbers near 1."""
STATED = 2e-12
"""A matrix is stated as a quaternion of twelve decimals."""
MS = 1_000_000


def camera(**changes) -> StereoCamera:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", [2.2, 0.3, -0.1]).as_matrix()
    T[:3, 3] = [0.01, -0.05, 0.09]
    settings = {"width": 32, "height": 24, "focal": 40.0, "baseline": 0.005, "T_world_camera": T}
    return StereoCamera.rectified(**(settings | changes))


def tool(*, x: float = 0.1, held: tuple[int, ...] = ()) -> ToolState:
    quat_wxyz = Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).as_quat(scalar_first=True)
    return ToolState(
        position=np.array([x, -1 / 3, 0.07]), quat_wxyz=quat_wxyz, closed=True, grasp=2, radius=0.003, held_tracks=held
    )


def image(seed: int, *, height: int = 24, width: int = 32) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def observations(n: int = 3) -> list[Observation]:
    generator = np.random.default_rng(7)
    result = []
    for index in range(n):
        positions = generator.normal(size=(5, 3))
        positions[index % 5] = np.nan
        result.append(
            Observation(
                index=index,
                time=index * 125 * MS + (index > 0),
                tool=replace(tool(x=0.1 + index, held=(3, 1)), by_points=index == 1),
                reports=tuple(
                    ToolReport(time=index * 125 * MS - late * MS, position=generator.normal(size=3))
                    for late in ((80, 40) if index == 2 else ())
                ),
                images=StereoPair(left=image(2 * index), right=image(2 * index + 1)),
                points=MeasuredPoints(positions=positions, track_id=np.array([4, 2, 0, 9, -1]), sd=1 / 3e4),
            )
        )
    return result


def declared_mesh() -> DeclaredMesh:
    return DeclaredMesh(
        vertices=np.array([[0, 0, 0], [1, 0, 0], [0, 1, 1 / 3]]),
        faces=np.array([[0, 1, 2]]),
        track_id=np.array([4, -1, 2]),
        held=np.array([False, True, False]),
    )


def write(path: Path, seen: list[Observation], **changes) -> Path:
    settings = {"camera": camera(), "declaration": Declaration(), "metadata": {"seed": "3"}} | changes
    with RecordingWriter(path, **settings) as writer:
        for observation in seen:
            writer.write(observation)
    return path


def assert_same(one: Observation, other: Observation) -> None:
    assert (one.index, one.time) == (other.index, other.time)
    for f in fields(ToolState):
        np.testing.assert_array_equal(getattr(one.tool, f.name), getattr(other.tool, f.name))
    assert [report.time for report in one.reports] == [report.time for report in other.reports]
    for report, same in zip(one.reports, other.reports, strict=True):
        np.testing.assert_array_equal(report.position, same.position)
    for side in ("left", "right"):
        np.testing.assert_array_equal(getattr(one.images, side), getattr(other.images, side))
    np.testing.assert_array_equal(one.points.positions, other.points.positions)
    np.testing.assert_array_equal(one.points.track_id, other.points.track_id)
    assert one.points.sd == other.points.sd


class Bag:
    """A robot's bag, message by message, to put wrong things into."""

    def __init__(self, path: Path, *, cameras: StereoCamera | None = None):
        self.output = McapOutput(path)
        if cameras is not None:
            self.output.message(LEFT_INFO, 0, calibration_message(cameras.left, "left"))
            self.output.message(RIGHT_INFO, 0, calibration_message(cameras.right, "right"))
            self.output.message(TF, 0, camera_transforms(cameras))

    def tool(self, time: int, state: ToolState | None = None) -> None:
        self.output.message(POSE, time, pose_message(time, state or tool()))
        self.output.json(GRASP, time, grasp_json(state or tool()), schema=GRASP_SCHEMA)

    def image(self, topic: str, time: int, pixels: np.ndarray) -> None:
        self.output.message(topic, time, image_message(time, pixels, "left" if topic == LEFT else "right"))

    def pair(self, time: int) -> None:
        self.image(LEFT, time, image(1))
        self.image(RIGHT, time, image(2))

    def points(self, time: int, **columns) -> None:
        self.output.message(POINTS, time, point_cloud(time, {axis: np.arange(3.0) for axis in "xyz"} | columns))


def read_all(path: Path, **settings) -> tuple[list[Observation], list[tuple[int, str]]]:
    recording = Recording.open(path, **settings)
    seen = list(recording)
    return seen, recording.skipped


def test_what_is_written_is_read_back_exactly(tmp_path):
    mesh = declared_mesh()
    declaration = Declaration(membrane_stiffness=1 / 3, gravity=(0.0, 0.1, 0.0), bed=False, mesh=mesh)
    recording = Recording.open(write(tmp_path / "run.mcap", observations(), declaration=declaration))
    seen = list(recording)
    assert len(seen) == len(recording) == 3 and recording.skipped == [] and recording.ignored == {}
    for one, other in zip(seen, observations(), strict=True):
        assert_same(one, other)
    assert replace(recording.declaration, mesh=None) == replace(declaration, mesh=None)
    for f in fields(DeclaredMesh):
        np.testing.assert_array_equal(getattr(recording.declaration.mesh, f.name), getattr(mesh, f.name))
    assert recording.metadata["seed"] == "3" and "version.jiggle-mj" in recording.metadata
    np.testing.assert_allclose(recording.camera.T_world_camera, camera().T_world_camera, rtol=0, atol=STATED)
    np.testing.assert_array_equal(recording.camera.right.P, camera().right.P)
    assert len(list(recording)) == 3, "a recording can be iterated again"


def test_a_pose_that_was_recorded_is_recorded_as_itself():
    """To the bit: of 1e-16 in where a camera stands, what is found from images makes micrometres."""
    for rotation in Rotation.random(2000, np.random.default_rng(0)):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rotation.as_matrix(), rotation.as_rotvec()
        once = as_recorded(T)
        np.testing.assert_allclose(once, T, rtol=0, atol=STATED)
        np.testing.assert_array_equal(parse_transform(frame_transform("world", "camera", once)), once)


def test_points_without_images_need_no_camera(tmp_path):
    cloud = replace(observations()[0], images=None)
    recording = Recording.open(write(tmp_path / "run.mcap", [cloud], camera=None))
    assert recording.camera is None
    (seen,) = recording
    assert seen.images is None
    np.testing.assert_array_equal(seen.points.positions, cloud.points.positions)
    with (
        RecordingWriter(tmp_path / "no.mcap", camera=None, declaration=Declaration(), metadata={}) as writer,
        pytest.raises(ValueError, match="give the camera"),
    ):
        writer.write(observations()[0])


def test_same_input_gives_same_bytes(tmp_path):
    digests = set()
    for name in ("a.mcap", "b.mcap"):
        path = write(tmp_path / name, observations(), declaration=Declaration(mesh=declared_mesh()))
        digests.add(hashlib.sha256(path.read_bytes()).hexdigest())
    assert len(digests) == 1


def test_a_distorted_pair_keeps_its_calibration_and_its_rectified_pose(tmp_path):
    """/tf carries the raw optical frame, T_world_raw = T_world_rectified R; reading takes R off again."""
    ideal = camera()
    turned = {
        side: replace(
            getattr(ideal, side),
            D=np.array([0.1, -0.02, 1e-3, 2e-3, 0.0]),
            R=Rotation.from_euler("xyz", [0.01, angle, 0.02]).as_matrix(),
        )
        for side, angle in (("left", 0.03), ("right", -0.04))
    }
    given = StereoCamera(**turned, T_world_camera=ideal.T_world_camera)
    read = Recording.open(write(tmp_path / "run.mcap", observations(1), camera=given)).camera
    np.testing.assert_allclose(read.T_world_camera, ideal.T_world_camera, rtol=0, atol=STATED)
    for side in ("left", "right"):
        for name in ("K", "P", "D", "R"):
            np.testing.assert_array_equal(getattr(getattr(read, side), name), getattr(turned[side], name))


def test_foxglove_fields_are_filled_and_the_file_is_sound(tmp_path):
    """mcap's own reader checks all sums, finds index and statistics, and decodes by the schemas in the file."""
    path = write(tmp_path / "run.mcap", observations())
    with open(path, "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary.statistics.message_count == 3 + 3 * 5 + 2 == sum(c[1] for c in counts(summary))
        assert len(summary.chunk_indexes) == 4 and len(summary.metadata_indexes) == 2
        assert {channel.topic for channel in summary.channels.values()} == {
            *(LEFT, RIGHT, LEFT_INFO, RIGHT_INFO, TF, POSE, GRASP, POINTS)
        }
        topics = [topic for topic in (LEFT, RIGHT, LEFT_INFO, RIGHT_INFO, TF, POSE, POINTS)]
        messages = {c.topic: (m, d) for _, c, m, d in reader.iter_decoded_messages(topics=topics)}
    for topic, (message, decoded) in messages.items():
        assert message.log_time == message.publish_time
        if topic != TF:
            stamp = decoded.timestamp.seconds * 10**9 + decoded.timestamp.nanos
            assert stamp == message.log_time
            side = "left" if "left" in topic else "right"
            assert decoded.frame_id == (f"camera_{side}_optical" if "camera" in topic else "world")
    calibration = messages[RIGHT_INFO][1]
    assert calibration.distortion_model == "plumb_bob" and calibration.P[3] == pytest.approx(-40 * 0.005)
    assert messages[LEFT][1].format == "png" and messages[LEFT][1].data[1:4] == b"PNG"
    cloud = messages[POINTS][1]
    assert cloud.pose.HasField("position"), "Rerun takes an absent position for a null one"
    assert cloud.point_stride * 5 == len(cloud.data) and cloud.pose.orientation.w == 1
    assert [f.name for f in cloud.fields] == ["x", "y", "z", "track_id", "sd"]
    transforms = messages[TF][1].transforms
    assert [(t.parent_frame_id, t.child_frame_id) for t in transforms] == [
        ("world", "camera_left_optical"),
        ("camera_left_optical", "camera_right_optical"),
    ]
    assert transforms[1].translation.x == pytest.approx(0.005)


def counts(summary) -> list[tuple[int, int]]:
    return list(summary.statistics.channel_message_counts.items())


def test_a_crash_loses_nothing_that_was_written(tmp_path):
    """The file as it stands after two writes, never closed, holds both; without leave it is refused."""
    path, crashed = tmp_path / "run.mcap", tmp_path / "crashed.mcap"
    with RecordingWriter(path, camera=camera(), declaration=Declaration(), metadata={}) as writer:
        for observation in observations(2):
            writer.write(observation)
        crashed.write_bytes(path.read_bytes())
    with pytest.raises(RecordingError, match="truncated"):
        Recording.open(crashed)
    seen, skipped = read_all(crashed, allow_truncated=True)
    assert len(seen) == 2 and skipped == []
    assert_same(seen[1], observations(2)[1])


def test_a_cut_file_is_refused_at_every_length_and_its_whole_moments_are_read(tmp_path):
    whole = write(tmp_path / "run.mcap", observations()).read_bytes()
    cut, found = tmp_path / "cut.mcap", set()
    for length in np.linspace(8, len(whole) - 1, 40).astype(int):
        cut.write_bytes(whole[:length])
        with pytest.raises(RecordingError, match="is truncated") as refusal:
            Recording.open(cut)
        assert "\n" not in str(refusal.value)
        try:
            seen, _ = read_all(cut, allow_truncated=True)
        except RecordingError as failure:
            assert "foreign" in str(failure) or "lacks" in str(failure)
            continue
        found.add(len(seen))
        for one, other in zip(seen, observations(), strict=False):
            assert_same(one, other)
    assert {1, 2, 3} <= found


def test_a_damaged_byte_is_noticed(tmp_path):
    data = bytearray(write(tmp_path / "run.mcap", observations()).read_bytes())
    data[len(data) // 2] ^= 0xFF
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    with pytest.raises(RecordingError, match="damaged before byte"):
        Recording.open(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [(None, "cannot be read: No such file"), (b"", "not an MCAP"), (b"PNG and so forth", "not an MCAP")],
)
def test_what_is_no_mcap_is_refused(tmp_path, content, message):
    path = tmp_path / "run.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RecordingError, match=message):
        Recording.open(path)


def test_a_foreign_file_is_refused_with_its_topics(tmp_path):
    with McapOutput(tmp_path / "robot.mcap") as output:
        output.json("/joint_states", 0, {}, schema={"title": "joints"})
    with pytest.raises(RecordingError, match=r"foreign: it needs /tool/pose.* its topics are: /joint_states\.$"):
        Recording.open(tmp_path / "robot.mcap")


def test_a_file_without_a_needed_topic_is_refused(tmp_path):
    bag = Bag(tmp_path / "no_tool.mcap")
    bag.points(0)
    bag.output.close()
    with pytest.raises(RecordingError, match="lacks /tool/pose and /tool/grasp"):
        Recording.open(bag.output.path)
    bag = Bag(tmp_path / "one_camera.mcap", cameras=camera())
    bag.tool(0)
    bag.image(LEFT, 0, image(0))
    bag.output.close()
    with pytest.raises(RecordingError, match="lacks /camera/right/image_raw"):
        Recording.open(bag.output.path)


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


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("{", "cannot be read"),
        ('{"youngs": 3.0}', "youngs"),
        ('{"poisson": 0.5}', r"poisson must be in \[0, 0\.5\)"),
    ],
)
def test_a_declaration_that_is_none_is_refused(tmp_path, text, complaint):
    with pytest.raises(RecordingError, match=complaint):
        Recording.open(declaring(tmp_path / "odd.mcap", text))


def test_a_declaration_keeps_the_defaults_of_what_it_leaves_out(tmp_path):
    recording = Recording.open(declaring(tmp_path / "short.mcap", '{"thickness": 0.002}'))
    assert recording.declaration == Declaration(thickness=2e-3)


def declaring(path: Path, text: str) -> Path:
    bag = Bag(path)
    bag.output.metadata(DECLARATION, {"json": text})
    bag.tool(0)
    bag.output.message(POINTS, 0, point_cloud(0, dict(zip("xyz", np.zeros((3, 4)), strict=True))))
    bag.output.close()
    return path


def test_a_declared_mesh_without_its_tracks_is_refused(tmp_path):
    bag = Bag(tmp_path / "odd.mcap")
    bag.output.metadata(DECLARATION, {"json": "{}"})
    bag.output.arrays(MESH, {"vertices": np.zeros((3, 3)), "faces": np.array([[0, 1, 2]])})
    bag.tool(0)
    bag.output.message(POINTS, 0, point_cloud(0, dict(zip("xyz", np.zeros((3, 4)), strict=True))))
    bag.output.close()
    with pytest.raises(RecordingError, match="must hold vertices, faces, track_id"):
        Recording.open(tmp_path / "odd.mcap")


def test_truth_is_refused(tmp_path):
    write_truth(tmp_path / "run.truth.mcap", truth())
    message = r"^run\.truth\.mcap holds /truth topics; the estimator reads observations only \(pass run\.mcap\)\.$"
    with pytest.raises(RecordingError, match=message):
        Recording.open(tmp_path / "run.truth.mcap")
    bag = Bag(tmp_path / "mixed.mcap", cameras=camera())
    bag.tool(0)
    bag.pair(0)
    bag.output.json("/truth/frame", 0, {}, schema={"title": "t"})
    bag.output.close()
    with pytest.raises(RecordingError, match="holds /truth topics"):
        Recording.open(bag.output.path)


def test_a_ros_schema_is_refused_by_name(tmp_path):
    path = tmp_path / "ros.mcap"
    with open(path, "wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("sensor_msgs/msg/Image", "ros2msg", b"")
        channel = writer.register_channel(LEFT, "cdr", schema)
        writer.add_message(channel, 0, b"", 0)
        writer.finish()
    with pytest.raises(RecordingError, match=r"is sensor_msgs/msg/Image \(cdr\); it must be foxglove.CompressedImage"):
        Recording.open(path)


def test_images_without_calibration_are_refused(tmp_path):
    bag = Bag(tmp_path / "run.mcap")
    bag.tool(0)
    bag.pair(0)
    bag.output.close()
    with pytest.raises(RecordingError, match="no calibration: it lacks /camera/left/camera_info and /camera/right"):
        Recording.open(bag.output.path)


def test_an_uncalibrated_camera_info_is_refused(tmp_path):
    bag = Bag(tmp_path / "run.mcap")
    message = calibration_message(camera().left, "left")
    message.K[0] = 0
    for topic in (LEFT_INFO, RIGHT_INFO):
        bag.output.message(topic, 0, message)
    bag.tool(0)
    bag.pair(0)
    bag.output.close()
    with pytest.raises(RecordingError, match=r"camera_info is not calibrated.* K\[0\] = 0"):
        Recording.open(bag.output.path)


def test_swapped_cameras_are_refused(tmp_path):
    bag = Bag(tmp_path / "run.mcap")
    bag.output.message(LEFT_INFO, 0, calibration_message(camera().right, "left"))
    bag.output.message(RIGHT_INFO, 0, calibration_message(camera().left, "right"))
    bag.output.message(TF, 0, camera_transforms(camera()))
    bag.tool(0)
    bag.pair(0)
    bag.output.close()
    with pytest.raises(RecordingError, match="swapped"):
        Recording.open(bag.output.path)


def test_cameras_of_two_sizes_are_refused(tmp_path):
    bag = Bag(tmp_path / "run.mcap")
    bag.output.message(LEFT_INFO, 0, calibration_message(camera().left, "left"))
    bag.output.message(RIGHT_INFO, 0, calibration_message(camera(width=30).right, "right"))
    bag.output.message(TF, 0, camera_transforms(camera()))
    bag.tool(0)
    bag.pair(0)
    bag.output.close()
    with pytest.raises(RecordingError, match="sizes differ"):
        Recording.open(bag.output.path)


def test_cameras_whose_rectified_intrinsics_differ_are_refused():
    good = camera()
    for row, column in ((0, 0), (0, 2), (1, 2)):
        P = good.right.P.copy()
        P[row, column] += 20
        with pytest.raises(RecordingError, match="rectified cameras differ"):
            StereoCamera(left=good.left, right=replace(good.right, P=P), T_world_camera=np.eye(4))


def test_the_noise_of_points_is_that_of_those_seen_and_must_be_one_positive_number(tmp_path):
    """The first point's is NaN; then none is stated above 0; then two differ."""
    xyz = dict(zip("xyz", np.random.default_rng(0).normal(size=(3, 4)), strict=True))
    bag = Bag(tmp_path / "noise.mcap")
    for number, sd in enumerate(([np.nan, 1e-3, 1e-3, 1e-3], [0.0] * 4, [1e-3, 2e-3, 1e-3, 1e-3])):
        bag.tool(number * MS)
        bag.output.message(POINTS, number * MS, point_cloud(number * MS, xyz | {"sd": np.array(sd)}))
    bag.output.close()
    recording = Recording.open(tmp_path / "noise.mcap")
    (kept,) = recording
    assert kept.points.sd == 1e-3
    (_, nothing), (_, two) = recording.skipped
    assert "sd is 0.0 m; it must be above 0" in nothing and "from 0.001 to 0.002" in two


def test_a_camera_that_moves_or_is_nowhere_is_refused(tmp_path):
    moved = replace(camera(), T_world_camera=np.eye(4))
    for name, message in (("moving", "moves on /tf"), ("nowhere", "does not lead from 'world'")):
        bag = Bag(tmp_path / f"{name}.mcap")
        bag.output.message(LEFT_INFO, 0, calibration_message(camera().left, "left"))
        bag.output.message(RIGHT_INFO, 0, calibration_message(camera().right, "right"))
        if name == "moving":
            bag.output.message(TF, 0, camera_transforms(camera()))
            bag.output.message(TF, 1, camera_transforms(moved))
        bag.tool(0)
        bag.pair(0)
        bag.output.close()
        with pytest.raises(RecordingError, match=message):
            Recording.open(bag.output.path)


def test_frames_that_fail_a_check_are_named_and_skipped(tmp_path):
    bag = Bag(tmp_path / "run.mcap", cameras=camera())
    times = iter(range(0, 2000 * MS, 100 * MS))
    expected = {}

    def moment(index: int, why: str | None) -> int:
        if why:
            expected[index] = why
        return next(times)

    time = moment(0, None)
    bag.tool(time)
    bag.pair(time)
    time = moment(1, "missing half of the stereo pair: /camera/right/image_raw")
    bag.tool(time)
    bag.image(LEFT, time, image(0))
    time = moment(2, "missing half of the stereo pair: /camera/left/image_raw")
    bag.tool(time)
    bag.image(RIGHT, time, image(0))
    time = moment(3, "NaN in the pose")
    bag.tool(time, replace(tool(), position=np.array([np.nan, 0, 0])))
    bag.pair(time)
    time = moment(4, "/camera/right/image_raw is 20x24 and its calibration 32x24")
    bag.tool(time)
    bag.image(LEFT, time, image(0))
    bag.image(RIGHT, time, image(0, width=20))
    time = moment(5, "/camera/left/image_raw cannot be decoded as png")
    bag.tool(time)
    broken = image_message(time, image(0), "left")
    broken.data = broken.data[:20]
    bag.output.message(LEFT, time, broken)
    bag.image(RIGHT, time, image(0))
    expected[6] = "time goes backwards, from 500000000 ns to 50000000 ns"
    bag.tool(50 * MS)
    bag.pair(50 * MS)
    time = moment(7, "not of unit length")
    bag.tool(time, replace(tool(), quat_wxyz=np.array([2.0, 0, 0, 0])))
    bag.pair(time)
    time = moment(8, None)
    bag.tool(time)
    bag.pair(time)
    bag.output.close()
    seen, skipped = read_all(bag.output.path)
    assert [observation.index for observation in seen] == [0, 8]
    assert [index for index, _ in skipped] == list(expected)
    for index, why in skipped:
        assert expected[index] in why and "\n" not in why


def test_stamps_within_the_tolerance_are_one_moment(tmp_path):
    """Right image 4 ms late, cloud 3 ms early, pose 2 ms late; times of a robot's clock start at 0 with the first."""
    start = 1_700_000_000 * 1000 * MS
    bag = Bag(tmp_path / "run.mcap", cameras=camera())
    for k in range(3):
        time = start + k * 100 * MS
        bag.points(time - 3 * MS, track_id=np.array([k, 1, 2], np.uint32))
        bag.image(LEFT, time, image(k))
        bag.tool(time + 2 * MS, tool(x=float(k)))
        bag.image(RIGHT, time + 4 * MS, image(10 + k))
    bag.output.close()
    seen, skipped = read_all(bag.output.path)
    assert skipped == [] and [observation.time for observation in seen] == [0, 100 * MS, 200 * MS]
    for k, observation in enumerate(seen):
        assert observation.tool.position[0] == k and observation.points.track_id[0] == k
        np.testing.assert_array_equal(observation.images.right, image(10 + k))
    seen, skipped = read_all(bag.output.path, tolerance_ns=1 * MS)
    assert seen == [] and len(skipped) == 6, "each left and each right image is half a pair"


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
    moments = group_moments(left=stamped[:2], right=stamped[2:], points=[], pose=[], grasp=[], tolerance=5 * MS)
    assert [moment.right for moment in moments] == [stamped[2], None]


def test_points_and_tool_in_another_frame_come_to_the_world(tmp_path):
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
    turned = Rotation.from_quat(seen.tool.quat_wxyz, scalar_first=True)
    stated = Rotation.from_quat(tool().quat_wxyz, scalar_first=True)
    assert (turned * stated.inv()).magnitude() == pytest.approx(np.pi / 2)


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
    """JPEG loses at most a few grey values of a flat image."""
    flat = np.full((24, 32, 3), (200, 80, 20), np.uint8)
    message = image_message(0, flat, "left")
    message.data, message.format = cv2.imencode(".jpg", flat[..., ::-1])[1].tobytes(), "jpeg"
    assert np.abs(decode_image(message).astype(int) - flat).max() <= 3


def test_a_cloud_without_z_is_skipped_by_name(tmp_path):
    bag = Bag(tmp_path / "run.mcap")
    bag.tool(0)
    bag.output.message(POINTS, 0, point_cloud(0, {"x": np.zeros(2), "y": np.zeros(2)}))
    bag.output.close()
    assert read_all(bag.output.path) == ([], [(0, "/tissue/points lacks the fields ['z']; it has ['x', 'y'].")])


def test_what_the_tool_said_while_a_frame_could_not_be_used_goes_to_the_next_one(tmp_path):
    bag = Bag(tmp_path / "run.mcap")
    for time, x in ((0, 0.0), (40, 1.0), (100, 2.0), (140, np.nan), (160, 3.0), (200, 4.0)):
        state = replace(tool(), position=np.array([x, 0.0, 0.0]))
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


def test_a_grasp_that_is_no_grasp_is_refused(tmp_path):
    bag = Bag(tmp_path / "run.mcap")
    bag.output.json(GRASP, 0, {"closed": 1}, schema=GRASP_SCHEMA)
    bag.output.close()
    with pytest.raises(RecordingError, match=r"must be JSON \{closed, grasp, radius\}, and held_tracks"):
        Recording.open(bag.output.path)


def test_an_existing_recording_is_not_overwritten_unasked(tmp_path):
    path = write(tmp_path / "run.mcap", observations(1))
    with pytest.raises(OutputError, match=r"run\.mcap exists"):
        write(path, observations(1))
    write(path, observations(2), overwrite=True)
    assert len(Recording.open(path)) == 2
    with pytest.raises(OutputError, match="cannot be written: No such file"):
        write(tmp_path / "no" / "run.mcap", observations(1))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux's device that is always full")
def test_a_full_disk_is_said_in_one_line():
    with pytest.raises(OutputError, match="/dev/full cannot be written on: No space left on device"):
        write(Path("/dev/full"), observations(3), overwrite=True)


def test_times_of_large_clocks_survive():
    """Timestamps are split into seconds and nanoseconds without rounding."""
    time = 1_700_000_000_123_456_789
    assert (timestamp(time).seconds, timestamp(time).nanos) == (1_700_000_000, 123_456_789)


def test_calibration_with_a_strange_number_of_coefficients_is_an_error():
    left = camera().left
    odd = CameraCalibration(width=32, height=24, K=left.K, P=left.P, D=np.zeros(3))
    with pytest.raises(ValueError, match="0, 4, 5 or 8 coefficients; got 3"):
        calibration_message(odd, "left")


def truth() -> Truth:
    generator = np.random.default_rng(0)
    frames = tuple(
        TruthFrame(
            index=index,
            time=index * 10,
            positions=generator.normal(size=(4, 3)),
            stiffness=np.array([0, np.inf, np.nan, 1 / 3]),
            tip=np.array([np.nan, index, 1 / 3]),
            load=np.array([0, 1 / 3, np.nan, 2.0]) if index else None,
        )
        for index in (0, 2, 5)
    )
    return Truth(
        rest=generator.normal(size=(4, 3)),
        faces=np.array([[0, 1, 2], [1, 3, 2]]),
        attached=np.array([False, True, True, True]),
        frames=frames,
        scene="arc",
        details={"disturbances": ["gravity"], "nested": {"k": 1.5}},
    )


def test_truth_is_read_back_exactly_and_in_the_same_bytes(tmp_path):
    given = truth()
    for name in ("a.mcap", "b.mcap"):
        write_truth(tmp_path / name, given)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    read = read_truth(tmp_path / "a.mcap")
    for name in ("rest", "faces", "attached"):
        np.testing.assert_array_equal(getattr(read, name), getattr(given, name))
        assert getattr(read, name).dtype == getattr(given, name).dtype
    assert read.scene == "arc" and read.details == json.loads(json.dumps(given.details))
    for one, other in zip(read.frames, given.frames, strict=True):
        for f in fields(TruthFrame):
            np.testing.assert_array_equal(getattr(one, f.name), getattr(other, f.name))


def test_a_crash_leaves_the_truth_so_far(tmp_path):
    given, crashed = truth(), tmp_path / "crashed.mcap"
    named = {name: getattr(given, name) for name in ("rest", "faces", "attached", "scene", "details")}
    with TruthWriter(tmp_path / "run.truth.mcap", **named) as writer:
        writer.write(given.frames[0])
        crashed.write_bytes((tmp_path / "run.truth.mcap").read_bytes())
    with pytest.raises(RecordingError, match="truncated"):
        read_truth(crashed)
    assert len(read_truth(crashed, allow_truncated=True).frames) == 1


def test_observations_are_no_truth(tmp_path):
    path = write(tmp_path / "run.mcap", observations(1))
    with pytest.raises(RecordingError, match="is not a truth file"):
        read_truth(path)


def test_the_documentation_names_every_topic():
    text = (Path(__file__).parents[3] / "docs" / "RECORDINGS.md").read_text()
    assert [topic for topic in (*SCHEMAS, GRASP) if f"`{topic}`" not in text] == []
