"""Folders of measured points become recordings, with the truth in a separate file."""

import numpy as np
import pytest
from scipy.io import savemat
from scipy.sparse import coo_array

from jiggle_mj.errors import OutputError, RecordingError
from jiggle_mj.importing.folder import import_folder
from jiggle_mj.mesh_checks import check_mesh
from jiggle_mj.recording.mcap_files import truth_path
from jiggle_mj.recording.reader import Recording
from jiggle_mj.recording.truth import read_truth
from tests.support.measured_folder import GRID_FACES, ROUNDING, TOML, bring_in, folder, grid, npz_folder


def test_a_folder_becomes_a_recording_and_a_separate_truth(tmp_path):
    summary, recording = bring_in(folder(tmp_path))
    seen = list(recording)
    assert recording.skipped == [] and summary.n_frames == 3 and summary.n_points == 12 and summary.skipped == ()
    assert [observation.time for observation in seen] == [0, 500_000_000, 1_000_000_000]
    np.testing.assert_allclose(seen[0].points.positions, grid() * 1e-3, atol=ROUNDING)
    np.testing.assert_array_equal(seen[2].points.track_id, np.arange(12))
    assert seen[0].points.sd == 1e-4 and seen[0].images is None
    assert recording.declaration.gravity == (0, 0, 0) and not recording.declaration.bed
    assert recording.declaration.mesh is None
    for observation in seen:
        state = observation.tool
        assert state.closed and state.grasp == 1 and state.held_tracks == (0, 1) and state.by_points
        np.testing.assert_allclose(state.position, observation.points.positions[:2].mean(axis=0), atol=ROUNDING)
    truth = read_truth(summary.truth)
    assert summary.truth == truth_path(summary.recording) and summary.n_attached == 2 and truth.frames == ()
    np.testing.assert_allclose(truth.rest[truth.attached], grid()[[10, 11]] * 1e-3, atol=ROUNDING)
    check_mesh(truth.rest, truth.faces)
    with pytest.raises(RecordingError, match="holds /truth topics"):
        Recording.open(summary.truth)


def test_the_same_folder_gives_the_same_bytes_and_truth_changes_none(tmp_path):
    where = folder(tmp_path)
    import_folder(where, None, where / "a.mcap")
    (where / "recording.toml").write_text(TOML.replace("[11, 12]", "[1, 2]"))
    import_folder(where, None, where / "b.mcap")
    assert (where / "a.mcap").read_bytes() == (where / "b.mcap").read_bytes()
    assert (where / "a.truth.mcap").read_bytes() != (where / "b.truth.mcap").read_bytes()


def test_without_truth_no_truth_file_is_written(tmp_path):
    toml = TOML.replace("[truth]\nattached_rows = [11, 12]\nattached_rows_first = 1\n", "")
    summary, _ = bring_in(folder(tmp_path, toml=toml))
    assert summary.truth is None and summary.n_attached is None
    assert not truth_path(summary.recording).exists()


def test_the_frame_is_rotated_after_the_unit_and_the_rest_comes_first(tmp_path):
    """world = R given + t: x_world = -y, y_world = x + 1, with R a quarter turn about z."""
    frame = "[frame]\nrotation = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]\ntranslation = [0, 1, 0]\n[grasp]"
    where = folder(tmp_path, toml=TOML.replace('"]\n[grasp]', f'"]\nrest = 2\n{frame}'))
    _, recording = bring_in(where)
    first, second, _ = recording
    given = np.loadtxt(where / "pulled_2.xyz") * 1e-3
    np.testing.assert_allclose(
        first.points.positions, np.column_stack([-given[:, 1], given[:, 0] + 1, given[:, 2]]), atol=ROUNDING
    )
    np.testing.assert_allclose(second.points.positions[0], [0, 1, 5e-3], atol=ROUNDING)


def test_unseen_points_are_nan_and_the_tool_follows_the_grasped_points_that_are_seen(tmp_path):
    """Row 0 unseen: the tip is the rest mean plus the motion of row 1, not row 1 itself."""
    pulled, blank, ungrasped = grid() + 1, np.full((12, 3), np.nan), grid()
    pulled[0] = np.nan
    ungrasped[:2] = np.nan
    summary, recording = bring_in(folder(tmp_path, frames=[grid(), pulled, ungrasped]))
    first, second = recording
    np.testing.assert_allclose(second.tool.position, first.tool.position + 1e-3, atol=ROUNDING)
    assert np.isnan(second.points.positions[0]).all() and summary.n_unseen == 1
    assert summary.skipped == (("pulled_2.xyz", "no grasped point seen"),)
    second_import = tmp_path / "blank"
    second_import.mkdir()
    summary, _ = bring_in(folder(second_import, frames=[grid(), blank, pulled]))
    assert summary.skipped == (("pulled_1.xyz", "no finite point"),) and summary.n_frames == 2


def test_a_blank_rest_frame_is_refused_by_name(tmp_path):
    blank = np.full((12, 3), np.nan)
    with pytest.raises(RecordingError, match=r"rest frame rest\.xyz has fewer than three finite points"):
        bring_in(folder(tmp_path, frames=[blank, grid(), grid()]))


def test_csv_with_a_heading_and_other_columns_is_read(tmp_path):
    where = folder(tmp_path, toml=TOML.replace('"]\n[grasp]', '"]\ncolumns = [1, 2, 3]\n[grasp]'))
    for path in where.glob("*.xyz"):
        rows = np.loadtxt(path)
        lines = [f"{i},{x},{y},{z}" for i, (x, y, z) in enumerate(rows)]
        path.write_text("\n".join(["id,x,y,z", "# comment", *lines]) + "\n")
    _, recording = bring_in(where)
    np.testing.assert_allclose(next(iter(recording)).points.positions, grid() * 1e-3, atol=ROUNDING)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("1 2 3\n4 5\n", "line 2 has 2 columns, line 1 has 3: all rows must have as many"),
        ("1\n2\n", r"line 1 has 1 columns; columns \[0, 1, 2\]"),
        ("1 2 3\n4 5 six\n", "line 2 holds text that is not a number"),
        ("x y z\n", "holds no rows of numbers"),
        ("1 2 3\n", "rest.xyz has 12 rows, pulled_1.xyz has 1"),
    ],
)
def test_a_wrong_points_file_is_refused_with_its_line(tmp_path, content, message):
    where = folder(tmp_path)
    (where / "pulled_1.xyz").write_text(content)
    with pytest.raises(RecordingError, match=message):
        bring_in(where)


def test_a_wrong_archive_is_refused(tmp_path):
    where = npz_folder(tmp_path, faces=GRID_FACES)
    np.savez(where / "d.npz", q=grid())
    with pytest.raises(RecordingError, match="has no array 'p'; it has q"):
        bring_in(where)
    np.savez(where / "d.npz", p=grid())
    with pytest.raises(RecordingError, match=r"must have shape \(frames, points, 3\); it has \(12, 3\)"):
        bring_in(where)
    (where / "d.npz").write_bytes(b"no archive")
    with pytest.raises(RecordingError, match=r"cannot be read as \.npz"):
        bring_in(where)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.full((2, 12, 3), 1j), "p holds complex numbers: save their parts"),
        (np.full((2, 12, 3), None), "p holds objects, which are never read"),
        (np.zeros((2, 12, 3), "datetime64[s]"), "p holds dates: save .*int64.*time_unit"),
        (np.zeros((2, 12, 3), "timedelta64[s]"), "p holds durations"),
        (np.full((2, 12, 3), "1.0"), "p holds text; plain numbers are read"),
        (np.zeros((2, 12), [("x", float), ("y", float)]), "p holds records"),
        (np.ones((2, 12, 4)), r"shape \(2, 12, 4\), with 4 numbers a point.* as an array for visibility"),
    ],
)
@pytest.mark.parametrize("suffix", ["npz", "npy"])
def test_an_array_of_other_things_is_refused_by_what_it_holds(tmp_path, array, message, suffix):
    where = npz_folder(tmp_path, faces=GRID_FACES, mesh="")
    np.savez(where / "d.npz", p=array)
    if suffix == "npy":
        np.save(where / "d.npy", array)
        toml = (where / "recording.toml").read_text()
        (where / "recording.toml").write_text(toml.replace('"d.npz"]\nkey = "p"', '"d.npy"]'))
        message = message.replace("p holds", "the array holds")
    with pytest.raises(RecordingError, match=message):
        bring_in(where)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.full((2, 12, 3), 1j), "p holds complex numbers"),
        ("text", "p holds text"),
        ({"x": np.zeros(3)}, "p holds structures"),
        (np.array([np.zeros(3), "a"], object), "p holds cells"),
        (coo_array(np.eye(3)), "p holds a sparse matrix"),
    ],
)
def test_an_array_of_matlab_of_other_things_is_refused_by_what_it_holds(tmp_path, array, message):
    where = npz_folder(tmp_path, faces=GRID_FACES, mesh="")
    savemat(where / "d.mat", {"p": array})
    toml = (where / "recording.toml").read_text()
    (where / "recording.toml").write_text(toml.replace("d.npz", "d.mat"))
    with pytest.raises(RecordingError, match=message):
        bring_in(where)


def test_an_existing_output_is_not_overwritten_unasked(tmp_path):
    where = folder(tmp_path)
    bring_in(where)
    with pytest.raises(OutputError, match=r"run\.mcap exists"):
        bring_in(where)
    (where / "run.mcap").unlink()
    with pytest.raises(OutputError, match=r"run\.truth\.mcap exists"):
        bring_in(where)
    assert not (where / "run.mcap").exists()
    bring_in(where, overwrite=True)


@pytest.mark.parametrize("out", ["", "/", ".."])
def test_an_output_without_a_name_is_refused(tmp_path, out):
    with pytest.raises(OutputError, match=r"is a folder; give a file, such as .*run\.mcap"):
        import_folder(folder(tmp_path), None, out)


def test_measured_data_stays_unchanged(tmp_path):
    """The importer writes beside `out` only; the folder may be read-only."""
    where = folder(tmp_path)
    before = sorted((path.name, path.read_bytes()) for path in where.iterdir())
    import_folder(where, None, tmp_path / "run.mcap")
    assert sorted((path.name, path.read_bytes()) for path in where.iterdir()) == before
