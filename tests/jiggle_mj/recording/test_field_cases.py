"""Recordings as robots make them: static transforms, cameras that stamp apart, wrong units, a stamp that leaps."""

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms

from jiggle_mj.cli.options import in_ns
from jiggle_mj.errors import OptionError, RecordingError
from jiggle_mj.recording.frames import camera_transforms
from jiggle_mj.recording.reader import Recording
from jiggle_mj.recording.schemas import calibration_message
from jiggle_mj.recording.topics import LEFT, LEFT_INFO, RIGHT, RIGHT_INFO, TF_STATIC
from tests.support.recordings import MS, Bag, camera, image, read_all


@pytest.mark.parametrize("single", [False, True])
def test_static_transforms_have_a_topic_of_their_own(tmp_path, single):
    """Both as FrameTransforms and as one FrameTransform a message."""
    bag = Bag(tmp_path / "run.mcap")
    bag.output.message(LEFT_INFO, 0, calibration_message(camera().left, "left"))
    bag.output.message(RIGHT_INFO, 0, calibration_message(camera().right, "right"))
    transforms = camera_transforms(camera())
    for message in transforms.transforms if single else [FrameTransforms(transforms=transforms.transforms)]:
        bag.output.message(TF_STATIC, 0, message)
    bag.tool(0)
    bag.pair(0)
    bag.output.close()
    opened = Recording.open(bag.output.path).camera
    assert opened is not None
    np.testing.assert_allclose(opened.T_world_camera, camera().T_world_camera, atol=1e-9)


def late_right_images(path, late: int, period: int = 100 * MS):
    bag = Bag(path, cameras=camera())
    for k in range(5):
        bag.image(LEFT, k * period, image(k))
        bag.tool(k * period)
        bag.image(RIGHT, k * period + late, image(10 + k))
    bag.output.close()
    return bag.output.path


def test_right_images_that_come_late_are_measured_and_can_be_paired(tmp_path):
    path = late_right_images(tmp_path / "late.mcap", 8 * MS)
    with pytest.raises(RecordingError, match=r"no pair within 5 ms: .* comes 8 ms later .*--pairing-tolerance 9 "):
        Recording.open(path)
    seen, skipped = read_all(path, tolerance_ns=in_ns(9))
    assert len(seen) == 5 and skipped == []
    np.testing.assert_array_equal(seen[2].images.right, image(12))
    with pytest.raises(OptionError, match="from 0 to 1000 milliseconds"):
        in_ns(-1)


@pytest.mark.parametrize(("late", "period"), [(3600_000, 100), (1200, 5000)])
def test_right_images_further_away_than_may_be_paired_get_no_advice_to_pair_them(tmp_path, late: int, period: int):
    """By an hour, or by 1.2 s of 5 s from frame to frame, where at most 1 s may be allowed; in ms."""
    path = late_right_images(tmp_path / "clock.mcap", late * MS, period * MS)
    with pytest.raises(RecordingError, match="are the two stamps of one clock") as refused:
        Recording.open(path)
    assert "--pairing-tolerance" not in str(refused.value)


def test_a_cloud_in_millimetres_is_named(tmp_path):
    bag = Bag(tmp_path / "mm.mcap")
    for k in range(2):
        bag.tool(k * MS)
        bag.points(k * MS, x=np.array([0.0, 30.0, 60.0]))
    bag.output.close()
    seen, skipped = read_all(bag.output.path)
    assert seen == [] and "spans 60 m" in skipped[0][1] and "millimetres? then it spans 0.06 m" in skipped[0][1]


def test_a_baseline_in_millimetres_is_named():
    with pytest.raises(RecordingError, match=r"baseline is 5 m .*millimetres\? then it is 0\.005 m"):
        camera(baseline=5.0)


def test_one_wrong_stamp_costs_one_frame(tmp_path):
    bag = Bag(tmp_path / "leap.mcap")
    for k in range(6):
        time = 10**18 if k == 2 else k * 100 * MS
        bag.tool(time)
        bag.points(time)
    bag.output.close()
    seen, skipped = read_all(bag.output.path)
    assert [observation.index for observation in seen] == [0, 1, 3, 4, 5]
    assert [index for index, _ in skipped] == [2] and "leaps to 1000000000000000000 ns" in skipped[0][1]


def test_a_time_that_no_clock_shows_is_refused(tmp_path):
    bag = Bag(tmp_path / "run.mcap")
    with pytest.raises(ValueError, match=r"/tissue/points has the time -1 ns"):
        bag.points(-1)
    bag.output.close()
