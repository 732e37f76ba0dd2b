from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg
from scipy.spatial.transform import Rotation

from jiggle_mj.errors import OutputError, RecordingError
from jiggle_mj.importing.bags.gripper import ClosedRule
from jiggle_mj.importing.bags.importer import import_bag
from jiggle_mj.importing.bags.settings import BagSettings, DepthSettings
from jiggle_mj.observation import Declaration
from jiggle_mj.recording.output_files import PartialFile
from tests.support.bag_imports import bag, cameras, imported, refused
from tests.support.robot_bags import (
    STEP,
    RobotBag,
    points_table,
    rotated,
    small_bag,
    small_camera,
    small_image,
    write_images,
    write_tool,
)

MS = 1_000_000


def clouds(made: RobotBag) -> None:
    for index in range(4):
        made.cloud("/tracks", index * STEP, points_table(shift=float(index)))


def test_late_right_images_are_paired_only_when_the_user_says_so(tmp_path: Path):
    path = small_bag(tmp_path / "bag", late=8 * MS)
    why = refused(path)
    assert "right minus left is 8 ms" in why and "--pairing-tolerance 9 pairs them" in why
    summary, recording = imported(path, pairing_tolerance_ms=9.0)
    assert len(list(recording)) == 4 and not recording.skipped
    assert any("right minus left 8 ms (from 8 to 8 ms)" in note for note in summary.notes)


def test_right_images_further_away_than_may_be_paired_get_no_advice_to_pair_them(tmp_path: Path):
    """One frame, 1.2 s late: no time from frame to frame bounds the tolerance."""
    assert "no tolerance pairs them" in refused(small_bag(tmp_path / "bag", n=1, late=1200 * MS))


def test_images_of_another_moment_are_never_paired(tmp_path: Path):
    """Right images 40 ms late at 100 ms a frame pair at 45 ms; 60 ms could reach the next frame."""
    path = small_bag(tmp_path / "bag", late=40 * MS)
    assert "could pair two moments; give less than 50" in refused(path, pairing_tolerance_ms=60.0)
    _, recording = imported(path, pairing_tolerance_ms=45.0)
    np.testing.assert_array_equal(list(recording)[1].images.right, small_image(3))


def test_a_missing_right_image_leaves_out_its_frame_alone(tmp_path: Path):
    def images(made: RobotBag) -> None:
        for index in range(5):
            made.image("/left/image_raw", index * STEP, "rgb8", small_image(2 * index))
            if index != 2:
                made.image("/right/image_raw", index * STEP, "rgb8", small_image(2 * index + 1))

    summary, recording = imported(bag(tmp_path, cameras, write_tool, images))
    assert [each.time for each in recording] == [0, STEP, 3 * STEP, 4 * STEP][: summary.n_frames]
    assert any("1 images without a partner" in note for note in summary.notes)


def test_one_camera_only_is_named(tmp_path: Path):
    def left(made: RobotBag) -> None:
        made.image("/left/image_raw", 0, "rgb8", small_image(0))

    assert "lacks a right image (--topic right=TOPIC" in refused(bag(tmp_path, cameras, write_tool, left))


@pytest.mark.parametrize(
    ("parts", "why"),
    [
        ((cameras, write_images), "the pose of the tool"),
        ((cameras, write_tool), "images of both cameras"),
        ((write_tool, write_images), "the left camera's CameraInfo"),
    ],
)
def test_what_is_missing_is_named_with_its_cure(tmp_path: Path, parts: tuple, why: str):
    message = refused(bag(tmp_path, *parts))
    assert why in message and "--topic" in message and "jiggle-mj inspect" in message


def test_a_joint_decides_by_the_stated_rule(tmp_path: Path):
    def jaw(made: RobotBag) -> None:
        for index in range(4):
            made.pose("/tool/pose", index * STEP, [0, 0, 0])
            made.joint("/jaw/measured_js", index * STEP, jaw=(0.8, 0.05, 0.9, -0.1)[index])

    path = bag(tmp_path, cameras, write_images, jaw)
    assert "--closed 'jaw<0.1'" in refused(path)
    summary, recording = imported(path, closed=ClosedRule.parse("jaw<0.1"))
    assert [(each.tool.closed, each.tool.grasp) for each in recording] == [(False, 0), (True, 1), (False, 1), (True, 2)]
    assert "gripper: closed where jaw.position < 0.1" in summary.notes


def shaken(move: Callable[[int], np.ndarray]) -> Callable[[RobotBag], None]:
    """Write both CameraInfo, and the camera's pose on /tf 40 times, each time times a motion in its own frame."""

    def write(made: RobotBag) -> None:
        made.info("/left/camera_info", 0, small_camera().left)
        made.info("/right/camera_info", 0, small_camera().right)
        for index in range(40):
            T = small_camera().T_world_camera @ move(index)
            made.tf("/tf", index * 10 * MS, made.transform("world", "left_optical", index * 10 * MS, T))

    return write


def moved(offset: np.ndarray, degrees: float = 0.0) -> np.ndarray:
    """A motion by an offset [m] and about y."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("y", degrees, degrees=True).as_matrix(), offset
    return T


@pytest.mark.parametrize(("sd", "says"), [(4e-6, False), (1e-4, True)])
def test_a_camera_that_trembles_stands_still_at_its_mean(tmp_path: Path, sd: float, says: bool):
    """Noise of 0.1 mm a coordinate is 0.17 mm rms and at times above 0.2 mm; the mean is within 5 sd / sqrt(40)."""
    noise = np.random.default_rng(7).normal(scale=sd, size=(40, 3))
    assert says == (np.linalg.norm(noise, axis=1).max() > 2e-4)
    path = bag(tmp_path, shaken(lambda index: moved(noise[index])), write_tool, write_images)
    summary, recording = imported(path)
    assert recording.camera is not None
    np.testing.assert_allclose(recording.camera.T_world_camera, small_camera().T_world_camera, atol=5 * sd / 40**0.5)
    assert says == any("trembles on /tf: at the tool's place it strays by 0.1" in note for note in summary.notes)


@pytest.mark.parametrize(("offset", "degrees", "says"), [(3e-3, 0.0, "3 mm rms"), (0.0, 0.25, "0.436 mm rms")])
def test_a_camera_that_moves_what_it_sees_at_the_tool_is_refused(
    tmp_path: Path, offset: float, degrees: float, says: str
):
    """To and fro; 0.25 degrees shift the tool, 0.1 m away, by 0.436 mm."""
    signs = [(-1) ** index for index in range(40)]
    to_and_fro = shaken(lambda index: moved(np.array([signs[index] * offset, 0, 0]), signs[index] * degrees))
    why = refused(bag(tmp_path, to_and_fro, write_tool, write_images))
    assert f"the camera moves on /tf (left_optical): at the tool's place it strays by {says}" in why


def test_quaternions_that_are_no_rotation_are_left_out_and_said(tmp_path: Path):
    """Quaternions of zeros in all poses of the tool mean that it has no orientation; elsewhere they mean nothing."""

    def tool(quats: list) -> Callable[[RobotBag], None]:
        def write(made: RobotBag) -> None:
            for index, quat in enumerate(quats):
                made.pose("/tool/pose", index * STEP, [1e-3 * index, 0, 0], quat)
                made.write("/gripper/closed", index * STEP, "std_msgs/Bool", data=True)

        return write

    def all_infos(made: RobotBag) -> None:
        made.info("/left/camera_info", 0, small_camera().left)
        made.info("/right/camera_info", 0, small_camera().right)

    def frames(*quats: tuple) -> Callable[[RobotBag], None]:
        def write(made: RobotBag) -> None:
            for index, (w, x, y, z) in enumerate(quats):
                sent = made.transform("world", "left_optical", index * STEP, small_camera().T_world_camera)
                sent.transform.rotation.w, sent.transform.rotation.x = w, x
                sent.transform.rotation.y, sent.transform.rotation.z = y, z
                made.tf("/tf", index * STEP, sent)

        return write

    zero, one, down, long = (0, 0, 0, 0), (1, 0, 0, 0), (0, 1, 0, 0), (2, 0, 0, 0)
    for name in ("none", "some", "tf", "long"):
        (tmp_path / name).mkdir()
    summary, recording = imported(bag(tmp_path / "none", cameras, write_images, tool([zero] * 4)))
    assert len(list(recording)) == 4 and any("no pose has an orientation" in note for note in summary.notes)
    summary, recording = imported(bag(tmp_path / "some", cameras, write_images, tool([one, zero, one, one])))
    assert any("1 poses are left out: /tool/pose: the rotation is not set" in note for note in summary.notes)
    summary, recording = imported(
        bag(tmp_path / "tf", all_infos, frames(zero, down, long, down), write_tool, write_images)
    )
    np.testing.assert_allclose(recording.camera.T_world_camera, small_camera().T_world_camera, atol=1e-9)
    assert any("/tf of 'left_optical': the rotation is not set" in note for note in summary.notes)
    why = refused(bag(tmp_path / "long", all_infos, frames(long), write_tool, write_images))
    assert "/tf of 'left_optical'" in why and "is not of unit length; so are all its messages" in why


def test_the_tool_may_be_a_frame_of_tf(tmp_path: Path):
    """On an arm that turns by 90 degrees in 200 ms, seen every 100 ms: interpolated between."""

    def arm(made: RobotBag) -> None:
        reach = np.eye(4)
        reach[0, 3] = 0.1
        made.tf("/tf_static", 0, made.transform("link", "tip", None, reach))
        for index in range(6):
            made.tf("/tf", index * 100 * MS, made.transform("world", "link", index * 100 * MS, rotated(45 * index)))

    path = bag(tmp_path, cameras, write_images, arm)
    _, recording = imported(path, topics={"tool": "tf:tip"}, closed=ClosedRule.parse("always"))
    expected = [[0.1 * np.cos(a), 0.1 * np.sin(a), 0] for a in np.radians([0, 45, 90, 135])]
    # Quaternions of 12 decimals, at 0.1 m
    np.testing.assert_allclose([each.tool.position for each in recording], expected, atol=1e-12)
    assert "tip" in refused_frame(path, "tf:nothing") or "nothing" in refused_frame(path, "tf:nothing")


def refused_frame(path: Path, tool: str) -> str:
    with pytest.raises(RecordingError) as failure:
        import_bag(path, path.parent / "x.mcap", BagSettings(topics={"tool": tool}, closed=ClosedRule.parse("always")))
    return str(failure.value)


def test_a_fast_tool_is_interpolated_and_all_its_reports_are_kept(tmp_path: Path):
    """Poses each 20 ms from 10 ms on: the frame at 0 has none, that at 100 ms is between those at 90 and 110 ms."""

    def fast(made: RobotBag) -> None:
        for time in range(10 * MS, 320 * MS, 20 * MS):
            made.pose("/tool/pose", time, [1e-9 * time, 0, 0])
        for index in range(4):
            made.write("/gripper/closed", index * STEP, "std_msgs/Bool", data=True)

    _, recording = imported(bag(tmp_path, cameras, write_images, fast))
    seen = list(recording)
    # A position of 0.1 to 0.3 m is 1e-9 times its time; the interpolation rounds to a few bits
    np.testing.assert_allclose([each.tool.position[0] for each in seen], [0.1, 0.2, 0.3], rtol=1e-14)
    assert [report.time for report in seen[0].reports] == [10 * MS + k * 20 * MS for k in range(5)]


def test_tracked_points_are_moved_to_the_world_at_their_own_time(tmp_path: Path):
    def moving(made: RobotBag) -> None:
        for index in range(4):
            time, T = index * STEP, np.eye(4)
            T[0, 3] = -float(index)
            made.tf("/tf", time, made.transform("world", "camera", time, T))
            made.cloud("/tracks", time, points_table(shift=float(index)), frame="camera")

    summary, recording = imported(bag(tmp_path, write_tool, moving), noise_sd=1e-4)
    for each in recording:
        np.testing.assert_allclose(each.points.positions[:, 0], np.arange(6), atol=1e-9)
        np.testing.assert_array_equal(each.points.track_id, np.arange(16, 10, -1) - 1)
        assert each.points.sd == 1e-4
    assert recording.camera is None and summary.n_frames == 4


def test_depth_images_become_clouds_without_identities(tmp_path: Path):
    def depth(made: RobotBag) -> None:
        made.info("/depth/camera_info", 0, small_camera().left)
        T = small_camera().T_world_camera
        made.tf("/tf_static", 0, made.transform("world", "right_optical", None, T))
        for index in range(4):
            made.image("/depth/image_raw", index * STEP, "16UC1", np.full((24, 32), 100, "<u2"))

    _, recording = imported(bag(tmp_path, write_tool, depth), depth=DepthSettings(spacing=1e-3))
    points = next(iter(recording)).points
    assert points.track_id is None
    np.testing.assert_allclose(points.positions[:, 2], 0.0, atol=1e-9)  # the camera looks down from 0.1 m


def test_time_that_goes_backwards_is_refused(tmp_path: Path):
    def late(made: RobotBag) -> None:
        for index, stamp in enumerate((0, 40, 2)):
            made.pose("/tool/pose", index * STEP, [0, 0, 0], header=made.header(stamp * STEP))

    assert "/tool/pose: time goes backwards by 3.8 s after message 2" in refused(
        bag(tmp_path, cameras, write_images, late, lambda made: made.write("/grip", 0, "std_msgs/Bool", data=True))
    )


def test_headers_without_stamps_go_by_receipt_and_that_is_said(tmp_path: Path):
    def unstamped(made: RobotBag) -> None:
        for index in range(4):
            header = made.header(None, "world")
            made.pose("/tool/pose", index * STEP, [1e-3 * index, 0, 0], header=header)
            made.write("/gripper/closed", index * STEP, "std_msgs/Bool", data=True)

    summary, recording = imported(bag(tmp_path, cameras, write_images, unstamped))
    assert any("/tool/pose: 4 of 4 messages have no stamp" in note for note in summary.notes)
    assert [each.tool.position[0] for each in recording] == [0, 1e-3, 2e-3, 3e-3]


def test_two_clocks_are_refused_and_receipt_joins_them(tmp_path: Path):
    """Images and poses by a clock that began at start-up; the gripper has the recorder's only."""

    def booted(made: RobotBag) -> None:
        shift = 1_000_000 * MS
        for index in range(4):
            time = index * STEP
            for number, side in enumerate(("left", "right")):
                header = made.header(time + shift, f"{side}_optical")
                made.image(f"/{side}/image_raw", time, "rgb8", small_image(2 * index + number), header=header)
            made.pose("/tool/pose", time, [0, 0, 0], header=made.header(time + shift))
            made.write("/gripper/closed", time, "std_msgs/Bool", data=True)

    path = bag(tmp_path, cameras, booted)
    assert "two clocks. Give --clock receive" in refused(path)
    assert len(imported(path, clock="receive")[1]) == 4


def test_clocks_that_do_not_overlap_are_refused_with_both_spans(tmp_path: Path):
    def elsewhere(made: RobotBag) -> None:
        for index in range(4):
            time = index * STEP
            made.pose("/tool/pose", time, [0, 0, 0], header=made.header(time - 10**15))
            made.joint("/gripper/js", time, jaw=0.0)

    why = refused(bag(tmp_path, cameras, write_images, elsewhere), closed=ClosedRule.parse("jaw<1"))
    assert "/tool/pose (1731800000.000 to" in why and "do not overlap in time" in why


def test_a_measured_force_is_turned_to_the_world(tmp_path: Path):
    """By a quarter turn about z, (x, y) becomes (-y, x); a force in a frame that /tf does not know is not used."""

    def force(made: RobotBag) -> None:
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
        made.tf("/tf_static", 0, made.transform("world", "sensor", 0, T))
        for index in range(7):
            made.wrench("/tool/wrench", index * STEP // 2, [index, 0, 0.5])

    _, recording = imported(bag(tmp_path, cameras, write_tool, write_images, force))
    forces = [each.force for each in recording]
    assert recording.ignored == {} and all(each is not None for each in forces)
    np.testing.assert_allclose(
        [each.on_tool for each in forces], [[0, 2 * k, 0.5] for k in range(len(forces))], atol=1e-9
    )


def test_forces_without_a_pose_of_their_frame_are_left_out_and_the_others_used(tmp_path: Path):
    """The sensor's frame moves, and its last pose is 0.45 s old in the first frame: too old in the third."""

    def force(made: RobotBag) -> None:
        for index in range(5):
            T, time = np.eye(4), (2 * index - 17) * STEP // 2
            T[0, 3] = 0.01 * index
            made.tf("/tf", time, made.transform("world", "sensor", time, T))
        for index in range(7):
            made.wrench("/tool/wrench", index * STEP // 2, [index, 0, 0.5])

    summary, recording = imported(bag(tmp_path, cameras, write_tool, write_images, force))
    assert [each.force is not None for each in recording] == [True, True, False, False]
    assert recording.why_no_force is None
    assert any("5 forces are not used" in note for note in summary.notes)


def test_forces_that_are_not_finite_are_counted_and_torques_are_not_needed(tmp_path: Path):
    def force(made: RobotBag) -> None:
        made.tf("/tf_static", 0, made.transform("world", "sensor", 0, np.eye(4)))
        for index in range(7):
            made.wrench("/tool/wrench", index * STEP // 2, [0, 0, np.nan if index == 0 else 0.5], [np.nan] * 3)

    summary, recording = imported(bag(tmp_path, cameras, write_tool, write_images, force))
    first, *others = [each.force for each in recording]
    assert first is None and all(each is not None for each in others)
    assert any("1 of 7 forces are not finite" in note for note in summary.notes)


def test_without_tf_the_camera_is_the_world_and_gravity_unknown(tmp_path: Path):
    def infos(made: RobotBag) -> None:
        made.info("/left/camera_info", 0, small_camera().left)
        made.info("/right/camera_info", 0, small_camera().right)

    def tool(made: RobotBag) -> None:
        for index in range(4):
            pose = made.header(index * STEP, "left_optical")
            made.pose("/tool/pose", index * STEP, [0, 0, 0.1], header=pose)
            made.write("/gripper/closed", index * STEP, "std_msgs/Bool", data=True)

    path = bag(tmp_path, infos, tool, write_images)
    summary, recording = imported(path)
    assert recording.declaration.gravity == (0, 0, 0) and not recording.declaration.bed
    assert any("gravity is left out" in note for note in summary.notes)
    declared = Declaration(membrane_stiffness=12.0)
    assert imported(path, declaration=declared)[1].declaration == declared


def test_images_of_another_size_than_the_calibration_are_refused(tmp_path: Path):
    def large(made: RobotBag) -> None:
        for side in ("left", "right"):
            made.image(f"/{side}/image_raw", 0, "rgb8", np.zeros((48, 64, 3), np.uint8))

    assert "/left/image_raw is 64x48 and its calibration 32x24" in refused(bag(tmp_path, cameras, write_tool, large))


def test_the_name_of_a_bool_is_taken_at_its_word(tmp_path: Path):
    def opened(made: RobotBag) -> None:
        for index in range(4):
            made.pose("/tool/pose", index * STEP, [0, 0, 0])
            made.write("/gripper/is_open", index * STEP, "std_msgs/Bool", data=index % 2 == 0)

    path = bag(tmp_path, cameras, write_images, opened)
    assert "give --closed 'data==false' if true means open" in refused(path)
    _, recording = imported(path, closed=ClosedRule.parse("data==false"))
    assert [each.tool.closed for each in recording] == [False, True, False, True]


def test_the_bag_itself_is_never_replaced(tmp_path: Path):
    path = small_bag(tmp_path / "bag") / "bag.mcap"
    before = path.read_bytes()
    for out in (path, path.parent / "run.mcap"):
        with pytest.raises(OutputError, match="is the bag, or lies in it"):
            import_bag(path.parent, out, overwrite=True) if out != path else import_bag(path, out, overwrite=True)
    assert path.read_bytes() == before


def test_what_is_assumed_is_said(tmp_path: Path):
    path = small_bag(tmp_path / "bag")
    assumed, recording = imported(path)
    assert any("radius of the grip: 2 mm is assumed" in note for note in assumed.notes)
    assert next(iter(recording)).tool.radius == 0.002
    given, recording = imported(path, grasp_radius=0.007)
    assert not any("assumed" in note for note in given.notes) and next(iter(recording)).tool.radius == 0.007


def test_a_type_that_a_bag_defines_anew_is_one_line(tmp_path: Path):
    """A std_msgs/Bool whose data is a list of texts, and a pose without a header."""

    def odd(made: RobotBag) -> None:
        made.store.fielddefs.pop("std_msgs/msg/Bool")
        made.store.register(get_types_from_msg("string[] data", "std_msgs/msg/Bool"))
        for index in range(4):
            made.pose("/tool/pose", index * STEP, [0, 0, 0])
            made.write("/gripper/closed", index * STEP, "std_msgs/Bool", data=["yes"])

    assert "cannot be read" in refused(bag(tmp_path, cameras, write_images, odd))


def test_an_import_keeps_no_older_truth_and_waits_for_no_other_writer(tmp_path):
    path, out = small_bag(tmp_path / "bag"), tmp_path / "run.mcap"
    (tmp_path / "run.truth.mcap").write_text("of another recording")
    with pytest.raises(OutputError, match=r"run\.truth\.mcap exists"):
        import_bag(path, out)
    writer = PartialFile(out, overwrite=True)
    with pytest.raises(OutputError, match="is being written by another process"):
        import_bag(path, out, overwrite=True)
    writer.discard()
    import_bag(path, out, overwrite=True)
    assert {each.name for each in tmp_path.iterdir()} == {"bag", "run.mcap"}
