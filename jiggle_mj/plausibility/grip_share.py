"""How much of the sheet the tool holds, by the same rule as the estimator."""

import numpy as np

from ..observation import DeclaredMesh, MeasuredPoints, ToolState


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
    if tool.held_tracks and ids is not None:
        held = np.isin(ids, tool.held_tracks)
    elif mesh is not None and mesh.held is not None:
        held = mesh.held
    else:
        held = np.linalg.norm(places - tool.position, axis=1) <= tool.radius
    return float(held.mean()) if len(held) else 0.0
