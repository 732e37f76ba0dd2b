"""Held particles move and rotate with the tool, and jaws that close beside the tissue are refused."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jiggle_mj.errors import PerceptionError
from jiggle_mj.estimator.grip import GripHold
from jiggle_mj.observation import ToolState

ROUNDING = 1e-15
"""Rounding of positions of centimetres [m]."""
POINTS = np.array([[0.0, 0.0, 0.0], [1e-3, 0.0, 0.0], [0.02, 0.0, 0.0]])


def tool(*, position=(0.0, 0.0, 1e-3), rotvec=(0.0, 0.0, 0.0)) -> ToolState:
    quat_wxyz = Rotation.from_rotvec(rotvec).as_quat(scalar_first=True)
    return ToolState(position=np.array(position), quat_wxyz=quat_wxyz, closed=True, grasp=1, radius=3e-3)


def test_what_is_within_reach_is_held_and_follows_the_tool():
    hold = GripHold.close(tool(rotvec=(0.3, 0.0, 0.0)), POINTS, None)
    np.testing.assert_array_equal(hold.held, [True, True, False])
    moved = hold.expected(tool(position=(0.0, 0.01, 0.0), rotvec=(0.3, 0.0, 0.0)))
    np.testing.assert_allclose(moved, POINTS + np.array([0.0, 0.01, -1e-3]), atol=ROUNDING)


def test_held_particles_rotate_about_the_tip_as_the_tool_has_since_the_jaws_closed():
    before = Rotation.from_rotvec([0.0, 0.0, np.pi / 2])
    after = Rotation.from_rotvec([0.0, np.pi / 2, 0.0]) * before
    hold = GripHold.close(tool(rotvec=before.as_rotvec()), POINTS, None)
    rotated = hold.rotated(tool(rotvec=after.as_rotvec()))
    # About y, x goes to -z, and the tip is 1 mm above.
    np.testing.assert_allclose(rotated[1], [-1e-3, 0.0, 0.0], atol=ROUNDING)


def test_jaws_that_close_on_nothing_are_refused():
    with pytest.raises(PerceptionError, match=r"grasp 1 is off the tissue.*9\.0 mm from the nearest"):
        GripHold.close(tool(position=(0.0, 0.0, 9e-3)), POINTS, None)
