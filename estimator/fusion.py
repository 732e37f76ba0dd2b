"""One frame's evidence: positions by perception, and by the tool for the particles that it holds."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jiggle_mj.observation import ToolState

from .filters.evidence import Evidence, MeasuredPull, Pull
from .grip import GripHold
from .perception.mesh_field import MeshField
from .perception.track import Track

BESIDE_GRIP = 0.5
"""Standard deviation of a particle beside the grip from where the grip's motion takes it, for clouds [spacing]: a cloud
does not show how it slides, and its balance of forces is unknown."""
FILL_STIFFNESS = 1.0
"""Roughness penalty of the fields that fill unseen particles [1]: they move with their surroundings."""


@dataclass(frozen=True, kw_only=True)
class FusedFrame:
    """One frame as the filter takes it."""

    evidence: Evidence
    """Positions and their precision by perception and grip together."""
    hold: GripHold
    """The grasp that it was fused with."""
    start: Float[np.ndarray, "n 3"]
    """Positions from which a search of the state begins, smooth where nothing was seen [m]."""
    slip: float
    """Median distance of the held particles from where the tool should have taken them [m]; 0 if none was seen."""


def fuse(
    track: Track,
    hold: GripHold,
    tool: ToolState,
    before: Float[np.ndarray, "n 3"],
    *,
    grip_sd: float,
    field: MeshField,
    force: MeasuredPull | None = None,
) -> FusedFrame:
    """Combine perception and grip by their precisions.

    Args:
        track: what was seen.
        hold: the grasp.
        tool: the tool in this frame.
        before: the state of the frame before, or at rest where the jaws have just closed [m].
        grip_sd: standard deviation of held particles from where the tip takes them [m].
        field: fills what is unknown from its surroundings.
        force: of the tool; None where none is measured.
    """
    seen, held, expected = track.visible, hold.held, hold.expected(tool)
    distance = np.linalg.norm((track.positions - expected)[seen & held], axis=1)
    weighted = np.einsum("nij,nj->ni", track.precision, np.nan_to_num(track.positions))
    grip = np.where(held, grip_sd**-2, 0.0)
    precision = track.precision + grip[:, None, None] * np.eye(3)
    weighted = weighted + grip[:, None] * expected
    known = seen | held
    y = np.where(
        known[:, None],
        np.linalg.solve(np.where(known[:, None, None], precision, np.eye(3)), weighted[..., None])[..., 0],
        0,
    )
    motion = np.where(known[:, None], y - before, 0.0)
    start = before + np.where(held[:, None], motion, field.fill(motion, known, stiffness=FILL_STIFFNESS))
    if track.cloud is not None:
        beside = field.dilated(held) & ~held
        precision[beside] += np.eye(3) / (BESIDE_GRIP * float(track.cloud.surface.spacing)) ** 2
    evidence = Evidence(
        y=jnp.asarray(np.where(known[:, None], y, start)),
        precision=jnp.asarray(precision),
        held=jnp.asarray(held),
        force_unknown=jnp.asarray(field.dilated(held)),
        fields=track.fields,
        pull=pull(before, tool, hold),
        cloud=track.cloud,
        force=force,
    )
    slip = float(np.median(distance)) if len(distance) else 0.0
    return FusedFrame(evidence=evidence, hold=hold, start=start, slip=slip)


def pull(before: Float[np.ndarray, "n 3"], tool: ToolState, hold: GripHold) -> Pull:
    """Return the step of the tool that led to a frame, from the state `before` it [m]."""
    length = np.linalg.norm(hold.closed_at - hold.tip, axis=1)
    return Pull(before=jnp.asarray(before), tip=jnp.asarray(tool.position), length=jnp.asarray(length))


def fill_unseen(track: Track, rest: Float[np.ndarray, "n 3"], field: MeshField) -> Float[np.ndarray, "n 3"]:
    """Return where the sheet lies with open jaws [m]; what is not seen moves with its surroundings.

    The rest positions where nothing at all is seen.
    """
    if not track.visible.any():
        return rest
    motion = np.where(track.visible[:, None], np.nan_to_num(track.positions) - rest, 0.0)
    return rest + field.fill(motion, track.visible, stiffness=FILL_STIFFNESS)
