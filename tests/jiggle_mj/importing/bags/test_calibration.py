from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jiggle_mj.errors import RecordingError
from jiggle_mj.importing.bags.calibration import parse_camera_info, read_camera_file, stereo_camera
from tests.support.robot_bags import small_camera

ROUNDING = 1e-12
"""Relative rounding of a few products."""


def info(*, tx: float = 0.0, **changes) -> SimpleNamespace:
    """A CameraInfo of 320x240 pixels with fx 250 and P[0,3] = tx."""
    K = [250.0, 0, 159.5, 0, 250, 119.5, 0, 0, 1]
    P = [250.0, 0, 159.5, tx, 0, 250, 119.5, 0, 0, 0, 1, 0]
    values = {"width": 320, "height": 240, "distortion_model": "plumb_bob", "d": np.zeros(5), "k": np.array(K)}
    values |= {"r": np.eye(3).ravel(), "p": np.array(P)}
    return SimpleNamespace(**(values | changes))


def camera(left: SimpleNamespace, right: SimpleNamespace, *, right_at=None, rectified: bool = False):
    T = None
    if right_at is not None:
        T = np.eye(4)
        T[:3, 3] = right_at
    sources = [parse_camera_info(each, f"/{side}", side) for each, side in ((left, "left"), (right, "right"))]
    return stereo_camera(*sources, T_world_left=np.eye(4), T_left_right=T, rectified=rectified)


def test_the_usual_pair_is_kept_bit_by_bit():
    found, unsure, notes = camera(info(), info(tx=-1.25))
    assert found.right.P[0, 3] == -1.25 and found.baseline == 0.005 and not unsure and not notes


def test_the_right_camera_may_be_the_reference():
    """P_left[0,3] = fx b and P_right[0,3] = 0: the left camera at -b in the right one's frame."""
    found, unsure, _ = camera(info(tx=1.25), info())
    assert found.baseline == 0.005 and found.left.P[0, 3] == 0 and not unsure


def test_a_positive_tx_is_settled_by_tf_or_left_to_the_images():
    found, unsure, notes = camera(info(), info(tx=1.25), right_at=[0.005, 0, 0])
    assert found.baseline == 0.005 and not unsure and "other sign" in notes[0]
    assert camera(info(), info(tx=1.25))[1]


def test_swapped_topics_are_refused():
    with pytest.raises(RecordingError, match="swapped"):
        camera(info(), info(tx=-1.25), right_at=[-0.005, 0, 0])


@pytest.mark.parametrize("P", (np.zeros(12), np.array([250.0, 0, 159.5, 0, 0, 250, 119.5, 0, 0, 0, 1, 0])))
def test_without_a_baseline_the_pair_is_rectified_by_tf(P: np.ndarray):
    """A zero P, or those of two single cameras: a point seen by both raw cameras has the disparity of its depth."""
    found, _, notes = camera(info(p=P), info(p=P), right_at=[0.005, 0.0002, 0.0])
    assert found.baseline == pytest.approx(np.hypot(0.005, 0.0002), rel=1e-9)  # OpenCV's own iterations
    assert "from /tf" in notes[0]
    point = np.array([0.01, -0.02, 0.2])
    rows = []
    for each, centre in ((found.left, [0, 0, 0]), (found.right, [0.005, 0.0002, 0.0])):
        seen = each.P[:, :3] @ each.R @ (point - centre)
        rows.append(seen[:2] / seen[2])
    depth = (found.left.R @ point)[2]
    assert rows[0][1] == pytest.approx(rows[1][1], abs=1e-6)
    assert rows[0][0] - rows[1][0] == pytest.approx(found.focal[0] * found.baseline / depth, rel=1e-6)
    with pytest.raises(RecordingError, match="give no baseline"):
        camera(info(p=P), info(p=P))


def test_rectified_images_go_by_p_and_keep_the_pose_of_the_rectified_camera():
    R = Rotation.from_euler("y", 2, degrees=True).as_matrix()
    turned = info(r=R.ravel(), d=np.array([0.1, 0, 0, 0, 0]))
    right = info(tx=-1.25, r=R.ravel())
    raw, rectified = (camera(turned, right, rectified=flag)[0] for flag in (False, True))
    assert rectified.left.rectified and rectified.right.rectified and not raw.left.rectified
    np.testing.assert_allclose(rectified.T_world_camera, raw.T_world_camera, rtol=ROUNDING)
    np.testing.assert_allclose(raw.T_world_camera[:3, :3], R.T, rtol=ROUNDING)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"distortion_model": "equidistant", "d": np.full(4, 0.1)}, "model 'equidistant'; plumb_bob"),
        ({"k": np.zeros(9)}, "not calibrated"),
        ({"d": np.array([np.nan, 0, 0, 0, 0])}, "not finite"),
        ({"d": np.full(14, 0.1)}, "14 distortion coefficients"),
        ({"binning_x": 2}, "binned"),
        ({"roi": SimpleNamespace(x_offset=8, y_offset=0)}, "a part of one"),
        ({"k": np.ones(4)}, "must have 9, 9, 12"),
    ],
)
def test_a_calibration_that_is_not_read_is_named(changes: dict, why: str):
    with pytest.raises(RecordingError, match=why):
        parse_camera_info(info(**changes), "/left/camera_info", "left")


@pytest.mark.parametrize("n", (0, 4, 5, 8, 12, 14))
def test_coefficients_of_zero_are_no_distortion_whatever_the_model(n: int):
    """RealSense and Kinect drivers name models that are not read, with zeros."""
    found = parse_camera_info(info(d=np.zeros(n), distortion_model="inverse_brown"), "/left", "left")
    assert found.calibration.rectified


def test_ros_1_names_the_matrices_in_capitals():
    upper = SimpleNamespace(**{name.upper() if len(name) == 1 else name: v for name, v in vars(info()).items()})
    assert parse_camera_info(upper, "/left", "left").calibration.K[0, 0] == 250


def test_millimetres_are_named():
    with pytest.raises(RecordingError, match=r"baseline is 5 m.*millimetres"):
        camera(info(), info(tx=-1250.0))


def test_the_yaml_of_camera_calibration_is_read(tmp_path: Path):
    text = "image_width: 320\nimage_height: 240\ncamera_name: left\ndistortion_model: rational_polynomial\n"
    for name, (rows, columns), numbers in (
        ("camera_matrix", (3, 3), [250.0, 0, 159.5, 0, 250, 119.5, 0, 0, 1]),
        ("distortion_coefficients", (1, 8), [0.1, 0, 0, 0, 0, 0, 0, 0.2]),
        ("rectification_matrix", (3, 3), np.eye(3).ravel().tolist()),
        ("projection_matrix", (3, 4), [250.0, 0, 159.5, -1.25, 0, 250, 119.5, 0, 0, 0, 1, 0]),
    ):
        text += f"{name}:\n  rows: {rows}\n  cols: {columns}\n  data: {numbers}\n"
    (tmp_path / "right.yaml").write_text(text)
    found = read_camera_file(tmp_path / "right.yaml", "right").calibration
    assert (found.width, found.P[0, 3], found.D[0], found.D[7]) == (320, -1.25, 0.1, 0.2)
    (tmp_path / "bad.yaml").write_text("image_width: [")
    for name in ("bad.yaml", "none.yaml"):
        with pytest.raises(RecordingError, match="not a calibration file"):
            read_camera_file(tmp_path / name, "right")


def test_the_small_camera_projects_as_opencv_does():
    """The support's own camera: K and P agree with OpenCV's projection."""
    camera = small_camera()
    point = np.array([[0.01, 0.005, 0.02]])
    T = np.linalg.inv(camera.T_world_camera)
    seen, _ = cv2.projectPoints(point, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], camera.left.K, None)
    np.testing.assert_allclose(camera.project(point)[0, :2], seen.ravel(), rtol=1e-9)
