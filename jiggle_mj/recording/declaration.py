"""What a recording says of itself and of the tissue: the metadata record and the user's declaration.

A declared mesh travels as an npz attachment, all else as JSON in metadata records.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import fields, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
from mcap.records import Attachment

from ..errors import RecordingError
from ..observation import Declaration, DeclaredMesh
from .mcap_files import McapOutput, read_arrays

METADATA, DECLARATION, MESH = "jiggle_mj", "jiggle_mj.declaration", "declared_mesh.npz"
FORMAT = "1"
VERSION = "version.jiggle-mj"


def file_metadata() -> dict[str, str]:
    """What every file says of its making: the format, units and versions; no date."""
    packages = ("jiggle-mj", "numpy", "mcap", "foxglove-schemas-protobuf", "opencv-python-headless")
    return {"format": FORMAT, "units": "SI (m, N, s), time in ns"} | {f"version.{p}": version(p) for p in packages}


def made_by() -> dict[str, str]:
    """The version of this package, as `file_metadata` has it."""
    return {VERSION: file_metadata()[VERSION]}


def is_current(written: Mapping[str, object]) -> bool:
    """Whether this version wrote something that holds what `made_by` says."""
    return written.get(VERSION) == made_by()[VERSION]


def identity(*parts: object) -> str:
    """A name for a recording, the same for the same contents: 16 hexadecimal digits over arrays and JSON values."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part.tobytes() if isinstance(part, np.ndarray) else json.dumps(part, sort_keys=True).encode())
    return digest.hexdigest()[:16]


def write_declaration(output: McapOutput, declaration: Declaration) -> None:
    """Write a declaration, and its mesh where it has one."""
    values = {f.name: getattr(declaration, f.name) for f in fields(declaration) if f.name != "mesh"}
    output.metadata(DECLARATION, {"json": json.dumps(values, sort_keys=True, allow_nan=False)})
    if declaration.mesh is not None:
        arrays = {f.name: getattr(declaration.mesh, f.name) for f in fields(declaration.mesh)}
        output.arrays(MESH, {name: np.asarray(array) for name, array in arrays.items() if array is not None})


def parse_declaration(text: str) -> Declaration:
    """The declaration in a metadata record, without its mesh.

    Raises:
        RecordingError: not JSON, an unknown field, or a value that `Declaration` refuses.
    """
    try:
        values = json.loads(text)
        if "gravity" in values:
            values["gravity"] = tuple(values["gravity"])
        return Declaration(**values)
    except (TypeError, ValueError) as failure:
        raise RecordingError(f"the recording's declaration cannot be read ({failure}): {text[:120]}") from failure


def with_mesh(declaration: Declaration, attachment: Attachment, path: Path) -> Declaration:
    """The declaration with the mesh of an attachment.

    Raises:
        RecordingError: the attachment lacks an array, or holds one that is not known.
    """
    arrays = read_arrays(attachment, path)
    try:
        return replace(declaration, mesh=DeclaredMesh(**arrays))
    except TypeError as failure:
        raise RecordingError(
            f"{path}: {MESH} must hold vertices, faces, track_id and perhaps held; it has {', '.join(arrays)}."
        ) from failure
