"""Declared triangles and their continuation become a mesh of the seen points; wrong triangles are refused."""

import numpy as np
import pytest

from jiggle_mj.errors import MeshError, RecordingError
from jiggle_mj.mesh_checks import check_mesh
from jiggle_mj.recording.truth import read_truth
from tests.support.measured_folder import GRID_FACES, ROUNDING, bring_in, grid, npz_folder


def test_declared_faces_become_a_mesh_of_the_seen_rows(tmp_path):
    summary, recording = bring_in(npz_folder(tmp_path, faces=GRID_FACES))
    mesh = recording.declaration.mesh
    assert summary.n_vertices == 11 and 11 not in mesh.track_id and mesh.held is None
    np.testing.assert_allclose(mesh.vertices, grid()[mesh.track_id] * 1e-3, atol=ROUNDING)
    assert {tuple(face) for face in mesh.track_id[mesh.faces]} == {tuple(f) for f in GRID_FACES if 11 not in f}
    assert read_truth(summary.truth).attached.sum() == 1, "row 11 is not seen at rest"


ROUNDING_OF_PLANE = 1e-12
"""Absolute tolerance of the outline [m]: its corners go into the best-fit plane and back."""


def strip_mesh(faces: str = 'faces = "f"\n') -> str:
    extension = "[mesh.extend]\naxis = [2, 0, 0]\nbegin = -0.006\nend = 0.010\nspacing = 0.002\nheld_beyond = 0.0099"
    return faces + extension


@pytest.mark.parametrize("flipped", [False, True])
def test_an_extended_mesh_reaches_beyond_the_view(tmp_path, flipped):
    """Measured 0..6 mm, declared -6..10 mm: one sheet of the measured width, so its area is 16 x 4 mm^2.

    Any triangulation of the outline has that area; the corner that is unseen at rest is filled.
    """
    faces = [face[::-1] for face in GRID_FACES] if flipped else GRID_FACES
    where = npz_folder(tmp_path, faces=faces, mesh=strip_mesh())
    toml = (where / "recording.toml").read_text()
    truth_rows = "attached_rows = [11, 12]\nattached_rows_first = 1"
    toml = toml.replace(truth_rows, "attached_beyond = -0.0059").replace(
        "rows = [0, 1]", "start = [0.01, 0.002, 0.005]\ndirection = [1, 0, 1]\nstep = 0.001"
    )
    (where / "recording.toml").write_text(toml)
    summary, recording = bring_in(where)
    mesh = recording.declaration.mesh
    check_mesh(mesh.vertices, mesh.faces)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    np.testing.assert_allclose([low, high], [[-0.006, 0, 0.005], [0.010, 0.004, 0.005]], atol=ROUNDING_OF_PLANE)
    edges = np.diff(mesh.vertices[mesh.faces], axis=1)
    normals = 0.5 * np.cross(edges[:, 0], edges[:, 1])
    assert (np.sign(normals[:, 2]) == (-1 if flipped else 1)).all()
    assert np.abs(normals[:, 2]).sum() == pytest.approx(16e-3 * 4e-3)
    measured = mesh.track_id >= 0
    np.testing.assert_allclose(mesh.vertices[measured], grid()[mesh.track_id[measured]] * 1e-3, atol=ROUNDING)
    assert set(mesh.track_id[measured]) == set(range(11))
    np.testing.assert_array_equal(mesh.held, mesh.vertices[:, 0] >= 0.0099)
    assert 0 < summary.n_held == mesh.held.sum()
    truth = read_truth(summary.truth)
    np.testing.assert_array_equal(truth.attached, mesh.vertices[:, 0] <= -0.0059)
    first, second = recording
    np.testing.assert_allclose(second.tool.position - first.tool.position, np.array([1, 0, 1]) * 1e-3 / np.sqrt(2))
    assert first.tool.held_tracks == () and first.tool.closed


def test_a_grip_outside_the_extended_mesh_is_refused(tmp_path):
    where = npz_folder(tmp_path, faces=GRID_FACES, mesh=strip_mesh().replace("0.0099", "0.02"))
    with pytest.raises(RecordingError, match=r"held_beyond = 0\.02 lies outside the sheet"):
        bring_in(where)


@pytest.mark.parametrize(
    ("faces", "message"),
    [
        ([[0, 1, 4], [1, 5, 12]], r"triangle 1 is \[1, 5, 12\]; vertex numbers must lie in 0\.\.11"),
        ([[0, 1, 1], [1, 5, 4]], "names a vertex twice"),
        ([[0, 1, 2], [1, 5, 4]], "degenerate: area 0"),
        ([[0, 1, 4], [1, 4, 5]], "inverted against each other"),
        ([[0, 1, 4], [6, 7, 10]], "2 disconnected sheets"),
    ],
)
def test_wrong_faces_are_refused(tmp_path, faces, message):
    with pytest.raises(MeshError, match=message):
        bring_in(npz_folder(tmp_path, faces=faces))
