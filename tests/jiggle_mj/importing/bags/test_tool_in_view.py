from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jiggle_mj.camera import StereoCamera
from tests.support.bag_imports import bag, cameras, imported, refused
from tests.support.robot_bags import STEP, RobotBag, small_camera, write_images


def tool_at(*position: float) -> Callable[[RobotBag], None]:
    def write(made: RobotBag) -> None:
        for index in range(4):
            made.pose("/tool/pose", index * STEP, position)
            made.write("/gripper/closed", index * STEP, "std_msgs/Bool", data=True)

    return write


def test_a_tip_that_no_camera_can_see_is_named(tmp_path: Path):
    """The camera is 0.1 m above the origin and looks down: a tip at 0.5 m is behind it, one at 400 m beside it."""
    (tmp_path / "beside").mkdir()
    summary, _ = imported(bag(tmp_path / "beside", cameras, write_images, tool_at(400.0, 0.0, 0.0)))
    assert any(note.startswith("WARNING: with closed jaws the tip is always far out of view") for note in summary.notes)
    why = refused(bag(tmp_path, cameras, write_images, tool_at(0.4, 0.0, 0.5)))
    assert "always behind the left camera" in why and "an optical one" in why


@pytest.mark.parametrize(("unit", "x"), [("mm", 20.0), ("cm", 2.0)])
def test_a_tip_in_another_unit_is_named_and_read_with_it(tmp_path: Path, unit: str, x: float):
    """In a base 10 mm below the world's origin: 20 mm beside it and 11 mm above, 1 mm above the world's."""
    below = np.eye(4)
    below[2, 3] = -0.01

    def tool(made: RobotBag) -> None:
        made.tf("/tf_static", 0, made.transform("world", "base", None, below))
        for index in range(4):
            made.pose(
                "/tool/pose", index * STEP, [x, 0.05 * index * x, 0.55 * x], header=made.header(index * STEP, "base")
            )
            made.write("/gripper/closed", index * STEP, "std_msgs/Bool", data=True)

    path = bag(tmp_path, cameras, write_images, tool)
    assert f'It is in view if its poses are in {unit}: give [tool] unit = "{unit}" in map.toml' in refused(path)
    _, recording = imported(path, tool_unit={"mm": 1e-3, "cm": 1e-2}[unit])
    np.testing.assert_allclose(next(iter(recording)).tool.position, [0.02, 0, 0.001], rtol=1e-12)


@pytest.mark.parametrize(("stated", "true"), [("mm", "m"), ("cm", "m"), ("m", "cm"), ("mm", "cm"), ("cm", "mm")])
def test_another_unit_is_tried_instead_of_the_one_that_map_toml_states(tmp_path: Path, stated: str, true: str):
    """In a base 0.3 m beside the view and 0.2 m above, behind the camera: the tip is back at the world's origin."""
    metres = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
    away = np.eye(4)
    away[:3, 3] = 0.3, 0.1, 0.2

    def tool(made: RobotBag) -> None:
        made.tf("/tf_static", 0, made.transform("world", "base", None, away))
        for index in range(4):
            tip = np.array([-0.3, 0.001 * index - 0.1, -0.199]) / metres[true]
            made.pose("/tool/pose", index * STEP, tip, header=made.header(index * STEP, "base"))
            made.write("/gripper/closed", index * STEP, "std_msgs/Bool", data=True)

    path = bag(tmp_path, cameras, write_images, tool)
    why = refused(path, tool_unit=metres[stated])
    assert f'It is in view if its poses are in {true}: give [tool] unit = "{true}"' in why
    assert why.count("its poses are in") == 1
    _, recording = imported(path, tool_unit=metres[true])
    np.testing.assert_allclose(next(iter(recording)).tool.position, [0, 0, 0.001], atol=1e-15)


READINGS = {
    "as the pose of the world in the camera": np.linalg.inv,
    "as OpenGL's": lambda T: T @ np.diag([1.0, -1.0, -1.0, 1.0]),
    # x forward is the optical z, y left is -x, z up is -y
    "as a robot's": lambda T: T @ np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]),
}


@pytest.mark.parametrize("reading", READINGS)
def test_what_else_the_pose_of_the_camera_may_be_is_named(tmp_path: Path, reading: str):
    """A camera at (0.3, 0, 0.1) that looks along x and down; the tip is 0.1 m before it."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("YZ", [130, 80], degrees=True).as_matrix()
    T[:3, 3] = 0.3, 0.0, 0.1

    def published(made: RobotBag) -> None:
        made.info("/left/camera_info", 0, small_camera().left)
        made.info("/right/camera_info", 0, small_camera().right)
        made.tf("/tf_static", 0, made.transform("world", "left_optical", None, READINGS[reading](T)))

    why = refused(bag(tmp_path, published, write_images, tool_at(*(T @ [0, 0, 0.1, 1])[:3])))
    assert f"It is in view if the camera's pose on /tf is read {reading}" in why and "; or " not in why


def test_a_tip_beside_the_image_is_no_reason_to_doubt(tmp_path: Path):
    """Half an image beside it, where a tool holds an edge."""
    summary, _ = imported(bag(tmp_path, cameras, write_images, tool_at(0.08, 0.0, 0.0)))
    assert not any("WARNING" in note for note in summary.notes)


def test_a_tip_far_from_what_both_cameras_show_is_named(tmp_path: Path):
    """They show a plane at 0.1 m; a tip in its direction at 0.5 m is five times as far, and no other unit fits."""
    camera, width, height, disparity = wide_camera(), 320, 240, 20
    noise = np.random.default_rng(3).normal(size=(height, width + disparity))
    blobs = np.clip(128 + 300 * cv2.GaussianBlur(noise, (0, 0), 2.0), 0, 255).astype(np.uint8)
    rgb = np.repeat(blobs[..., None], 3, axis=2)

    def write(depth: float) -> Callable[[RobotBag], None]:
        def images(made: RobotBag) -> None:
            made.cameras(camera)
            for index in range(4):
                made.image("/left/image_raw", index * STEP, "rgb8", rgb[:, :width])
                made.image("/right/image_raw", index * STEP, "rgb8", rgb[:, disparity:])
            tool_at(0.0, 0.0, depth)(made)

        return images

    for name in ("near", "far"):
        (tmp_path / name).mkdir()
    assert not any("WARNING" in note for note in imported(bag(tmp_path / "near", write(0.12)))[0].notes)
    summary, _ = imported(bag(tmp_path / "far", write(0.5)))
    assert any("what both cameras see is 0.1 to 0.1 m away" in note for note in summary.notes)


def wide_camera() -> StereoCamera:
    """A camera of 320x240 pixels at the origin; a disparity of 20 px is at 0.1 m."""
    return StereoCamera.rectified(width=320, height=240, focal=400.0, baseline=0.005, T_world_camera=np.eye(4))
