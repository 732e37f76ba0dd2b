"""What kind of file holds points: by its first bytes, then by its name."""

import re
from pathlib import Path
from typing import Literal

from ...errors import RecordingError
from ..data_folder import quoted

FileKind = Literal["text", "npz", "npy", "mat", "ply", "obj", "pcd"]
HEAD_BYTES = 4096
"""Bytes of a file's beginning that tell its kind."""
MAX_FILE_BYTES = 2**28
"""Size above which a file is refused [bytes]: twice what the largest accepted positions need."""
MAX_POSITION_BYTES = 2**27
"""Size above which positions are refused [bytes of 64-bit floats]: 5.6 million points, summed over the frames, of which
an import holds a few copies."""
BYTES_PER_POINT = 24
"""Three coordinates of 64 bits [bytes]."""
SAVE_AS = "save the points as text, .npz, .npy, .ply, .obj or .pcd"
"""What to do with a file of another kind."""
SAVE_MESH_AS = "save the mesh of each frame as .ply or .obj, whose vertices are the points, in one order"
"""What to do with a mesh of another kind."""

MAGIC: tuple[tuple[bytes, FileKind], ...] = (
    (b"\x93NUMPY", "npy"),
    (b"ply\n", "ply"),
    (b"ply\r", "ply"),
    (b"# .PCD", "pcd"),
    (b"MATLAB 5.0", "mat"),
)
"""First bytes of kinds that are read."""
FOREIGN_MAGIC = (
    (b"\x89HDF", "an HDF5 file (MATLAB 7.3 writes them: save with -v7)"),
    (b"\x1f\x8b", "compressed by gzip: unpack it"),
    (b"\xd0\xcf\x11\xe0", "an old Office file: save the sheet as CSV"),
    (b"\x80\x02", "a Python pickle, which can run code when it is read"),
    (b"\x80\x03", "a Python pickle, which can run code when it is read"),
    (b"\x80\x04", "a Python pickle, which can run code when it is read"),
    (b"\x80\x05", "a Python pickle, which can run code when it is read"),
    (b"LASF", "a LAS cloud"),
    (b"\x89MCAP", "an MCAP recording, not a file of points"),
    (b"%PDF", "a PDF"),
)
"""First bytes of kinds that are named when they are refused."""
MESH_MAGIC = (
    (b"# vtk", "a VTK file"),
    (b"solid ", "an STL mesh, whose corners have no identity"),
    (b"glTF", "a glTF mesh"),
)
"""First bytes of meshes that are named when they are refused."""
MESH_SUFFIXES = frozenset(".stl .off .gltf .glb .vtk .vtp .vtu .fbx .dae .3ds".split())
"""Names of meshes that are not read."""
FOREIGN_SUFFIXES = frozenset(
    ".las .laz .e57 .c3d .h5 .hdf5 .pkl .pickle .json .yaml .toml .parquet "
    ".feather .bag .mcap .db3 .png .jpg .tif .tiff .mp4 .avi .zip .gz .xls .doc .html .xml".split()
)
"""Names of files that hold no table of points, or not in a form that is read."""
OBJ_VERTEX = re.compile(rb"^v[ \t]+[-+.\d]", re.MULTILINE)
"""A line that only an OBJ has."""


def refuse_many(n_frames: int, n_points: int) -> None:
    """Refuse frames whose positions would take more than `MAX_POSITION_BYTES`.

    Raises:
        RecordingError: they would.
    """
    if n_frames * n_points * BYTES_PER_POINT > MAX_POSITION_BYTES:
        raise RecordingError(
            f"{n_frames} frames of {n_points} points are more than the {MAX_POSITION_BYTES // BYTES_PER_POINT} "
            "positions that are read: split the recording, or keep fewer points or frames."
        )


def file_kind(path: Path) -> FileKind:
    """Return the kind of a file of points.

    Raises:
        RecordingError: the file is missing, empty, too large, no regular file, cannot be read, or of a kind that is not
            read.
    """
    try:
        size, regular = path.stat().st_size, path.is_file()
        head = b""
        if regular:
            with path.open("rb") as stream:
                head = stream.read(HEAD_BYTES)
    except (OSError, ValueError) as failure:
        raise RecordingError(
            f"{quoted(path)} cannot be read: {quoted(getattr(failure, 'strerror', None) or failure)}."
        ) from failure
    if not regular:
        raise RecordingError(f"{path} is {'a folder' if path.is_dir() else 'no regular file'}; name a file of points.")
    if size == 0:
        raise RecordingError(f"{path} is empty; it must hold points.")
    if size > MAX_FILE_BYTES:
        raise RecordingError(f"{path} has {size} bytes; at most {MAX_FILE_BYTES} are read: split the recording.")
    for magic, kind in MAGIC:
        if head.startswith(magic):
            return kind
    for magic, what in FOREIGN_MAGIC:
        if head.startswith(magic):
            raise RecordingError(f"{path} is {what}; {SAVE_AS}.")
    for magic, what in MESH_MAGIC:
        if head.startswith(magic):
            raise RecordingError(f"{path} is {what}; {SAVE_MESH_AS}.")
    return _kind_by_name(path, head)


def _kind_by_name(path: Path, head: bytes) -> FileKind:
    suffix = path.suffix.lower()
    if head.startswith(b"PK") and suffix != ".zip":
        if suffix in (".xlsx", ".ods", ".xlsm", ".docx"):
            raise RecordingError(f"{path} is an Office file: save the sheet as CSV.")
        return "npz"
    if suffix in (".npz", ".npy", ".mat", ".ply"):
        raise RecordingError(f"{path} cannot be read as {suffix}: it does not begin as one; {SAVE_AS}.")
    if suffix in MESH_SUFFIXES:
        raise RecordingError(f"{path} is named {suffix}, a mesh that is not read; {SAVE_MESH_AS}.")
    if suffix in FOREIGN_SUFFIXES:
        raise RecordingError(f"{path} is named {suffix}, which is not read as points; {SAVE_AS}.")
    if suffix == ".pcd":
        return "pcd"
    return "obj" if suffix == ".obj" or OBJ_VERTEX.search(head) else "text"
