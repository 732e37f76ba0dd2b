"""Arrays of numbers in MATLAB's .mat files of versions 5 to 7.

Read here, since scipy's reader writes over memory where a file is damaged, and ends the process. Structures, cells,
texts, sparse and complex arrays are left out. Source: "MAT-File Format", MathWorks, version 5.
"""

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from .file_kinds import MAX_POSITION_BYTES

HEADER_BYTES = 128
"""Length of the header; its last two bytes give the byte order."""
MATRIX, COMPRESSED = 14, 15
"""Types of the elements that hold an array, and a compressed one."""
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""Numpy's type for each type of numbers in the file."""
CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
"""Numpy's type for each class of array, whose numbers may be stored as smaller ones."""
LOGICAL, COMPLEX = 0x200, 0x800
"""Flags of an array."""
OTHER_CLASSES = {1: "cells", 2: "structures", 3: "objects", 4: "text", 5: "a sparse matrix: save full(...)"}
"""What arrays of classes without plain numbers hold."""


def mat_arrays(path: Path) -> Iterator[tuple[str, Shaped[np.ndarray, "..."]]]:
    """Yield name and numbers of each array of numbers.

    Raises:
        ValueError, struct.error, zlib.error: the file is damaged, or holds too much.
    """
    for payload, order in _matrices(path):
        bits = _flags(payload, order)
        if bits & 0xFF in CLASSES and not bits & COMPLEX:
            yield _array(payload, order, bits)


def mat_others(path: Path) -> dict[str, str]:
    """Return what each array without plain numbers holds, by its name.

    Raises:
        ValueError, struct.error, zlib.error: the file is damaged, or holds too much.
    """
    found: dict[str, str] = {}
    for payload, order in _matrices(path):
        bits, parts = _flags(payload, order), list(_elements(payload, order))
        if bits & 0xFF in OTHER_CLASSES or bits & COMPLEX:
            name = parts[2][1].decode("ascii", "replace") if len(parts) > 2 else ""
            found[name] = OTHER_CLASSES.get(bits & 0xFF, "complex numbers")
    return found


def _matrices(path: Path) -> Iterator[tuple[bytes, str]]:
    """Yield bytes and byte order of each array."""
    data = path.read_bytes()
    order = ">" if data[HEADER_BYTES - 2 : HEADER_BYTES] == b"MI" else "<"
    for kind, payload in _elements(data[HEADER_BYTES:], order):
        if kind == COMPRESSED:
            kind, payload = next(_elements(_inflated(payload), order), (0, b""))
        if kind == MATRIX:
            yield payload, order


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Yield type and bytes of each element; a short one has its length in the upper half of its type."""
    place = 0
    while place + 8 <= len(data):
        kind, length = struct.unpack_from(f"{order}II", data, place)
        short = kind >> 16
        begin, length = (place + 4, short) if short else (place + 8, length)
        if begin + length > len(data) or short > 4:
            raise ValueError("an element is longer than the file")
        yield kind & 0xFFFF, data[begin : begin + length]
        place = place + 8 if short else begin + length + (0 if kind == COMPRESSED else -length % 8)


def _inflated(payload: bytes) -> bytes:
    inflater = zlib.decompressobj()
    data = inflater.decompress(payload, MAX_POSITION_BYTES)
    if inflater.unconsumed_tail:
        raise ValueError(f"an array has more than {MAX_POSITION_BYTES} bytes once unpacked")
    if not inflater.eof:
        raise ValueError("a compressed array ends early")
    return data


def _flags(payload: bytes, order: str) -> int:
    """Return class and flags of an array."""
    _, flags = next(_elements(payload, order), (0, b""))
    return struct.unpack_from(f"{order}I", flags)[0]


def _array(payload: bytes, order: str, bits: int) -> tuple[str, Shaped[np.ndarray, "..."]]:
    """Return name and numbers of an array with those flags."""
    parts = _elements(payload, order)
    next(parts, None)
    shape = np.frombuffer(next(parts, (0, b""))[1], f"{order}i4").tolist()
    name = next(parts, (0, b""))[1].decode("ascii")
    kind, numbers = next(parts, (0, b""))
    if kind not in TYPES or any(length < 0 for length in shape):
        raise ValueError(f"an array has no numbers of a known type, or a negative length in {shape}")
    values = np.frombuffer(numbers, f"{order}{TYPES[kind]}")
    if len(values) * 8 > MAX_POSITION_BYTES:
        raise ValueError(f"an array has {len(values)} numbers, which is too much")
    if math.prod(shape) != len(values):
        raise ValueError(f"an array of shape {shape} has {len(values)} numbers")
    with np.errstate(invalid="ignore"):
        array = values.astype(CLASSES[bits & 0xFF]).reshape(shape, order="F")
    return name, array.astype(bool) if bits & LOGICAL else array
