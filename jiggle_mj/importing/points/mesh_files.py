"""Vertices and triangles of PLY and OBJ meshes, in the order of the file.

PLY is read by trimesh. OBJ is read here: trimesh splits and renumbers vertices that have several normals or textures,
and a vertex's number is what identifies a point.
"""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from trimesh.exchange.ply import load_ply
from trimesh.geometry import triangulate_quads

from ...errors import RecordingError
from ..data_folder import quoted
from .archives import damage_refused
from .cells import parse_cell
from .text_lines import LINE_END, read_text

MAX_PLY_HEADER_BYTES = 10**5
"""Length in which a PLY's header must end."""


@dataclass(frozen=True, kw_only=True)
class MeshFile:
    """Contents of a mesh file."""

    vertices: Float[np.ndarray, "n 3"]
    """Positions, in the unit of the file; NaN for those that were not measured."""
    faces: Int[np.ndarray, "f 3"]
    """Triangles, by the numbers of their vertices from 0; larger polygons are split into fans."""


def read_ply(path: Path) -> MeshFile:
    """Return the contents of a PLY, text or binary.

    Raises:
        RecordingError: the file is damaged, or has no vertices.
    """
    with damage_refused(path, ".ply"):
        _check_ply_header(path)
        with path.open("rb") as stream:
            loaded = load_ply(stream, fix_texture=False, skip_materials=True)
        vertices = np.asarray(loaded.get("vertices", ()), dtype=np.float64)
        if vertices.ndim != 2 or vertices.shape[1] != 3:
            raise RecordingError(f"{path} has no vertices with x, y and z.")
        faces = loaded.get("faces")
        triangles = np.empty((0, 3), np.int64) if faces is None else np.asarray(triangulate_quads(faces))
        return MeshFile(vertices=vertices, faces=triangles.astype(np.int64).reshape(-1, 3))


def _check_ply_header(path: Path) -> None:
    """Refuse a header that does not end, or declares more elements than the file has bytes, or other than its lines."""
    data = path.read_bytes()
    size, end = len(data), data.find(b"end_header", 0, MAX_PLY_HEADER_BYTES)
    if end < 0:
        raise ValueError("its header does not end")
    header, declared = data[:end], 0
    for line in header.decode("ascii", "replace").splitlines():
        words = line.split()
        if words[:1] == ["element"] and not 0 <= int(words[2]) <= size:
            raise ValueError(f"it declares {quoted(words[2])} elements {quoted(words[1])} in {size} bytes")
        declared += int(words[2]) if words[:1] == ["element"] else 0
    lines = sum(1 for line in data[end:].splitlines()[1:] if line.strip()) if b"format ascii" in header else declared
    if lines != declared:
        raise ValueError(f"its header declares {declared} lines of elements, and {lines} follow")


def read_obj(path: Path) -> MeshFile:
    """Return the contents of an OBJ: its `v` lines as vertices, its `f` lines as triangles; all else is left out.

    Raises:
        RecordingError: the file is damaged, or has no vertices.
    """
    vertices: list[list[float]] = []
    faces: list[tuple[int, int, int]] = []
    for number, line in enumerate(LINE_END.split(read_text(path)), start=1):
        words = line.split()
        if not words or words[0] not in ("v", "f"):
            continue
        try:
            if words[0] == "v":
                x, y, z = (parse_cell(word, ".") for word in words[1:4])
                vertices.append([x, y, z])
            else:
                corners = [_vertex_number(word, len(vertices)) for word in words[1:]]
                faces += [(corners[0], second, third) for second, third in pairwise(corners[1:])]
        except (ValueError, OverflowError) as failure:
            raise RecordingError(
                f"{path} line {number}, '{quoted(line)}', is no vertex or face of an OBJ ({quoted(failure)})."
            ) from failure
    if not vertices:
        raise RecordingError(f"{path} has no vertices: an OBJ has a line 'v x y z' for each.")
    return MeshFile(vertices=np.array(vertices), faces=np.array(faces, dtype=np.int64).reshape(-1, 3))


def _vertex_number(word: str, n_vertices: int) -> int:
    """Return a vertex number from 0, of `v`, `v/vt`, `v//vn` or `v/vt/vn`; a negative one counts from the last."""
    number = int(word.split("/")[0])
    if number == 0 or number > 2**31:
        raise ValueError("vertices are numbered from 1")
    return number - 1 if number > 0 else n_vertices + number
