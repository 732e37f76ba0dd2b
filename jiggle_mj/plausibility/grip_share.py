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


def grip_share(tool: ToolState, points: MeasuredPoints, mesh: DeclaredMesh | None) -> float:
    """Return the share of the sheet's points that are held, or of the declared mesh's vertices; 0 without any.

    Args:
        tool: in the frame in which the jaws close.
        points: in that frame.
        mesh: as it is declared; None without one.
    """
    seen = np.isfinite(points.positions).all(axis=1)
    ids = None if points.track_id is None else points.track_id[seen]
    places, ids = (points.positions[seen], ids) if mesh is None else (mesh.vertices, mesh.track_id)
    by_mesh = None if tool.held_tracks or mesh is None else mesh.held
    held = held_points(tool, places, ids) if by_mesh is None else by_mesh
    return float(held.mean()) if len(held) else 0.0
