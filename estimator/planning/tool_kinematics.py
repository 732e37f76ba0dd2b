"""A tool's kinematics through MJX, from its MJCF alone: how high it is above the bed for any position of its tip.

This is the only file of the estimator that imports MuJoCo, and only once a tool is read. All else runs without it.
"""

import contextlib
import io
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jiggle_mj.errors import OptionError


class ToolKinematics(eqx.Module):
    """Tool whose frame has its origin at the tip, and whose jaws are on hinges that are closed at 0."""

    model: Any
    """MJX model."""
    data: Any
    """MJX data, of which only the poses are used."""
    openings: Float[Array, "openings joints"]
    """Angles of the jaws, closed and at the upper limit of their range [rad]."""

    @classmethod
    def read(cls, mjcf: str) -> "ToolKinematics":
        """Return a compiled tool.

        Args:
            mjcf: the XML; one mocap body, whose origin is the tip, made of spheres and capsules.

        Raises:
            OptionError: the XML does not compile, or is not such a tool.
        """
        mujoco, mjx = _mjx()
        try:
            model = mujoco.MjModel.from_xml_string(mjcf)
        except ValueError as failure:
            raise OptionError(f"the tool's MJCF does not compile: {failure}") from failure
        rounded = (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE)
        if not (model.nmocap == 1 and model.ngeom and np.isin(model.geom_type, rounded).all()):
            raise OptionError(
                "the tool must be one mocap body, its origin at the tip, of spheres and capsules alone; "
                f"got {model.nmocap} mocap bodies, and geoms of types {sorted(set(model.geom_type.tolist()))}."
            )
        if not (model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE).all():
            raise OptionError("the tool's joints must be hinges, with the jaws closed at 0.")
        with jax.enable_x64(True):
            openings = jnp.asarray(np.array([np.zeros(model.njnt), model.jnt_range[:, 1]]))
            return cls(model=mjx.put_model(model), data=mjx.make_data(model), openings=openings)

    def clearance(self, tip: Float[Array, " 3"], quat_wxyz: Float[Array, " 4"]) -> Float[Array, ""]:
        """Return the height of the tool's lowest point, with closed or open jaws, whichever is lower [m].

        MJX sets the pose of a mocap body after those of its children. So the pose is set as the body's own.

        Args:
            tip: position of the tip [m].
            quat_wxyz: orientation of the tool.
        """
        _, mjx = _mjx()
        model, base = self.model, int(np.flatnonzero(np.asarray(self.model.body_mocapid) >= 0)[0])
        quat = quat_wxyz / jnp.linalg.norm(quat_wxyz)
        placed = {"body_pos": model.body_pos.at[base].set(tip), "body_quat": model.body_quat.at[base].set(quat)}
        posed = model.replace(**placed)

        def lowest(opening: Float[Array, " joints"]) -> Float[Array, ""]:
            data = self.data.replace(qpos=opening, mocap_pos=tip[None], mocap_quat=quat[None])
            with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
                data = mjx.kinematics(posed, data)
            radius, half = jnp.asarray(model.geom_size)[:, 0], jnp.asarray(model.geom_size)[:, 1]
            return jnp.min(data.geom_xpos[:, 2] - half * jnp.abs(data.geom_xmat[:, 2, 2]) - radius)

        return jnp.min(jax.vmap(lowest)(self.openings))


@eqx.filter_jit
def clearances(tweezer: ToolKinematics, tips: Float[Array, "k 3"], quat_wxyz: Float[Array, " 4"]) -> Float[Array, " k"]:
    """Return the clearance of the tool for many tips [m]; see `ToolKinematics.clearance`."""
    return jax.vmap(lambda tip: tweezer.clearance(tip, quat_wxyz))(tips)


def _mjx() -> tuple[Any, Any]:
    """Return the modules. The import takes seconds, and prints to stdout which of its other engines are missing."""
    with contextlib.redirect_stdout(io.StringIO()):
        import mujoco
        from mujoco import mjx
    return mujoco, mjx
