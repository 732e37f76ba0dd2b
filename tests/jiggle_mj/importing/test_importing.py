"""Folders of measured data become recordings; what is wrong with them is named. Mesh checks are here too."""

import os
from pathlib import Path

import numpy as np
import pytest

from jiggle_mj.errors import MeshError, OutputError, RecordingError
from jiggle_mj.importing.folder import ImportSummary, import_folder
from jiggle_mj.mesh_checks import check_mesh
from jiggle_mj.recording.mcap_files import truth_path
from jiggle_mj.recording.reader import Recording
from jiggle_mj.recording.truth import read_truth
from jiggle_mj.sheet_triangulation import SheetPlane, extend, triangulate

CHECKOUT = Path(__file__).parents[3]
DOCUMENTED = CHECKOUT / "docs" / "recordings"
MEASURED = os.environ.get("JIGGLE_MJ_MEASURED")
ROUNDING = 1e-15
"""Coordinates of a few cm in metres, once scaled and turned."""

TOML = """
name = "grid"
unit = "mm"
period = 0.5
noise_sd = 1e-4
[points]
files = ["rest.xyz", "pulled_*.xyz"]
[grasp]
rows = [0, 1]
[truth]
attached_rows = [11, 12]
attached_rows_first = 1
[declaration]
gravity = [0.0, 0.0, 0.0]
bed = false
"""


def grid() -> np.ndarray:
    """A 4 x 3 sheet of 2 mm pitch [mm]; row 0 is a corner."""
    x, y = np.meshgrid(np.arange(4) * 2.0, np.arange(3) * 2.0)
    return np.column_stack([x.ravel(), y.ravel(), np.full(12, 5.0)])


GRID_FACES = [
    triangle
    for row in range(2)
    for i in range(4 * row, 4 * row + 3)
    for triangle in ([i, i + 1, i + 4], [i + 1, i + 5, i + 4])
]


def folder(tmp_path: Path, *, toml: str = TOML, frames: list[np.ndarray] | None = None) -> Path:
    where = tmp_path / "data"
    where.mkdir()
    lifted = grid()
    lifted[:2, 2] += 3
    for name, points in zip(("rest", "pulled_1", "pulled_2"), frames or [grid(), lifted, lifted + 1], strict=True):
        np.savetxt(where / f"{name}.xyz", points)
    (where / "recording.toml").write_text(toml)
    return where


def bring_in(where: Path, **settings) -> tuple[ImportSummary, Recording]:
    summary = import_folder(where, None, where / "run.mcap", **settings)
    return summary, Recording.open(summary.recording)


def npz_folder(tmp_path: Path, *, faces: list[list[int]], mesh: str = 'faces = "f"') -> Path:
    """The same grid as an .npz, row 11 unseen at rest."""
    points = np.stack([grid(), grid() + 1])
    points[0, 11] = np.nan
    old = 'files = ["rest.xyz", "pulled_*.xyz"]'
    toml = TOML.replace(old, 'files = ["d.npz"]\nkey = "p"').replace("[grasp]", f"[mesh]\n{mesh}\n[grasp]")
    where = folder(tmp_path, toml=toml)
    np.savez(where / "d.npz", p=points, f=np.array(faces))
    return where


def test_a_folder_becomes_a_recording_and_a_truth_apart(tmp_path):
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


def test_the_frame_is_turned_after_the_unit_and_the_rest_comes_first(tmp_path):
    """world = R given + t: x_world = -y, y_world = x + 1, with R a quarter turn about z."""
    turn = "[frame]\nrotation = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]\ntranslation = [0, 1, 0]\n[grasp]"
    where = folder(tmp_path, toml=TOML.replace('"]\n[grasp]', f'"]\nrest = 2\n{turn}'))
    _, recording = bring_in(where)
    first, second, _ = recording
    given = np.loadtxt(where / "pulled_2.xyz") * 1e-3
    np.testing.assert_allclose(
        first.points.positions, np.column_stack([-given[:, 1], given[:, 0] + 1, given[:, 2]]), atol=ROUNDING
    )
    np.testing.assert_allclose(second.points.positions[0], [0, 1, 5e-3], atol=ROUNDING)


def test_a_stated_path_counts_its_steps_from_the_rest_frame_wherever_that_stands(tmp_path):
    path = "start = [0.0, 0.0, 0.0]\ndirection = [0.0, 0.0, 1.0]\nstep = 1e-3"
    toml = TOML.replace("rows = [0, 1]", path, 1).replace('"]\n[grasp]', '"]\nrest = 1\n[grasp]')
    _, recording = bring_in(folder(tmp_path, toml=toml))
    assert [round(1e3 * frame.tool.position[2]) for frame in recording] == [0, -1, 1]
    assert [frame.points.positions[0, 2] for frame in recording] == pytest.approx([8e-3, 5e-3, 9e-3])


def test_a_grasped_point_unseen_at_rest_leaves_the_tool_to_the_others(tmp_path):
    rest = grid()
    rest[0] = np.nan
    summary, recording = bring_in(folder(tmp_path, frames=[rest, grid(), grid() + 1]))
    np.testing.assert_allclose([frame.tool.position for frame in recording], 1e-3 * (grid()[1] + [[0], [0], [1]]))
    assert not summary.skipped


def test_a_rest_frame_without_any_grasped_point_is_refused(tmp_path):
    rest = grid()
    rest[:2] = np.nan
    with pytest.raises(RecordingError, match=r"rest\.xyz shows none of the 2 grasped points.*another rest"):
        bring_in(folder(tmp_path, frames=[rest, grid(), grid() + 1]))


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
    other = tmp_path / "blank"
    other.mkdir()
    summary, _ = bring_in(folder(other, frames=[grid(), blank, pulled]))
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


def test_declared_faces_become_a_mesh_of_the_seen_rows(tmp_path):
    summary, recording = bring_in(npz_folder(tmp_path, faces=GRID_FACES))
    mesh = recording.declaration.mesh
    assert summary.n_vertices == 11 and 11 not in mesh.track_id and mesh.held is None
    np.testing.assert_allclose(mesh.vertices, grid()[mesh.track_id] * 1e-3, atol=ROUNDING)
    assert {tuple(face) for face in mesh.track_id[mesh.faces]} == {tuple(f) for f in GRID_FACES if 11 not in f}
    assert read_truth(summary.truth).attached.sum() == 1, "row 11 is not seen at rest"


def strip_mesh(faces: str = 'faces = "f"\n') -> str:
    extension = "[mesh.extend]\naxis = [2, 0, 0]\nbegin = -0.006\nend = 0.010\nspacing = 0.002\nheld_beyond = 0.0099"
    return faces + extension


@pytest.mark.parametrize("turned", [False, True])
def test_an_extended_mesh_reaches_beyond_the_view(tmp_path, turned):
    """Measured 0..6 mm, declared -6..10 mm: one sheet of the measured width, so its area is 16 x 4 mm^2.

    Any triangulation of the outline has that area; the corner that is unseen at rest is filled.
    """
    faces = [face[::-1] for face in GRID_FACES] if turned else GRID_FACES
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
    np.testing.assert_allclose([low, high], [[-0.006, 0, 0.005], [0.010, 0.004, 0.005]], atol=1e-12)
    edges = np.diff(mesh.vertices[mesh.faces], axis=1)
    normals = 0.5 * np.cross(edges[:, 0], edges[:, 1])
    assert (np.sign(normals[:, 2]) == (-1 if turned else 1)).all()
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


def test_stations_are_world_coordinates_on_the_centre_line():
    """On p = c + s a the station is p_k for the largest |a_k|, so along(p_k) = s."""
    axis = np.array([-0.3, 0.9, 0.1]) / np.linalg.norm([-0.3, 0.9, 0.1])
    points = np.random.default_rng(0).normal(size=(30, 3)) * [1, 4, 0.1]
    plane = SheetPlane.through(points, axis)
    on_line = plane.centre + 0.7 * axis
    assert plane.along(on_line[1]) == pytest.approx(0.7)
    np.testing.assert_allclose(plane.axes @ plane.axes.T, np.eye(3), atol=1e-14)
    assert plane.beyond(on_line[None] + 1e-9 * axis, on_line[1]).all()
    assert not plane.beyond(on_line[None] - 1e-9 * axis, on_line[1]).any()


def test_extension_on_one_side_leaves_the_other_alone():
    flat = grid()[:, :2]
    added = extend(flat, begin=-6.0, end=3.0, spacing=2.0)
    assert added[:, 0].max() < 0 and added[:, 0].min() == -6
    assert len(triangulate(np.concatenate([flat, added]), 5.0)) > len(GRID_FACES)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('unit = "mm"', 'unit = "inch"', "unit must be one of m, cm, mm; got 'inch'"),
        ('unit = "mm"', "", "lacks the key 'unit'"),
        ("period = 0.5", "period = 0", "period must be a number above 0; got 0"),
        ('name = "grid"', "name = 3", "name must be a text; got 3"),
        ('name = "grid"', 'name = "grid"\nunits = "mm"', "unknown key 'units'; known: declaration, frame, grasp"),
        (
            "rows = [0, 1]",
            "rows = [0, 1]\ntip = 3",
            r"\[grasp\] has the unknown key 'tip'; known: after, direction, radius",
        ),
        ("bed = false", "bed = 0", r"\[declaration\] bed must be true or false; got 0"),
        ("bed = false", "youngs = 3.0", r"\[declaration\] has the unknown key 'youngs'; known: areal_density"),
        ("bed = false", "poisson = 0.5", r"\[declaration\] Declaration.poisson must be in \[0, 0.5\)"),
        ("bed = false", "thickness = 0", r"\[declaration\] Declaration.thickness must be above 0"),
        ("rows = [0, 1]", "", r"\[grasp\] needs rows or rows_file, or start, direction and step"),
        ("rows = [0, 1]", 'rows = [0]\nrows_file = "r"', "both rows and rows_file"),
        ("rows = [0, 1]", "rows = [12]", r"grasp names row 12; rows are numbered 0\.\.11"),
        ("rows = [0, 1]", "rows = []", "grasp names row none"),
        ("rows = [0, 1]", 'rows_file = "rest.xyz"', "must hold whole numbers"),
        ("attached_rows = [11, 12]", "attached_rows = [0]", r"\[truth\] names row 0; rows are numbered 1\.\.12"),
        ("attached_rows = [11, 12]", "attached_beyond = 1.0", r"\[truth\] attached_beyond needs \[mesh.extend\]"),
        ("[truth]", "[truth]\nattached_beyond = 1.0", "both attached_beyond and attached_rows"),
        ('files = ["rest.xyz", "pulled_*.xyz"]', "files = []", "needs at least one file"),
        ('files = ["rest.xyz", "pulled_*.xyz"]', 'files = ["a.npz"]', "key names the array of an .npz"),
        ('files = ["rest.xyz", "pulled_*.xyz"]', 'files = ["none_*.xyz"]', "no file that matches 'none_"),
        ('files = ["rest.xyz", "pulled_*.xyz"]', 'files = ["no.xyz"]', r"no\.xyz cannot be read as text"),
        ('_*.xyz"]', '_*.xyz"]\nrest = 3', r"\[points\] rest is 3; there are 3 frames"),
        ('_*.xyz"]', '_*.xyz"]\n[frame]\nrotation = [[2,0,0],[0,1,0],[0,0,1]]', "is not a rotation"),
        ('_*.xyz"]', '_*.xyz"]\n[mesh.extend]\naxis = [0,0,0]', "axis must have a direction"),
        ("[points]", "[points", "is not TOML"),
    ],
)
def test_a_wrong_toml_is_refused_with_key_value_and_what_is_allowed(tmp_path, old, new, message):
    assert old in TOML
    where = folder(tmp_path, toml=TOML.replace(old, new))
    with pytest.raises(RecordingError, match=message) as refusal:
        bring_in(where)
    assert "\n" not in str(refusal.value)
    assert not (where / "run.mcap").exists() and not (where / "run.truth.mcap").exists()


def test_a_missing_toml_is_refused(tmp_path):
    with pytest.raises(RecordingError, match=r"recording\.toml cannot be read"):
        import_folder(tmp_path, None, tmp_path / "run.mcap")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("1 2 3\n4 5\n", r"line 2 has 2 columns; columns \[0, 1, 2\]"),
        ("1 2 3\n4 5 six\n", "line 2 is not numbers"),
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


def test_a_good_mesh_passes_and_each_fault_is_named():
    good = grid() * 1e-3
    check_mesh(good, np.array(GRID_FACES))
    cases = [
        (good, np.empty((0, 3), int), "no triangles"),
        (good, np.array([[0, 1]]), r"shape \(f, 3\)"),
        (good, np.array([[0.0, 1, 4]]), "integers"),
        (good[:, :2], np.array([[0, 1, 4]]), r"shape \(n, 3\)"),
        (np.where(np.arange(12)[:, None] == 3, np.nan, good), np.array(GRID_FACES), "vertex 3 is not finite"),
        (good, np.array([*GRID_FACES, [1, 4, 10]]), "belongs to 3 triangles"),
        (good[:6], np.array([[0, 1, 4]]), "vertex 2 belongs to no triangle"),
        (good, np.array([[0, 1, -1]]), "must lie in"),
    ]
    for vertices, faces, message in cases:
        with pytest.raises(MeshError, match=message):
            check_mesh(vertices, faces)


REPORTED = """
name = "runs"
unit = "mm"
noise_sd = 1e-4
[points]
files = ["d.npz"]
key = "p"
times = "t"
runs = "r"
[frame]
rotation = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
[grasp]
rows = [0, 1]
tool = "tip"
tool_times = "at"
tool_turns = "turn"
after = 0.5
[truth]
attached_rows = []
"""


def reported_folder(tmp_path: Path, *, toml: str = REPORTED, **arrays) -> Path:
    """Two runs of three frames at 2 Hz, and a tool that goes along x at 10 mm/s from the start, turning about z."""
    where = tmp_path / "data"
    where.mkdir()
    at = np.arange(0, 4.01, 0.2)
    turns = np.column_stack([np.cos(0.05 * at), 0 * at, 0 * at, np.sin(0.05 * at)])
    given = {
        "p": np.tile(grid(), (6, 1, 1)),
        "t": 7.0 + np.array([0.0, 0.5, 1.0, 2.0, 2.5, 3.0]),
        "r": np.array([1, 1, 1, 2, 2, 2]),
        "tip": np.column_stack([10 * at, 0 * at, 0 * at]),
        "at": 7.0 + at,
        "turn": turns,
    }
    np.savez(where / "d.npz", **(given | arrays))
    (where / "recording.toml").write_text(toml)
    return where


def test_runs_with_a_tool_that_reported_become_grasps(tmp_path):
    """The world is turned by 90 degrees about z: what goes along x as given goes along y."""
    summary, recording = bring_in(reported_folder(tmp_path))
    seen = list(recording)
    assert summary.n_attached == 0
    assert [round(one.time / 1e9, 6) for one in seen] == [0, 0.5, 1, 2, 2.5, 3]
    assert [one.tool.closed for one in seen] == [False, True, True, False, True, True]
    assert [one.tool.grasp for one in seen] == [0, 1, 1, 1, 2, 2]
    for one in seen:
        time = one.time / 1e9
        np.testing.assert_allclose(one.tool.position, [0, 0.01 * time, 0], atol=1e-12)
        angle = 2 * np.arctan2(one.tool.quat_wxyz[3], one.tool.quat_wxyz[0])
        assert angle == pytest.approx(np.pi / 2 + 0.1 * time, abs=1e-9)
        assert not one.tool.by_points
    told = [round(report.time / 1e9, 6) for report in seen[3].reports]
    assert told == [1.2, 1.4, 1.6, 1.8]
    np.testing.assert_allclose(seen[3].reports[0].position, [0, 0.012, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("changed", "arrays", "says"),
    [
        (("after = 0.5", 'after = "soon"'), {}, "after must be a number"),
        (('times = "t"\nruns', "runs"), {}, "runs needs times"),
        (('times = "t"\nruns = "r"', ""), {}, "lacks the key 'period'"),
        (('times = "t"\nruns = "r"', "rest = 1"), {}, "lacks the key 'period'"),
        (('runs = "r"', "rest = 1"), {}, "rest must be 0 where frames have times; got 1"),
        (('times = "t"', 'times = "u"'), {}, "has no array 'u'"),
        (("", ""), {"t": np.zeros(6)}, "times must rise"),
        (("", ""), {"r": np.zeros(5)}, "one entry for each of the 6 frames"),
        (("", ""), {"at": np.zeros(21)}, r"at \(reports,\), rising"),
        (("", ""), {"turn": np.ones((21, 3))}, r"turn must have shape \(21, 4\), w first"),
    ],
)
def test_what_is_wrong_with_runs_and_reports_is_said(tmp_path, changed, arrays, says):
    where = reported_folder(tmp_path, toml=REPORTED.replace(*changed) if changed[0] else REPORTED, **arrays)
    with pytest.raises(RecordingError, match=says):
        bring_in(where)


def measured(name: str) -> Path:
    if MEASURED is None:
        pytest.skip("measured data is not part of the project; JIGGLE_MJ_MEASURED names the folder that holds it")
    return Path(MEASURED) / name


def test_the_documented_chicken_skin_is_imported(tmp_path):
    """240 nodes of about 44 x 37 mm; the grasped corner moves most; 30 declared fixed nodes, none of them grasped."""
    summary = import_folder(measured("chicken_skin"), DOCUMENTED / "chicken_skin.toml", tmp_path / "run.mcap")
    recording = Recording.open(summary.recording)
    seen = list(recording)
    assert (summary.n_frames, summary.n_points, summary.n_unseen, summary.n_attached) == (4, 240, 2, 30)
    rest = seen[0].points.positions
    assert np.allclose(np.ptp(rest, axis=0)[:2], [0.044, 0.037], atol=1e-3)
    held = list(seen[0].tool.held_tracks)
    assert held == [26, 40, 41, 56]
    truth = read_truth(summary.truth)
    for observation in seen[1:]:
        moved = np.linalg.norm(observation.points.positions - rest, axis=1)
        assert np.median(moved[held]) > 2 * np.nanmedian(moved)
    assert len(truth.rest) == 240 and not truth.attached[held].any()
    assert recording.declaration.gravity == (0, 0, 0) and not recording.declaration.bed


def test_the_documented_rubber_strip_reaches_both_grips(tmp_path):
    """The mesh goes from -70 to 20 mm; the view from -43 to 5.5 mm; displacement there extrapolates to the pull.

    A line through displacement over station reaches 0 at the stated hold and the full 19 mm at the stated grip, to
    1 mm: the strip stretches nearly evenly.
    """
    summary = import_folder(measured("rubber_strip"), DOCUMENTED / "rubber_strip.toml", tmp_path / "run.mcap")
    recording = Recording.open(summary.recording)
    mesh, seen = recording.declaration.mesh, list(recording)
    assert (summary.n_frames, summary.n_points, summary.n_unseen) == (20, 435, 2)
    assert np.isclose(mesh.vertices[:, 0].min(), -0.070, atol=1e-3)
    assert np.isclose(mesh.vertices[:, 0].max(), 0.020, atol=1e-3)
    assert sorted(mesh.track_id[mesh.track_id >= 0]) == list(range(435))
    assert (mesh.track_id[mesh.held] == -1).all() and mesh.held.sum() >= 5
    axis = np.array([0.968, -0.031, 0.249]) / np.linalg.norm([0.968, -0.031, 0.249])
    np.testing.assert_allclose(seen[19].tool.position - seen[0].tool.position, 0.019 * axis, atol=1e-9)
    rest, last = seen[0].points.positions, seen[19].points.positions
    slope, offset = np.polyfit(rest[:, 0], (last - rest) @ axis, 1)
    assert -offset / slope == pytest.approx(-0.054, abs=1e-3)
    assert (0.019 - offset) / slope == pytest.approx(0.016, abs=1e-3)
    truth = read_truth(summary.truth)
    assert truth.rest[truth.attached, 0].max() < -0.053 and not (truth.attached & mesh.held).any()


def test_measured_data_is_left_as_it_was(tmp_path):
    """The importer writes beside `out` only; the folder may be read-only."""
    where = folder(tmp_path)
    before = sorted((path.name, path.read_bytes()) for path in where.iterdir())
    import_folder(where, None, tmp_path / "run.mcap")
    assert sorted((path.name, path.read_bytes()) for path in where.iterdir()) == before
