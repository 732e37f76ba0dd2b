"""Damaged files of points: whatever is changed in them, an import ends with one of the project's errors or well."""

import io
import tempfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from jiggle_mj.errors import MeshError, OutputError, RecordingError
from jiggle_mj.importing.folder import import_folder
from tests.support.measured_folder import GRID_FACES, TOML, grid

FILES = 'files = ["rest.xyz", "pulled_*.xyz"]'
OURS = (RecordingError, MeshError, OutputError)
"""What a user can correct."""
TRIES = 30
"""Mutations of each kind of file in the fast tests."""


def written(write, *arguments, **arrays) -> bytes:
    buffer = io.BytesIO()
    write(buffer, *arguments, **arrays)
    return buffer.getvalue()


POINTS = grid() + 0.125
FRAMES = np.stack([POINTS, POINTS + 1])
CSV = "id,X,Y,Z,sigma\n" + "\n".join(f"{i},{x},{y},{z},0.01" for i, (x, y, z) in enumerate(POINTS))
MESH = trimesh.Trimesh(POINTS, GRID_FACES, process=False)
PCD = b"VERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nWIDTH 12\nHEIGHT 1\nPOINTS 12\nDATA binary\n"
SEEDS = {
    "text.csv": (CSV.encode(), 'columns = ["X", "Y", "Z"]\nmissing = "sigma < 0"'),
    "blanks.xyz": (written(np.savetxt, POINTS), ""),
    "frames.npz": (
        written(np.savez, p=FRAMES, v=np.ones((2, 12), bool)),
        'key = "p"\nvisibility = "v"',
    ),
    "packed.npz": (written(np.savez_compressed, p=FRAMES), 'key = "p"'),
    "frames.npy": (written(np.save, FRAMES), ""),
    "frames.mat": (written(savemat, {"p": FRAMES}), 'key = "p"'),
    "text.ply": (MESH.export(file_type="ply", encoding="ascii"), ""),
    "binary.ply": (MESH.export(file_type="ply"), ""),
    "mesh.obj": (str(MESH.export(file_type="obj")).encode(), ""),
    "cloud.pcd": (PCD + POINTS.tobytes(), ""),
}
"""A small valid file of each kind, and the keys by which it is read."""
WORDS = [
    b"nan",
    b"1e999",
    b"-1",
    b"0",
    b"99999999999",
    b",",
    b";",
    b"\t",
    b"\n",
    b'"',
    b"\0",
    b"#",
    b"\xff\xfe",
    b"{",
    b"1,5",
]
"""What a mutation may insert."""


@st.composite
def mutated(draw: st.DrawFn, data: bytes) -> bytes:
    """The data with a few changes: bytes, words, parts that are cut out or doubled."""
    for _ in range(draw(st.integers(1, 4))):
        at, length = draw(st.integers(0, len(data))), draw(st.integers(0, 40))
        change = draw(st.sampled_from(["flip", "insert", "cut", "double", "end"]))
        if change == "flip" and at < len(data):
            data = data[:at] + bytes([draw(st.integers(0, 255))]) + data[at + 1 :]
        elif change == "insert":
            data = data[:at] + draw(st.sampled_from(WORDS)) + data[at:]
        elif change == "cut":
            data = data[:at] + data[at + length :]
        elif change == "double":
            data = data[: at + length] + data[at:]
        elif change == "end" and draw(st.booleans()):
            data = data[:at]
    return data


def try_import(name: str, data: bytes, keys: str, faces: str = "") -> None:
    with tempfile.TemporaryDirectory() as folder:
        where = Path(folder)
        (where / name).write_bytes(data)
        toml = TOML.replace(FILES, f'files = ["{name}"]\n{keys}').replace("[grasp]", f"{faces}[grasp]")
        (where / "recording.toml").write_text(toml)
        try:
            import_folder(where, None, where / "run.mcap")
        except OURS as refusal:
            assert "\n" not in str(refusal) and len(str(refusal)) < 1000, str(refusal)


@pytest.mark.parametrize("name", SEEDS)
def test_the_file_that_is_damaged_is_good(name):
    data, keys = SEEDS[name]
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / name).write_bytes(data)
        (Path(folder) / "recording.toml").write_text(TOML.replace(FILES, f'files = ["{name}"]\n{keys}'))
        assert import_folder(folder, None, Path(folder) / "run.mcap").n_points == 12


@pytest.mark.parametrize("name", SEEDS)
@settings(max_examples=TRIES, derandomize=True, deadline=None, database=None)
@given(draw=st.data())
def test_a_damaged_file_of_points_gives_none_but_our_errors(name, draw):
    data, keys = SEEDS[name]
    try_import(name, draw.draw(mutated(data)), keys)
