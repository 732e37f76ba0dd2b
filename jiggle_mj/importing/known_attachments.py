"""Truth of measured data: which points or vertices are known to be attached, for scoring alone."""

import numpy as np
from jaxtyping import Bool, Float, Int

from ..errors import RecordingError
from ..observation import DeclaredMesh
from ..sheet_triangulation import SheetPlane, triangulate
from ..truth import Truth
from .data_folder import DataFolder
from .declared_mesh import MAX_EDGE_SPACINGS, spacing_of
from .point_files import read_rows
from .recording_toml import MeasuredRecording, Region, Rows


def measured_truth(
    folder: DataFolder, given: MeasuredRecording, rest: Float[np.ndarray, "n 3"], mesh: DeclaredMesh | None, name: str
) -> Truth | None:
    """Return the presence of attachments; true positions are unknown, so the truth has no frames.

    None where nothing is known.

    Raises:
        RecordingError: a row is not one of the data, or the region or place holds no vertex.
    """
    if given.attached is None:
        return None
    if isinstance(given.attached, Rows):
        nothing = given.attached.file is None and not given.attached.rows
        rows = () if nothing else read_rows(folder, given.attached, len(rest), "[truth]")
        known = np.isin(np.arange(len(rest)), rows)
        vertices, faces, attached = _truth_sheet(rest, known, mesh)
    elif isinstance(given.attached, Region):
        vertices, faces, _ = _truth_sheet(rest, np.zeros(len(rest), bool), mesh)
        attached = np.linalg.norm(vertices - given.attached.at, axis=1) <= given.attached.radius
        if not attached.any():
            raise RecordingError(
                f"[truth] attached_at {given.attached.at.tolist()} has no vertex within {given.attached.radius} m."
            )
    else:
        assert mesh is not None and given.extension is not None
        plane = SheetPlane.through(mesh.vertices[mesh.track_id >= 0], given.extension.axis)
        vertices, faces, attached = mesh.vertices, mesh.faces, plane.beyond(mesh.vertices, given.attached)
    return Truth(
        rest=vertices,
        faces=faces,
        attached=attached,
        frames=(),
        scene=given.name,
        identity=name,
        details=given.truth_details,
    )


def _truth_sheet(
    rest: Float[np.ndarray, "n 3"], known: Bool[np.ndarray, " n"], mesh: DeclaredMesh | None
) -> tuple[Float[np.ndarray, "m 3"], Int[np.ndarray, "f 3"], Bool[np.ndarray, " m"]]:
    """Return vertices, triangles and attachments of the declared mesh, or of the seen rows, triangulated here."""
    if mesh is not None:
        return mesh.vertices, mesh.faces, np.where(mesh.track_id >= 0, known[mesh.track_id], False)
    rows = np.flatnonzero(np.isfinite(rest).all(axis=1))
    flat = SheetPlane.through(rest[rows]).flatten(rest[rows])
    used, renumbered = np.unique(triangulate(flat, MAX_EDGE_SPACINGS * spacing_of(flat)), return_inverse=True)
    rows = rows[used]
    return rest[rows], renumbered.reshape(-1, 3), known[rows]
