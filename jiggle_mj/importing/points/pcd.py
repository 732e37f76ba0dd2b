"""Point clouds of the Point Cloud Library, .pcd: text and binary.

Source: "The PCD (Point Cloud Data) file format", pointclouds.org, version 0.7.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from ...errors import RecordingError
from ..data_folder import quoted
from .archives import damage_refused
from .cells import parse_cell
from .file_kinds import MAX_POSITION_BYTES

HEADER_KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
"""Keys of the header, in their order; DATA is the last."""
MAX_HEADER_LINES = 100
"""Lines in which the header must end, comments included."""
KINDS = {"F": "f", "I": "i", "U": "u"}
"""Numpy's letter for each type of a field."""


def read_pcd(path: Path) -> Float[np.ndarray, "n 3"]:
    """Return the points of a cloud in their order; NaN for those that were not measured.

    Raises:
        RecordingError: the file is damaged, compressed, too large, or has no fields x, y, z.
    """
    with damage_refused(path, ".pcd"):
        data = path.read_bytes()
        header, body = _header(path, data)
        fields, kind = header["FIELDS"], header["DATA"][0].lower()
        sizes = [int(size) for size in header["SIZE"]]
        counts = [int(count) for count in header.get("COUNT", ["1"] * len(fields))]
        points = int(header["POINTS"][0]) if "POINTS" in header else int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
        if not {"x", "y", "z"} <= set(fields):
            raise RecordingError(f"{path} has the fields {quoted(' '.join(fields))}; x, y and z are needed.")
        if not 0 < points <= MAX_POSITION_BYTES // 24:
            raise RecordingError(f"{path} declares {points} points; 1 to {MAX_POSITION_BYTES // 24} are read.")
        if kind == "ascii":
            return _text(body, fields, counts, points)
        if kind != "binary":
            raise RecordingError(
                f"{path} has DATA {quoted(kind)}; write it as ascii or binary: pcl_convert_pcd_ascii_binary IN OUT 1."
            )
        letters = [KINDS[letter.upper()] for letter in header["TYPE"]]
        record = np.dtype(
            [
                (f"{name}#{number}" if name == "_" else name, f"<{letter}{size}", (count,))
                for number, (name, letter, size, count) in enumerate(zip(fields, letters, sizes, counts, strict=True))
            ]
        )
        rows = np.frombuffer(body, record, count=points)
        return np.column_stack([rows[axis][:, 0].astype(float) for axis in "xyz"])


def _header(path: Path, data: bytes) -> tuple[dict[str, list[str]], bytes]:
    """Return the header's words by key, and what follows it."""
    header: dict[str, list[str]] = {}
    for _ in range(MAX_HEADER_LINES):
        line, _, data = data.partition(b"\n")
        words = line.decode("ascii", "replace").split()
        if words and words[0] in HEADER_KEYS and len(words) > 1:
            header[words[0]] = words[1:]
            if words[0] == "DATA":
                return header, data
    raise RecordingError(f"{path} cannot be read as .pcd: its header has no DATA.")


def _text(body: bytes, fields: list[str], counts: list[int], points: int) -> Float[np.ndarray, "n 3"]:
    begins = np.concatenate([[0], np.cumsum(counts)])
    columns = [int(begins[fields.index(axis)]) for axis in "xyz"]
    rows = [line.split() for line in body.decode("ascii").splitlines() if line.strip()]
    if len(rows) != points or any(len(row) != begins[-1] for row in rows):
        raise ValueError(f"the header declares {points} rows of {begins[-1]} numbers; the file has others")
    return np.array([[parse_cell(row[column], ".") for column in columns] for row in rows])
