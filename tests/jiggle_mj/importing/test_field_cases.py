"""Field cases of files of points: read right, or refused with the cure."""

import numpy as np
import pytest

from jiggle_mj.errors import RecordingError
from jiggle_mj.importing.folder import import_folder
from jiggle_mj.recording.reader import Recording
from tests.support.cases_folder import case

ROUNDING = 1e-6
"""Absolute tolerance of coordinates that a case's files give with four digits of a millimetre [m]."""
CONTROL = "bom_first_row"
"""The case whose points the others hold in other forms."""


def positions(tmp_path, name: str) -> np.ndarray:
    summary = import_folder(case(name), None, tmp_path / f"{name}.mcap")
    return np.stack([observation.points.positions for observation in Recording.open(summary.recording)])


@pytest.mark.parametrize("name", ["decimal_comma", "obj_faces_as_points", "mesh_obj", "mesh_ply", "empty_cells"])
def test_a_case_is_read_as_its_control_is(tmp_path, name):
    """Same points; those that were lost are unseen, and no others."""
    expected, found = positions(tmp_path, CONTROL), positions(tmp_path, name)
    lost = np.isnan(found).all(axis=2)
    assert np.isnan(found).any() == (name == "empty_cells") and lost.sum() in (0, 125)
    np.testing.assert_allclose(found[~lost], expected[~lost], atol=ROUNDING)


@pytest.mark.parametrize("name", ["mesh_obj", "mesh_ply"])
def test_vertices_in_another_order_are_matched_by_place(tmp_path, name):
    """An edge of the mesh is as long between the points as it is in the file: 2 to 9 mm."""
    summary = import_folder(case(name), None, tmp_path / "run.mcap")
    mesh = Recording.open(summary.recording).declaration.mesh
    edges = np.linalg.norm(np.diff(mesh.vertices[mesh.faces], axis=1), axis=2)
    assert edges.max() < 9.5e-3 and "matched to the points by place" in summary.notes[0]


def test_frames_are_in_the_order_of_their_numbers(tmp_path):
    """The points leave their rest steadily over the twelve frames."""
    found = positions(tmp_path, "unpadded_frame_numbers")
    motion = np.linalg.norm(found - found[0], axis=2).mean(axis=1)
    assert len(motion) == 12 and (np.diff(motion) > 0).all()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("dic_zero_filled", r"25 points at exactly \(0, 0, 0\).*give missing = \[0, 0, 0\].*sigma"),
        ("tracker_visibility", 'give visibility = "visibs"'),
        ("tracker_points_first", r'give layout = "points, frames" \(6 frames of 115 points\)'),
        ("dic_reference_coordinates", 'nothing moves in 6 frames.*displacements = .*MODEL_DISPLACEMENT_X"'),
    ],
)
def test_a_case_that_needs_a_key_is_refused_with_it(tmp_path, name, message):
    with pytest.raises(RecordingError, match=message):
        import_folder(case(name), None, tmp_path / "run.mcap")


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("dic_zero_filled", "columns = [1, 2, 3]", 'columns = ["X", "Y", "Z"]\nmissing = "sigma == -1"'),
        ("dic_zero_filled", "columns = [1, 2, 3]", "missing = 0"),
        ("dic_zero_filled", "columns = [1, 2, 3]", 'format = "vic-3d"'),
        ("tracker_visibility", 'key = "coords"', 'key = "coords"\nvisibility = "visibs"'),
        (
            "tracker_points_first",
            'key = "tracks_XYZ"',
            'key = "tracks_XYZ"\nlayout = "points, frames"\nvisibility = "none"',
        ),
        ("dic_reference_coordinates", "columns = [5, 6, 7]", 'format = "dice"'),
        ("dic_reference_coordinates", "[5, 6, 7]", "[5, 6, 7]\ndisplacements = [8, 9, 10]"),
    ],
)
def test_the_cure_gives_the_control(tmp_path, name, old, new):
    toml = (case(name) / "recording.toml").read_text()
    assert old in toml
    (tmp_path / "cured.toml").write_text(toml.replace(old, new))
    summary = import_folder(case(name), tmp_path / "cured.toml", tmp_path / "run.mcap")
    found = np.stack([observation.points.positions for observation in Recording.open(summary.recording)])
    lost = np.isnan(found).all(axis=2)
    np.testing.assert_allclose(found[~lost], positions(tmp_path, CONTROL)[~lost], atol=2 * ROUNDING)
    assert lost.sum() == (0 if name.startswith(("dic_ref", "tracker_points")) else 125)
