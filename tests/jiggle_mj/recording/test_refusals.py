"""Files that are no recordings, or whose parts contradict each other, are refused with the reason."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from jiggle_mj.camera import StereoCamera
from jiggle_mj.errors import RecordingError
from jiggle_mj.observation import (
    Declaration,
)
from jiggle_mj.recording.declaration import DECLARATION, DECLARED_MESH
from jiggle_mj.recording.frames import camera_transforms
from jiggle_mj.recording.mcap_files import McapOutput
from jiggle_mj.recording.reader import Recording
from jiggle_mj.recording.schemas import (
    GRASP_SCHEMA,
    calibration_message,
    point_cloud,
)
from jiggle_mj.recording.topics import GRASP, LEFT, LEFT_INFO, POINTS, RIGHT_INFO, TF
from jiggle_mj.recording.truth import write_truth
from tests.support.recordings import Bag, camera, image, observations, truth, write


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


def test_measured_points_are_sent_to_import(tmp_path):
    (tmp_path / "tracks.npz").write_bytes(b"PK")
    for path in (tmp_path, tmp_path / "tracks.npz"):
        with pytest.raises(RecordingError, match=r"'jiggle-mj import .* --out run\.mcap'"):
            Recording.open(path)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("{", "is not JSON"),
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
    bag.output.arrays(DECLARED_MESH, {"vertices": np.zeros((3, 3)), "faces": np.array([[0, 1, 2]])})
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
    with pytest.raises(RecordingError, match=r"is a robot.s bag; import it first: jiggle-mj import"):
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


def test_a_grasp_that_is_no_grasp_is_refused(tmp_path):
    bag = Bag(tmp_path / "run.mcap")
    bag.output.json(GRASP, 0, {"closed": 1}, schema=GRASP_SCHEMA)
    bag.output.close()
    with pytest.raises(RecordingError, match=r"must be JSON \{closed, grasp, radius\}, and held_tracks"):
        Recording.open(bag.output.path)


def test_what_an_error_quotes_stays_on_its_line():
    """A file may name an encoding with a line break, or with a terminal's escape."""
    assert str(RecordingError("a.mcap: (protobu\n\x1b[2J) for 5 µm")) == "a.mcap: (protobu  [2J) for 5 µm"
