import pytest

from jiggle_mj.errors import RecordingError
from jiggle_mj.importing.bags.bag_file import BagTopic
from jiggle_mj.importing.bags.roles import choose_roles, is_rectified

IMAGE, PACKED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
INFO, POSE = "sensor_msgs/msg/CameraInfo", "geometry_msgs/msg/PoseStamped"
JOINTS, BOOL, CLOUD = "sensor_msgs/msg/JointState", "std_msgs/msg/Bool", "sensor_msgs/msg/PointCloud2"


def topics(**types: str) -> dict[str, BagTopic]:
    """Topics by name, with a slash for each double underscore."""
    named = {f"/{name.replace('__', '/')}": kind for name, kind in types.items()}
    return {name: BagTopic(name=name, type=kind, count=3, encoding="cdr") for name, kind in named.items()}


def guess(found: dict[str, BagTopic], **named: str) -> tuple[dict[str, str], dict]:
    chosen, unsure = choose_roles(found, named)
    return {role: choice.topic for role, choice in chosen.items()}, unsure


def test_a_da_vinci_bag_is_understood():
    found = topics(
        stereo__left__image_raw=IMAGE,
        stereo__left__camera_info=INFO,
        stereo__right__image_raw=IMAGE,
        stereo__right__camera_info=INFO,
        PSM1__measured_cp=POSE,
        PSM1__setpoint_cp=POSE,
        PSM1__jaw__measured_js=JOINTS,
        PSM1__jaw__setpoint_js=JOINTS,
        PSM1__measured_js=JOINTS,
    )
    chosen, unsure = guess(found)
    assert chosen == {
        "left": "/stereo/left/image_raw",
        "right": "/stereo/right/image_raw",
        "left_info": "/stereo/left/camera_info",
        "right_info": "/stereo/right/camera_info",
        "tool": "/PSM1/measured_cp",
        "gripper": "/PSM1/jaw/measured_js",
    }
    assert unsure == {}


def test_of_several_forms_of_one_camera_the_raw_image_is_taken():
    found = topics(
        cam__left__image_raw=IMAGE,
        cam__left__image_raw__compressed=PACKED,
        cam__left__image_rect_color=IMAGE,
        cam__right__image_raw__compressed=PACKED,
        cam__right__image_raw=IMAGE,
        cam__right__image_rect_color=IMAGE,
        cam__left__camera_info=INFO,
        cam__right__camera_info=INFO,
    )
    chosen, _ = guess(found)
    assert (chosen["left"], chosen["right"]) == ("/cam/left/image_raw", "/cam/right/image_raw")


def test_a_compressed_image_has_the_camera_info_of_its_namespace():
    found = topics(
        a__left__image_raw__compressed=PACKED,
        a__right__image_raw__compressed=PACKED,
        a__left__camera_info=INFO,
        a__right__camera_info=INFO,
        b__left__camera_info=INFO,
    )
    assert guess(found)[0]["left_info"] == "/a/left/camera_info"


def test_of_two_equal_candidates_neither_is_taken_unless_it_is_named():
    found = topics(PSM1__measured_cp=POSE, PSM2__measured_cp=POSE)
    chosen, unsure = guess(found)
    assert "tool" not in chosen and unsure["tool"] == ["/PSM1/measured_cp", "/PSM2/measured_cp"]
    assert guess(found, tool="/PSM2/measured_cp")[0]["tool"] == "/PSM2/measured_cp"
    assert guess(found, tool="tf:tip")[0]["tool"] == "tf:tip"


def test_an_empty_name_leaves_a_role_without_a_topic():
    assert "gripper" not in guess(topics(gripper=BOOL), gripper="")[0]


def test_clouds_are_not_guessed_beside_a_stereo_pair():
    found = topics(left__image=IMAGE, right__image=IMAGE, lidar__points=CLOUD)
    assert "points" not in guess(found)[0]
    assert guess(found, points="/lidar/points")[0]["points"] == "/lidar/points"
    assert guess(topics(tracks=CLOUD))[0]["points"] == "/tracks"


@pytest.mark.parametrize(
    ("name", "why"), [("/nothing", "no topic '/nothing' for left"), ("/tool", "must be sensor_msgs/msg/Image")]
)
def test_a_named_topic_that_does_not_fit_is_refused(name: str, why: str):
    with pytest.raises(RecordingError, match=why):
        guess(topics(tool=POSE), left=name)


def test_rectified_images_are_known_by_their_name():
    assert is_rectified("/left/image_rect_color") and is_rectified("/left/image_rect")
    assert not is_rectified("/left/image_raw") and not is_rectified("/direct/left")
