"""The tool's kinematics through MJX against MuJoCo's own, and the workspace that a plan keeps to."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from jiggle_mj.errors import OptionError
from jiggle_mj.estimator.planning.tool_kinematics import ToolKinematics, clearances
from jiggle_mj.scenes.tissue.model import TWEEZER


@pytest.fixture(scope="module")
def tweezer() -> ToolKinematics:
    return ToolKinematics.read(TWEEZER.read_text())


def lowest(tip: np.ndarray, quat: np.ndarray) -> float:
    """Of the tool's surface, by MuJoCo and points on each capsule's axis."""
    model = mujoco.MjModel.from_xml_path(str(TWEEZER))
    data, found = mujoco.MjData(model), []
    data.mocap_pos[0], data.mocap_quat[0] = tip, quat
    along = np.linspace(-1, 1, 3)
    for angle in (0.0, 0.35):
        data.qpos[:] = angle
        mujoco.mj_kinematics(model, data)
        for (radius, half, _), centre, turn in zip(model.geom_size, data.geom_xpos, data.geom_xmat, strict=True):
            axis = turn.reshape(3, 3)[:, 2]
            found.append((centre + half * along[:, None] * axis)[:, 2].min() - radius)
    return min(found)


def poses(count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    quats = rng.normal(size=(count, 4))
    return rng.uniform(-0.1, 0.1, (count, 3)), quats / np.linalg.norm(quats, axis=1)[:, None]


def test_clearance_is_that_of_mujoco_in_any_pose(tweezer):
    with jax.enable_x64(True):
        for tip, quat in zip(*poses(20), strict=True):
            found = clearances(tweezer, jnp.asarray(tip)[None], jnp.asarray(quat))
            assert float(found[0]) == pytest.approx(lowest(tip, quat), abs=1e-9)


def test_upright_the_tip_is_the_lowest_point(tweezer):
    with jax.enable_x64(True):
        tips = jnp.asarray([[0.0, 0.0, 0.0], [0.01, -0.02, 0.03]])
        np.testing.assert_allclose(clearances(tweezer, tips, jnp.asarray([1.0, 0, 0, 0])), tips[:, 2], atol=1e-9)


def test_clearance_is_differentiable_in_tip_and_orientation(tweezer):
    with jax.enable_x64(True):
        height = jax.jit(lambda tip, quat: tweezer.clearance(tip, quat))
        slope = jax.jit(jax.grad(height, argnums=(0, 1)))
        for tip, quat in zip(*map(jnp.asarray, poses(3)), strict=True):
            by_tip, by_quat = slope(tip, quat)
            np.testing.assert_allclose(by_tip, [0, 0, 1], atol=1e-9)
            for k in range(4):
                up, down = (float(height(tip, quat.at[k].add(step))) for step in (1e-6, -1e-6))
                assert float(by_quat[k]) == pytest.approx((up - down) / 2e-6, abs=1e-7)


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
