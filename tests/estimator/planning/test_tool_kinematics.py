"""The tool's kinematics through MJX against MuJoCo's own."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from jiggle_mj.errors import OptionError
from jiggle_mj.estimator.planning.tool_kinematics import ToolKinematics, clearances
from jiggle_mj.scenes.tissue.model import TWEEZER

OPEN = 0.35
"""Angle of each open jaw, the upper limit of its hinge's range in the tweezer's MJCF [rad]."""
ROUNDING = 1e-9
"""Difference of two float64 kinematics that do the same in another order [m, or per unit of the quaternion]."""
DIFFERENCE, DIFFERENCE_ERROR = 1e-6, 1e-7
"""Step of finite differences, and their error by rounding and curvature [m per unit of the quaternion]."""


@pytest.fixture(scope="module")
def tweezer() -> ToolKinematics:
    return ToolKinematics.read(TWEEZER.read_text())


def lowest(tip: np.ndarray, quat: np.ndarray) -> float:
    """Return the height of the tool's lowest point [m], by MuJoCo and points on each capsule's axis."""
    model = mujoco.MjModel.from_xml_path(str(TWEEZER))
    data, heights = mujoco.MjData(model), []
    data.mocap_pos[0], data.mocap_quat[0] = tip, quat
    along = np.linspace(-1, 1, 3)
    for angle in (0.0, OPEN):
        data.qpos[:] = angle
        mujoco.mj_kinematics(model, data)
        for (radius, half, _), centre, rotation in zip(model.geom_size, data.geom_xpos, data.geom_xmat, strict=True):
            axis = rotation.reshape(3, 3)[:, 2]
            heights.append((centre + half * along[:, None] * axis)[:, 2].min() - radius)
    return min(heights)


def poses(count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    quats = rng.normal(size=(count, 4))
    return rng.uniform(-0.1, 0.1, (count, 3)), quats / np.linalg.norm(quats, axis=1)[:, None]


def test_clearance_is_that_of_mujoco_in_any_pose(tweezer):
    with jax.enable_x64(True):
        for tip, quat in zip(*poses(20), strict=True):
            found = clearances(tweezer, jnp.asarray(tip)[None], jnp.asarray(quat))
            assert float(found[0]) == pytest.approx(lowest(tip, quat), abs=ROUNDING)


def test_upright_the_tip_is_the_lowest_point(tweezer):
    with jax.enable_x64(True):
        tips = jnp.asarray([[0.0, 0.0, 0.0], [0.01, -0.02, 0.03]])
        np.testing.assert_allclose(clearances(tweezer, tips, jnp.asarray([1.0, 0, 0, 0])), tips[:, 2], atol=ROUNDING)


def test_clearance_is_differentiable_in_tip_and_orientation(tweezer):
    with jax.enable_x64(True):
        height = jax.jit(lambda tip, quat: tweezer.clearance(tip, quat))
        gradient = jax.jit(jax.grad(height, argnums=(0, 1)))
        for tip, quat in zip(*map(jnp.asarray, poses(3)), strict=True):
            by_tip, by_quat = gradient(tip, quat)
            np.testing.assert_allclose(by_tip, [0, 0, 1], atol=ROUNDING)
            for k in range(4):
                up, down = (float(height(tip, quat.at[k].add(step))) for step in (DIFFERENCE, -DIFFERENCE))
                assert float(by_quat[k]) == pytest.approx((up - down) / (2 * DIFFERENCE), abs=DIFFERENCE_ERROR)


@pytest.mark.parametrize(
    ("mjcf", "says"),
    [
        ("<mujoco", "does not compile"),
        ("<mujoco><worldbody><geom size='.1'/></worldbody></mujoco>", "got 0 mocap bodies"),
        ("<mujoco><worldbody><body mocap='true'><geom type='box' size='1 1 1'/></body></worldbody></mujoco>", "types"),
        (
            "<mujoco><worldbody><body mocap='true'><body><joint type='slide'/><geom size='.1'/></body></body>"
            "</worldbody></mujoco>",
            "must be hinges",
        ),
    ],
)
def test_a_tool_that_cannot_be_read_is_refused(mjcf, says):
    with pytest.raises(OptionError, match=says):
        ToolKinematics.read(mjcf)
