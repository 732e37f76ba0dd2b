"""The metadata record of a file, and the user's declaration of the tissue.

A declared mesh is an npz attachment, everything else JSON in metadata records.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import fields, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
from mcap.records import Attachment

from ..argument_checks import quoted
from ..errors import RecordingError
from ..observation import MAX_PARTICLES, Declaration, DeclaredMesh
from ..toml_kinds import MAX_COUNT, flag, number, numbers, positive, table, vector
from .json_values import entry, parse_object
from .mcap_files import McapOutput, read_arrays
from .stored_arrays import StoredArrays

METADATA, DECLARATION, DECLARED_MESH = "jiggle_mj", "jiggle_mj.declaration", "declared_mesh.npz"
"""Names of two metadata records and of an attachment."""
FORMAT = "1"
"""Version of the layout that docs/RECORDINGS.md describes."""
VERSION = "version.jiggle-mj"
"""Key of this package's version in the metadata."""
KINDS = {
    "membrane_stiffness": positive,
    "poisson": number,
    "thickness": positive,
    "areal_density": positive,
    "gravity": vector,
    "bed": flag,
    "effects": table,
}
"""Kind of each field of a declaration but its mesh."""
IDENTITY_DIGITS = 16
"""Hexadecimal digits of an identity: 64 bits, so that no two of a million recordings are likely to share one."""


def file_metadata() -> dict[str, str]:
    """Return what every file states of its making: format, units and versions; no date."""
    packages = ("jiggle-mj", "numpy", "mcap", "foxglove-schemas-protobuf", "opencv-python-headless")
    return {"format": FORMAT, "units": "SI (m, N, s), time in ns"} | {f"version.{p}": version(p) for p in packages}


def version_entry() -> dict[str, str]:
    """Return the entry of `file_metadata` that states the version of this package."""
    return {VERSION: file_metadata()[VERSION]}


def is_current(written: Mapping[str, object]) -> bool:
    """Return whether this version of the package wrote something that holds the entry of `version_entry`."""
    return written.get(VERSION) == version_entry()[VERSION]


def identity(*parts: object) -> str:
    """Return the identity of a recording: `IDENTITY_DIGITS` digits of the SHA-256 of arrays and JSON values."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part.tobytes() if isinstance(part, np.ndarray) else json.dumps(part, sort_keys=True).encode())
    return digest.hexdigest()[:IDENTITY_DIGITS]


def write_declaration(output: McapOutput, declaration: Declaration) -> None:
    """Write a declaration, and its mesh where it has one."""
    values = {f.name: getattr(declaration, f.name) for f in fields(declaration) if f.name not in ("mesh", "effects")}
    if declaration.effects:
        values["effects"] = dict(declaration.effects)
    output.metadata(DECLARATION, {"json": json.dumps(values, sort_keys=True, allow_nan=False)})
    if declaration.mesh is not None:
        arrays = {f.name: getattr(declaration.mesh, f.name) for f in fields(declaration.mesh)}
        output.arrays(DECLARED_MESH, {name: np.asarray(array) for name, array in arrays.items() if array is not None})


def parse_declaration(text: str) -> Declaration:
    """Return the declaration in a metadata record, without its mesh.

    Raises:
        RecordingError: not JSON, an unknown field, or a value that `Declaration` refuses.
    """
    where = "the recording's declaration"
    values = parse_object(text, where)
    unknown = sorted(set(values) - set(KINDS))
    if unknown:
        raise RecordingError(f"{where} has the unknown key {quoted(unknown[0])}; known: {', '.join(KINDS)}.")
    known = {name: entry(values, name, KINDS[name], where) for name in values}
    if "gravity" in known:
        known["gravity"] = tuple(known["gravity"])
    if "effects" in known:
        effects = known["effects"]
        known["effects"] = {name: tuple(entry(effects, name, numbers, f"{where}: effects")) for name in effects}
    try:
        return Declaration(**known)
    except ValueError as failure:
        raise RecordingError(f"{where} cannot be used: {failure}") from failure


def with_mesh(declaration: Declaration, attachment: Attachment, path: Path) -> Declaration:
    """Return the declaration with the mesh of an attachment.

    Raises:
        RecordingError: the attachment lacks an array, holds an unknown one, or one of a wrong shape, type or range.
    """
    arrays = StoredArrays(read_arrays(attachment, path), f"{path}: {DECLARED_MESH}")
    required, known = {"vertices", "faces", "track_id"}, {"vertices", "faces", "track_id", "held"}
    if not all(name in arrays for name in required) or not arrays.only(known):
        raise RecordingError(
            f"{path}: {DECLARED_MESH} must hold vertices, faces, track_id and perhaps held; it has {arrays.names()}."
        )
    vertices = arrays.positions("vertices", (None, 3), finite=True)
    n = len(vertices)
    if n > MAX_PARTICLES:
        raise RecordingError(f"{path}: the declared mesh has {n} vertices; at most {MAX_PARTICLES} can be estimated.")
    mesh = DeclaredMesh(
        vertices=vertices,
        faces=arrays.indices("faces", (None, 3), below=n),
        track_id=arrays.indices("track_id", (n,), from_=-1, below=MAX_COUNT),
        held=arrays.flags("held", (n,)) if "held" in arrays else None,
    )
    return replace(declaration, mesh=mesh)
