from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jiggle_mj.errors import RecordingError
from jiggle_mj.importing.bags.transforms import TransformTree

MS = 1_000_000
ROUNDING = 1e-12
"""Rounding of a few rotations."""


def transform(parent: str, child: str, xyz=(0, 0, 0), degrees: float = 0.0) -> SimpleNamespace:
    """A TransformStamped that is shifted, and rotated about z."""
    half = np.radians(degrees) / 2
    return SimpleNamespace(
        header=SimpleNamespace(frame_id=parent),
        child_frame_id=child,
        transform=SimpleNamespace(
            translation=SimpleNamespace(x=xyz[0], y=xyz[1], z=xyz[2]),
            rotation=SimpleNamespace(w=np.cos(half), x=0.0, y=0.0, z=np.sin(half)),
        ),
    )


def tree(*samples: tuple[int, SimpleNamespace]) -> TransformTree:
    made = TransformTree()
    for time, sample in samples:
        made.add(sample, time)
    return made


def test_a_chain_of_frames_is_multiplied_from_the_world_down():
    made = tree((0, transform("arm", "tip", (1, 0, 0))), (0, transform("/world", "/arm", (0, 0, 2), 90)))
    np.testing.assert_allclose(made.T_world("tip", "world", 0, "x")[:3, 3], [0, 1, 2], atol=ROUNDING)
    assert made.root("tip") == "world"


def test_a_moving_frame_is_interpolated():
    made = tree((0, transform("world", "tip")), (100 * MS, transform("world", "tip", (1, 0, 0), 90)))
    T = made.T_world("tip", "world", 25 * MS, "x")
    np.testing.assert_allclose(T[:3, 3], [0.25, 0, 0], atol=ROUNDING)
    angle = Rotation.from_matrix(T[:3, :3]).magnitude()
    assert angle == pytest.approx(np.radians(22.5), abs=ROUNDING)
    with pytest.raises(RecordingError, match="no pose of the moving frame 'tip' around"):
        made.T_world("tip", "world", 2_000 * MS, "x")


def test_a_frame_that_trembles_stands_still_at_its_mean():
    """Micrometres of noise, seed 0, 200 messages: no time is too far from one."""
    generator = np.random.default_rng(0)
    made = tree(*((k * MS, transform("world", "camera", 3e-6 * generator.normal(size=3))) for k in range(200)))
    assert made.moving("camera", "world") == []
    T = made.T_world("camera", "world", 10**12, "x")
    assert np.abs(T[:3, 3]).max() < 1e-6  # 4 standard errors of the mean


def test_a_frame_that_moves_is_named_with_how_far():
    made = tree((0, transform("world", "camera")), (MS, transform("world", "camera", (0.01, 0, 0), 2.0)))
    [(name, motion)] = made.moving("camera", "world")
    assert name == "camera" and motion.distance == pytest.approx(0.005) and motion.angle == pytest.approx(np.radians(1))


def test_equal_messages_give_their_pose_bit_by_bit():
    given = transform("world", "camera", (1 / 3, 0.1, 0.7), 33)
    one, many = tree((0, given)), tree(*((k, given) for k in range(7)))
    np.testing.assert_array_equal(one.T_world("camera", "world", 0, "x"), many.T_world("camera", "world", 0, "x"))


def test_frames_that_are_not_joined_are_named():
    made = tree((0, transform("base", "tip")))
    with pytest.raises(
        RecordingError, match="/points is in the frame 'tip', and /tf does not lead from there to 'world'"
    ):
        made.T_world("tip", "world", 0, "/points")


def test_a_circle_and_two_parents_are_refused():
    with pytest.raises(RecordingError, match="circle"):
        tree((0, transform("a", "b")), (0, transform("b", "a"))).root("a")
    with pytest.raises(RecordingError, match="two parents, 'a' and 'c'"):
        tree((0, transform("a", "b")), (0, transform("c", "b")))


def test_a_transform_that_is_none_is_left_out_and_a_frame_without_others_refused():
    none, good = transform("world", "tip", (np.nan, 0, 0)), transform("world", "tip", (1, 0, 0))
    made = tree((0, none), (5, good))
    np.testing.assert_array_equal(made.T_world("tip", "world", 5, "/points")[:3, 3], [1, 0, 0])
    (said,) = made.left_out()
    assert said.startswith("/tf of 'tip': NaN") and said.endswith("; 1 such messages are left out")
    with pytest.raises(RecordingError, match=r"/tf of 'tip': NaN.*so are all its messages"):
        tree((0, none)).T_world("tip", "world", 0, "/points")
