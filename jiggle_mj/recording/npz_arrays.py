"""Arrays from an npz archive, never pickled, with every size checked before memory is taken for it."""

import io
import struct
import tokenize
import zipfile
import zlib
from math import prod

import numpy as np

from ..errors import RecordingError

MAX_ARRAYS_BYTES = 1 << 29
"""Largest decompressed archive [byte]: 512 MiB, the covariance of 8000 particles."""
MAX_MEMBERS = 1000
"""Most arrays of an archive; those of this program have at most ten."""
MALFORMED = (
    zipfile.BadZipFile,
    zipfile.LargeZipFile,
    zlib.error,
    OSError,
    EOFError,
    KeyError,
    IndexError,
    ValueError,
    TypeError,
    AttributeError,
    RuntimeError,
    NotImplementedError,
    OverflowError,
    RecursionError,
    MemoryError,
    SyntaxError,
    SystemError,
    struct.error,
    tokenize.TokenError,
)
"""What `zipfile` and numpy raise on bytes that are no archive, or on a header that is no header; Python 3.12's
tokenizer, which numpy uses, ends in a SystemError there."""


def read_npz(data: bytes, *, limit: int = MAX_ARRAYS_BYTES) -> dict[str, np.ndarray]:
    """Return the arrays of an npz archive by name.

    Args:
        data: the archive.
        limit: most bytes that all arrays may take.

    Raises:
        RecordingError: no archive of plain arrays, or a larger one.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            size = sum(member.file_size for member in members)
            if len(members) > MAX_MEMBERS or size > limit:
                raise RecordingError(
                    f"is an archive of {len(members)} arrays of {size} bytes; at most {MAX_MEMBERS} arrays of {limit} "
                    "bytes are read"
                )
            arrays = {}
            for member in members:
                with archive.open(member) as file:
                    arrays[member.filename.removesuffix(".npy")] = _array(io.BytesIO(file.read()), member.file_size)
            return arrays
    except MALFORMED as failure:
        reason = str(failure)[:120] or type(failure).__name__
        raise RecordingError(f"is not an npz of arrays ({reason})") from failure


def _array(file: io.BytesIO, size: int) -> np.ndarray:
    """Return the array of an npy file of a known size [byte]."""
    version = np.lib.format.read_magic(file)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran_order, dtype = read_header(file)
    if dtype.hasobject:
        raise ValueError("an array holds objects")
    n_bytes = prod(shape) * dtype.itemsize
    if n_bytes < 0 or n_bytes > size:
        raise ValueError(f"an array of shape {shape} needs {n_bytes} bytes and has {size}")
    values = np.frombuffer(file.read(n_bytes), dtype)
    return values.reshape(shape, order="F" if fortran_order else "C").copy()
