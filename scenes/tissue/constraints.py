"""Forces of MuJoCo's equality constraints."""

import mujoco
import numpy as np
from jaxtyping import Float, Int


def constraint_force(data: mujoco.MjData, equalities: Int[np.ndarray, " m"]) -> Float[np.ndarray, "m 3"]:
    """Return the force of each `connect` constraint, world [N]; zero where it is inactive."""
    rows = np.flatnonzero(data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY)
    force = np.zeros((data.eq_active.size, 3))
    ids, first = np.unique(data.efc_id[rows], return_index=True)
    for k in range(3):
        force[ids, k] = data.efc_force[rows[first + k]]
    return force[equalities]
