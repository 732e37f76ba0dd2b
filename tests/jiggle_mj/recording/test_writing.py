"""Recordings: what is written is read back, in the same bytes, and a crash loses nothing."""

import hashlib
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from scipy.spatial.transform import Rotation

from jiggle_mj.camera import CameraCalibration, StereoCamera, as_recorded
from jiggle_mj.errors import OutputError, RecordingError
from jiggle_mj.observation import (
    Declaration,
    DeclaredMesh,
)
from jiggle_mj.recording.output_files import partial_path
from jiggle_mj.recording.reader import Recording
from jiggle_mj.recording.schemas import (
    calibration_message,
    frame_transform,
    parse_transform,
    timestamp,
)
from jiggle_mj.recording.topics import GRASP, LEFT, LEFT_INFO, POINTS, POSE, RIGHT, RIGHT_INFO, SCHEMAS, TF
from jiggle_mj.recording.writer import RecordingWriter
from tests.support.recordings import (
    QUATERNION_ROUNDING,
    assert_same,
    camera,
    declared_mesh,
    observations,
    read_all,
    write,
)


def test_what_is_written_is_read_back_exactly(tmp_path):
    mesh = declared_mesh()
    declaration = Declaration(membrane_stiffness=1 / 3, gravity=(0.0, 0.1, 0.0), bed=False, mesh=mesh)
    recording = Recording.open(write(tmp_path / "run.mcap", observations(), declaration=declaration))
    seen = list(recording)
    assert len(seen) == len(recording) == 3 and recording.skipped == [] and recording.ignored == {}
    for actual, expected in zip(seen, observations(), strict=True):
        assert_same(actual, expected)
    assert replace(recording.declaration, mesh=None) == replace(declaration, mesh=None)
    for f in fields(DeclaredMesh):
        np.testing.assert_array_equal(getattr(recording.declaration.mesh, f.name), getattr(mesh, f.name))
    assert recording.metadata["seed"] == "3" and "version.jiggle-mj" in recording.metadata
    np.testing.assert_allclose(
        recording.camera.T_world_camera, camera().T_world_camera, rtol=0, atol=QUATERNION_ROUNDING
    )
    np.testing.assert_array_equal(recording.camera.right.P, camera().right.P)
    assert len(list(recording)) == 3, "a recording can be iterated again"


def test_a_pose_that_was_recorded_is_recorded_as_itself():
    """Bit by bit: a change of 1e-16 in the camera's pose can change what is found from images by micrometres."""
    for rotation in Rotation.random(2000, np.random.default_rng(0)):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rotation.as_matrix(), rotation.as_rotvec()
        once = as_recorded(T)
        np.testing.assert_allclose(once, T, rtol=0, atol=QUATERNION_ROUNDING)
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
    """/tf holds the pose of the raw optical frame, T_world_raw = T_world_rectified R; reading removes R."""
    ideal = camera()
    calibrations = {
        side: replace(
            getattr(ideal, side),
            D=np.array([0.1, -0.02, 1e-3, 2e-3, 0.0]),
            R=Rotation.from_euler("xyz", [0.01, angle, 0.02]).as_matrix(),
        )
        for side, angle in (("left", 0.03), ("right", -0.04))
    }
    given = StereoCamera(**calibrations, T_world_camera=ideal.T_world_camera)
    read = Recording.open(write(tmp_path / "run.mcap", observations(1), camera=given)).camera
    np.testing.assert_allclose(read.T_world_camera, ideal.T_world_camera, rtol=0, atol=QUATERNION_ROUNDING)
    for side in ("left", "right"):
        for name in ("K", "P", "D", "R"):
            np.testing.assert_array_equal(getattr(getattr(read, side), name), getattr(calibrations[side], name))


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
    """A file after two writes that was never closed holds both; without `allow_truncated` it is refused."""
    path, crashed = tmp_path / "run.mcap", tmp_path / "crashed.mcap"
    with RecordingWriter(path, camera=camera(), declaration=Declaration(), metadata={}) as writer:
        for observation in observations(2):
            writer.write(observation)
        crashed.write_bytes(partial_path(path).read_bytes())
    with pytest.raises(RecordingError, match="truncated"):
        Recording.open(crashed)
    seen, skipped = read_all(crashed, allow_truncated=True)
    assert len(seen) == 2 and skipped == []
    assert_same(seen[1], observations(2)[1])


def test_a_cut_file_is_refused_at_every_length_and_its_complete_frames_are_read(tmp_path):
    whole = write(tmp_path / "run.mcap", observations()).read_bytes()
    cut, numbers = tmp_path / "cut.mcap", set()
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
        numbers.add(len(seen))
        for actual, expected in zip(seen, observations(), strict=False):
            assert_same(actual, expected)
    assert {1, 2, 3} <= numbers


def test_an_existing_recording_is_not_overwritten_unasked(tmp_path):
    path = write(tmp_path / "run.mcap", observations(1))
    with pytest.raises(OutputError, match=r"run\.mcap exists"):
        write(path, observations(1))
    write(path, observations(2), overwrite=True)
    assert len(Recording.open(path)) == 2
    with pytest.raises(OutputError, match="cannot be written: No such file"):
        write(tmp_path / "no" / "run.mcap", observations(1))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux's device that is always full")
def test_a_full_disk_is_reported():
    with pytest.raises(OutputError, match="/dev/full cannot be written: No space left on device"):
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


def test_the_documentation_names_every_topic():
    text = (Path(__file__).parents[3] / "docs" / "RECORDINGS.md").read_text()
    assert [topic for topic in (*SCHEMAS, GRASP) if f"`{topic}`" not in text] == []
