"""One frame's evidence: what was seen of the particles, and what the tool says of those that it holds."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jiggle_mj.observation import ToolState

from .filters.evidence import Evidence, Pull
from .grip import GripHold
from .perception.mesh_field import MeshField
from .perception.track import Track


@dataclass(frozen=True, kw_only=True)
class Fused:
    """One frame."""

    evidence: Evidence
    start: Float[np.ndarray, "n 3"]
    """For a search of the state, smooth where nothing was seen [m]."""
    slip: float
    """How far the held particles are seen from where the tip should have taken them, in the median; 0 unseen [m]."""


def fused(
    track: Track,
    hold: GripHold,
    tool: ToolState,
    before: Float[np.ndarray, "n 3"],
    *,
    grip_sd: float,
    field: MeshField,
) -> Fused:
    """Put both together.

    Args:
        track: what was seen.
        hold: the grasp.
        tool: where it is now.
        before: the state of the frame before, or at rest where the jaws have just closed [m].
        grip_sd: how well held particles follow the tip [m].
        field: fills what is unknown from its surroundings.
    """
    seen, held, expected = track.visible, hold.held, hold.expected(tool)
    off = np.linalg.norm((track.positions - expected)[seen & held], axis=1)
    weighed = np.einsum("nij,nj->ni", track.precision, np.nan_to_num(track.positions))
    grip = np.where(held, grip_sd**-2, 0.0)
    precision = track.precision + grip[:, None, None] * np.eye(3)
    weighed = weighed + grip[:, None] * expected
    known = seen | held
    y = np.where(
        known[:, None],
        np.linalg.solve(np.where(known[:, None, None], precision, np.eye(3)), weighed[..., None])[..., 0],
        0,
    )
    motion = np.where(known[:, None], y - before, 0.0)
    start = before + np.where(held[:, None], motion, field.fill(motion, known, stiffness=1.0))
    evidence = Evidence(
        y=jnp.asarray(np.where(known[:, None], y, start)),
        precision=jnp.asarray(precision),
        held=jnp.asarray(held),
        force_unknown=jnp.asarray(field.widened(held)),
        pull=pull(before, tool, hold),
    )
    return Fused(evidence=evidence, start=start, slip=float(np.median(off)) if len(off) else 0.0)


def pull(before: Float[np.ndarray, "n 3"], tool: ToolState, hold: GripHold) -> Pull:
    """The step of the tool that led to a frame."""
    length = np.linalg.norm(hold.closed_at - hold.tip, axis=1)
    return Pull(before=jnp.asarray(before), tip=jnp.asarray(tool.position), length=jnp.asarray(length))
