"""What the tool holds, and how much of the sheet that is, by the same rule as the estimator."""

import numpy as np
from jaxtyping import Bool, Float, Int

from ..observation import DeclaredMesh, MeasuredPoints, ToolState


def held_points(
    tool: ToolState, positions: Float[np.ndarray, "n 3"], track_id: Int[np.ndarray, " n"] | None
) -> Bool[np.ndarray, " n"]:
    """Return which points are held: the declared tracks, or else all within the grip's radius.

    Args:
        tool: in the frame in which the jaws close.
        positions: in that frame [m]; NaN where unseen, which no radius holds.
        track_id: of each point; None without identities.
    """
    if tool.held_tracks and track_id is not None:
        return np.isin(track_id, tool.held_tracks)
    return np.asarray(np.linalg.norm(positions - tool.position, axis=1) <= tool.radius)


def grip_share(tool: ToolState, points: MeasuredPoints, mesh: DeclaredMesh | None, *, known: int) -> float:
    """Return the share of the sheet's points that are held, or of the declared mesh's vertices; 0 without any.

    Args:
        tool: in the frame in which the jaws close.
        points: in that frame.
        mesh: as it is declared; None without one.
        known: number of points that were seen before; a tool may hide most of what it does not hold.
    """
    if mesh is not None and mesh.held is not None and not tool.held_tracks:
        return float(mesh.held.mean())
    if mesh is not None:
        return float(held_points(tool, mesh.vertices, mesh.track_id).mean())
    held = held_points(tool, points.positions, points.track_id) & np.isfinite(points.positions).all(axis=1)
    return float(held.sum() / max(known, len(held), 1))
