"""Small valid files of every kind that can be imported, each with the import that reads it, to be damaged."""

import io
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import trimesh
from scipy.io import savemat

from jiggle_mj.importing.bags.importer import import_bag
from jiggle_mj.importing.folder import import_folder
from tests.support.measured_folder import GRID_FACES, TOML, grid
from tests.support.robot_bags import Kind, small_bag
from tests.support.valid_files import Reader

FILES = 'files = ["rest.xyz", "pulled_*.xyz"]'


def _written(write: Callable[..., object], *arguments: object, **arrays: object) -> bytes:
    buffer = io.BytesIO()
    write(buffer, *arguments, **arrays)
    return buffer.getvalue()


POINTS = grid() + 0.125
FRAMES = np.stack([POINTS, POINTS + 1])
CSV = "id,X,Y,Z,sigma\n" + "\n".join(f"{i},{x},{y},{z},0.01" for i, (x, y, z) in enumerate(POINTS))
MESH = trimesh.Trimesh(POINTS, GRID_FACES, process=False)
PCD = b"VERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nWIDTH 12\nHEIGHT 1\nPOINTS 12\nDATA binary\n"
POINT_FILES = {
    "text.csv": (CSV.encode(), 'columns = ["X", "Y", "Z"]\nmissing = "sigma < 0"'),
    "blanks.xyz": (_written(np.savetxt, POINTS), ""),
    "frames.npz": (_written(np.savez, p=FRAMES, v=np.ones((2, 12), bool)), 'key = "p"\nvisibility = "v"'),
    "packed.npz": (_written(np.savez_compressed, p=FRAMES), 'key = "p"'),
    "frames.npy": (_written(np.save, FRAMES), ""),
    "frames.mat": (_written(savemat, {"p": FRAMES}), 'key = "p"'),
    "text.ply": (MESH.export(file_type="ply", encoding="ascii"), ""),
    "binary.ply": (MESH.export(file_type="ply"), ""),
    "mesh.obj": (str(MESH.export(file_type="obj")).encode(), ""),
    "cloud.pcd": (PCD + POINTS.tobytes(), ""),
}
"""A small valid file of each kind, and the keys by which it is read."""


def points_folder(where: Path, name: str) -> Reader:
    """Return the import of a folder with one file of points, to be damaged."""
    data, keys = POINT_FILES[name]
    where = where / name.replace(".", "_")
    where.mkdir()
    (where / name).write_bytes(data)
    (where / "recording.toml").write_text(TOML.replace(FILES, f'files = ["{name}"]\n{keys}'))
    return Reader(path=where / name, read=_folder_import(where), valid=data)


def described_folder(where: Path) -> Reader:
    """Return the import of a folder whose recording.toml is to be damaged."""
    where = where / "described"
    where.mkdir()
    times = [0.0, 1.0]
    np.savez(where / "points.npz", p=FRAMES, v=np.ones((2, 12), bool), tool=FRAMES[:, 0], tool_time=times, t=times)
    keys = 'files = ["points.npz"]\nkey = "p"\nvisibility = "v"\nmissing = [0.0, 0.0, 0.0]\ntimes = "t"'
    tool = 'tool = "tool"\ntool_times = "tool_time"\ntool_unit = "mm"\ntool_clock_offset = 0.0\nradius = 0.002'
    toml = TOML.replace(FILES, keys).replace("period = 0.5\n", "")
    toml = toml.replace("[grasp]", f"[mesh]\nmargin = 0.004\n[grasp]\n{tool}")
    (where / "recording.toml").write_text(toml)
    return Reader(path=where / "recording.toml", read=_folder_import(where), valid=toml.encode())


def bag(where: Path, kind: Kind) -> Reader:
    """Return the import of a small bag of images, camera, tool and gripper."""
    path = small_bag(where / kind, kind)
    if path.is_dir():
        path = next(file for file in path.iterdir() if file.name != "metadata.yaml")
    out = where / "run.mcap"
    return Reader(path=path, read=lambda: import_bag(path, out, overwrite=True), valid=path.read_bytes())


def _folder_import(where: Path) -> Callable[[], object]:
    return lambda: import_folder(where, None, where / "run.mcap", overwrite=True)


IMPORTS: dict[str, Callable[[Path], Reader]] = {
    "recording.toml": described_folder,
    **{name: partial(points_folder, name=name) for name in POINT_FILES},
    "ros1": partial(bag, kind="ros1"),
    "ros2": partial(bag, kind="mcap"),
    "sqlite3": partial(bag, kind="sqlite3"),
}
"""Each import by the name of its file or bag."""
