"""Points in PLY, OBJ, PCD, .npy and .mat files, faces in mesh files, and the order of frame files."""

import numpy as np
import pytest
import trimesh
from scipy.io import savemat

from jiggle_mj.errors import RecordingError
from tests.support.measured_folder import GRID_FACES, TOML, bring_in, folder, grid

FILES = 'files = ["rest.xyz", "pulled_*.xyz"]'
FLOAT32 = 1e-6
"""Relative rounding of files that hold 32-bit floats."""


def frames() -> list[np.ndarray]:
    """The grid at rest and with a corner that is lifted, off whole numbers [mm]."""
    lifted = grid() + 0.125
    lifted[:2, 2] += 3
    return [grid() + 0.125, lifted, lifted + 0.5]


def pcd(points: np.ndarray, kind: str) -> bytes:
    header = (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS rgb x _ y z\nSIZE 4 4 1 4 4\nTYPE U F U F F\nCOUNT 1 1 3 1 1\n"
        f"WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA {kind}\n"
    ).encode()
    if kind == "ascii":
        return header + "\n".join(f"7 {x} 0 0 0 {y} {z}" for x, y, z in points).encode()
    record = np.dtype([("c", "<u4"), ("x", "<f4"), ("p", "u1", 3), ("y", "<f4"), ("z", "<f4")])
    rows = np.zeros(len(points), record)
    rows["x"], rows["y"], rows["z"] = points.T
    return header + rows.tobytes()


def ply(points: np.ndarray, encoding: str) -> bytes:
    mesh = trimesh.Trimesh(points, GRID_FACES, process=False)
    exported = mesh.export(file_type="ply", encoding=encoding)
    assert isinstance(exported, bytes)
    return exported


def obj(points: np.ndarray) -> bytes:
    lines = ["# sheet", "mtllib none.mtl", "o sheet", *(f"v {x} {y} {z}" for x, y, z in points), "vn 0 0 1", "vt 0 0"]
    return "\n".join([*lines, *(f"f {a + 1}/1/1 {b - 12}/1/1 {c + 1}/1/1" for a, b, c in GRID_FACES)]).encode()


WRITERS = {
    "ascii.ply": lambda points: ply(points, "ascii"),
    "binary.ply": lambda points: ply(points, "binary"),
    "cloud.ply": lambda points: trimesh.PointCloud(points).export(file_type="ply"),
    "obj": obj,
    "ascii.pcd": lambda points: pcd(points, "ascii"),
    "binary.pcd": lambda points: pcd(points, "binary"),
    "named.xyz": lambda points: ply(points, "ascii"),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_vertices_of_meshes_and_clouds_are_points_in_their_order(tmp_path, kind):
    where = folder(tmp_path, toml=TOML.replace(FILES, f'files = ["f_*.{kind}"]'))
    for number, points in enumerate(frames()):
        (where / f"f_{number}.{kind}").write_bytes(WRITERS[kind](points))
    _, recording = bring_in(where)
    for observation, points in zip(recording, frames(), strict=True):
        np.testing.assert_allclose(observation.points.positions, points * 1e-3, rtol=FLOAT32)


@pytest.mark.parametrize("kind", ["d.npy", "d_*.npy", "d.mat"])
def test_arrays_are_read_without_an_archive_of_numpy(tmp_path, kind):
    key = '\nkey = "p"' if kind.endswith(".mat") else ""
    where = folder(tmp_path, toml=TOML.replace(FILES, f'files = ["{kind}"]{key}'))
    np.save(where / "d.npy", np.stack(frames()))
    for number, points in enumerate(frames()):
        np.save(where / f"d_{number}.npy", points)
    savemat(where / "d.mat", {"p": np.stack(frames()), "text": "no array"}, do_compression=True)
    _, recording = bring_in(where)
    found = np.stack([observation.points.positions for observation in recording])
    np.testing.assert_allclose(found, np.stack(frames()) * 1e-3, rtol=FLOAT32)


@pytest.mark.parametrize("kind", ["obj", "binary.ply"])
@pytest.mark.parametrize("order", ["same", "reversed"])
def test_faces_of_a_mesh_file_join_the_points_at_its_vertices(tmp_path, kind, order):
    """In another order they are matched by place; the same triangles come out of both."""
    where = folder(tmp_path, toml=TOML.replace("[grasp]", f'[mesh]\nfaces = "mesh.{kind}"\n[grasp]'))
    (where / f"mesh.{kind}").write_bytes(WRITERS[kind](grid() + 0.01))
    expected = {frozenset(face) for face in GRID_FACES}
    if order == "reversed":
        for path in where.glob("*.xyz"):
            np.savetxt(path, np.loadtxt(path)[::-1])
        expected = {frozenset(11 - corner for corner in face) for face in GRID_FACES}
    summary, recording = bring_in(where)
    mesh = recording.declaration.mesh
    assert {frozenset(face) for face in mesh.track_id[mesh.faces].tolist()} == expected
    assert len(summary.notes) == (order == "reversed")


def test_a_mesh_of_other_points_is_refused(tmp_path):
    where = folder(tmp_path, toml=TOML.replace("[grasp]", '[mesh]\nfaces = "mesh.obj"\n[grasp]'))
    (where / "mesh.obj").write_bytes(obj(np.random.default_rng(0).uniform(0, 6, (12, 3))))
    with pytest.raises(RecordingError, match="12 vertices, which are not the 12 points"):
        bring_in(where)


def test_faces_that_join_distant_points_are_refused(tmp_path):
    """Rows in a random order: half of the edges cross the sheet."""
    x, y = np.meshgrid(np.arange(8.0), np.arange(8.0))
    points = np.column_stack([x.ravel(), y.ravel(), np.full(64, 5.0)])
    faces = [(i, i + 1, i + 8) for i in range(55) if i % 8 < 7]
    shuffled = np.random.default_rng(0).permutation(64)
    where = folder(tmp_path, toml=TOML.replace("[grasp]", '[mesh]\nfaces = "faces.txt"\n[grasp]'))
    for name in ("rest", "pulled_1", "pulled_2"):
        np.savetxt(where / f"{name}.xyz", points[shuffled])
    np.savetxt(where / "faces.txt", faces, fmt="%d")
    with pytest.raises(RecordingError, match="join points that are far apart"):
        bring_in(where)


def test_faces_that_count_from_one_are_asked_for(tmp_path):
    where = folder(tmp_path, toml=TOML.replace("[grasp]", '[mesh]\nfaces = "faces.txt"\n[grasp]'))
    np.savetxt(where / "faces.txt", np.array(GRID_FACES) + 1, fmt="%d")
    with pytest.raises(RecordingError, match="probably count from 1; give first_vertex = 1"):
        bring_in(where)


ORDERED = (
    "f_9 f_10 f_11",
    "f_09 f_10 f_11",
    "f-1 f-2 f-10",
    "f.9 f.10 f.11",
    "t0.5 t1 t1.5",
    "f9_t0.5 f10_t1.0 f11_t1.5",
    "2024-01-31 2024-02-01 2024-10-01",
    "2024-01-31_10-59-58 2024-01-31_11-00-01 2024-02-01_00-00-00",
    "20240131_235958 20240201_000001 20240201_000002",
)
"""Names in the order of time, which they state."""
UNCLEAR = (
    ("f-1 f0 f1", "differ in more than a number"),
    ("t10ms t1s t2s", "differ in more than a number"),
    ("t1e-3 t2e-3 t1e-2", "differ in more than a number"),
    ("t12am t1am t2am", "differ in more than a number"),
    ("f_one f_two f_three", "differ in more than a number"),
    ("f1 f2 f2(1)", "differ in more than a number"),
    ("f1 f01 f2", "have the same number"),
    ("30-01-2024 31-01-2024 01-02-2024", "several numbers"),
    ("a2_f9 a2_f10 a10_f1", "several numbers"),
    ("t_0.5 t_0.25 t_1.0", "different counts of decimals"),
)
"""Names whose order is a guess, and what the refusal says."""


def named(tmp_path, names: str):
    """A folder whose frames have those names."""
    where = folder(tmp_path, toml=TOML.replace(FILES, 'files = ["[aft023]*"]'))
    for name, points in zip(names.split(), frames(), strict=True):
        np.savetxt(where / (name if name.startswith("f.") else f"{name}.xyz"), points)
    return where


@pytest.mark.parametrize("names", ORDERED)
def test_frame_files_are_in_the_order_of_their_numbers(tmp_path, names):
    where = named(tmp_path, names)
    by_name = sorted(path.name for path in where.glob("[aft023]*"))
    summary, recording = bring_in(where)
    assert [observation.points.positions[0, 2] for observation in recording] == [5.125e-3, 8.125e-3, 8.625e-3]
    reordered = [name.removesuffix(".xyz") for name in by_name] != names.split()
    assert [note.partition(":")[0] for note in summary.notes] == [
        "frames are in the order of their numbers"
    ] * reordered


@pytest.mark.parametrize(("names", "why"), UNCLEAR)
def test_names_without_a_clear_order_are_refused_with_the_cure(tmp_path, names, why):
    with pytest.raises(RecordingError, match=f"{why}.*list them in the order of time in .points. files"):
        bring_in(named(tmp_path, names))


def test_a_list_in_the_order_of_names_is_kept_and_said(tmp_path):
    where = folder(tmp_path, toml=TOML.replace(FILES, 'files = ["f_1.xyz", "f_10.xyz", "f_2.xyz"]'))
    for name, points in zip((1, 2, 10), frames(), strict=True):
        np.savetxt(where / f"f_{name}.xyz", points)
    assert bring_in(where)[0].notes == ("the order of [points] files is kept: f_10.xyz before f_2.xyz",)


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ('["rest.xyz", "r*.xyz"]', "names rest.xyz twice"),
        ('["sub"]', "is a folder"),
        ('["rest.xyz", "d.npy"]', "files of different kinds"),
        ('["short.pcd"]', r"cannot be read as \.pcd"),
        ('["packed.pcd"]', "write it as ascii or binary"),
        ('["bad.ply"]', r"cannot be read as \.ply: it declares 99999999999 elements"),
        ('["book.xlsx"]', "Office file"),
        ('["mesh.stl"]', r"is named \.stl, a mesh that is not read; save .* as \.ply or \.obj"),
        ('["d.npy"]\ncolumns = [0, 1, 2]', "are for text files"),
    ],
)
def test_what_is_no_file_of_points_is_refused(tmp_path, files, message):
    where = folder(tmp_path, toml=TOML.replace(FILES, f"files = {files}"))
    (where / "sub").mkdir()
    np.save(where / "d.npy", np.stack(frames()))
    (where / "short.pcd").write_bytes(pcd(grid(), "binary")[:-5])
    (where / "packed.pcd").write_bytes(pcd(grid(), "binary_compressed"))
    (where / "bad.ply").write_bytes(ply(grid(), "ascii").replace(b"vertex 12", b"vertex 99999999999"))
    (where / "mesh.stl").write_bytes(bytes(84))
    (where / "book.xlsx").write_bytes(b"PK\x03\x04")
    with pytest.raises(RecordingError, match=message):
        bring_in(where)
