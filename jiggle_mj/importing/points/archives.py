"""Arrays in .npz, .npy and .mat files: plain numbers alone, of a size that is checked before they are read.

Nothing is unpickled: a pickle can run code.
"""

import warnings
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from lzma import LZMAError
from pathlib import Path

import numpy as np
from jaxtyping import Shaped
from numpy.lib import format as npy_format

from ...errors import RecordingError
from ...recording.npz_arrays import MALFORMED
from ..data_folder import quoted
from .file_kinds import MAX_POSITION_BYTES, file_kind
from .mat_files import mat_arrays, mat_others

DAMAGE = (
    *MALFORMED,
    LookupError,
    NameError,
    ArithmeticError,
    AssertionError,
    LZMAError,
    Warning,
)
"""What the readers of numpy, trimesh and the standard library raise on damaged bytes."""
HEADER_BYTES = 2**14
"""Length in which an array's header ends; numpy itself reads no longer ones [bytes]."""
NUMBER_KINDS = "biuf"
"""Kinds of arrays that hold plain numbers: bool, int, unsigned, float."""
OTHER_KINDS = {
    "O": "objects, which are never read: save numbers",
    "c": "complex numbers: save their parts as coordinates",
    "M": 'dates: save .astype("int64"), and give time_unit',
    "m": 'durations: save .astype("int64"), and give time_unit',
    "V": "records: save their fields as one array of numbers",
}
"""What other arrays hold, and what to do; those that are missing hold text."""
HEADERS = {(1, 0): npy_format.read_array_header_1_0, (2, 0): npy_format.read_array_header_2_0}
"""Readers of the headers of plain arrays, by the format's version."""
MAX_LISTED = 12
"""How many arrays an error lists."""


@contextmanager
def damage_refused(path: Path, kind: str) -> Iterator[None]:
    """Turn what a library raises on damaged bytes into a RecordingError."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            yield
    except DAMAGE as failure:
        why = quoted(failure) or type(failure).__name__
        raise RecordingError(f"{path} cannot be read as {kind}: {why}.") from failure


def read_array(path: Path, key: str | None) -> Shaped[np.ndarray, "..."]:
    """Return one array of numbers of an .npz or .mat, or that of an .npy, as it is stored.

    Args:
        path: the file.
        key: name of the array; None for an .npy, which holds one.

    Raises:
        RecordingError: the file is missing, damaged or no archive, has no such array, or the array is too large or
            holds no plain numbers.
    """
    kind = file_kind(path)
    if kind not in ("npz", "npy", "mat"):
        raise RecordingError(f"{path} cannot be read as .npz, .npy or .mat: it is none.")
    with damage_refused(path, f".{kind}"):
        if kind == "npy":
            return _read_npy(path)
        shapes = _npz_shapes(path) if kind == "npz" else {name: array.shape for name, array in mat_arrays(path)}
        if key is None:
            raise RecordingError(
                f"{path} needs [points] key, the name of one of its arrays; it has {describe(shapes)}."
            )
        if key not in shapes:
            others = _npz_others(path) if kind == "npz" else mat_others(path)
            if key in others:
                raise RecordingError(f"{path}: {quoted(key)} holds {others[key]}; plain numbers are read.")
            raise RecordingError(f"{path} has no array '{quoted(key)}'; it has {describe(shapes)}.")
        array = _read_npz(path, key) if kind == "npz" else _read_mat(path, key)
    if array.dtype.kind not in NUMBER_KINDS:
        raise RecordingError(f"{path}: {key} holds {array.dtype}, not plain numbers.")
    return array


def array_shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Return name and shape of each array of numbers in an .npz or .mat, without reading the arrays.

    Raises:
        RecordingError: the file is missing, damaged or no archive.
    """
    kind = file_kind(path)
    if kind not in ("npz", "mat"):
        return {}
    with damage_refused(path, f".{kind}"):
        return _npz_shapes(path) if kind == "npz" else {name: array.shape for name, array in mat_arrays(path)}


def describe(shapes: dict[str, tuple[int, ...]]) -> str:
    """Return names and shapes for an error."""
    listed = [f"{quoted(name)} {shape}" for name, shape in list(shapes.items())[:MAX_LISTED]]
    return ", ".join([*listed, "..."] if len(shapes) > MAX_LISTED else listed) or "none of numbers"


def _npz_shapes(path: Path) -> dict[str, tuple[int, ...]]:
    return {name: shape for name, (shape, dtype) in _npz_headers(path).items() if dtype.kind in NUMBER_KINDS}


def _npz_others(path: Path) -> dict[str, str]:
    """Return what each array without plain numbers holds, by its name."""
    headers = _npz_headers(path).items()
    return {name: _what(dtype) for name, (_, dtype) in headers if dtype.kind not in NUMBER_KINDS}


def _npz_headers(path: Path) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    """Return shape and type of each array; a member that does not begin as one is left out."""
    found = {}
    with zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            if info.filename.endswith(".npy"):
                with archive.open(info) as stream:
                    header = _header(stream.read(HEADER_BYTES))
                if header is not None:
                    found[info.filename.removesuffix(".npy")] = header
    return found


def _what(dtype: np.dtype) -> str:
    return OTHER_KINDS.get(dtype.kind, "text")


def _read_npz(path: Path, key: str) -> Shaped[np.ndarray, "..."]:
    with zipfile.ZipFile(path) as archive:
        info = archive.getinfo(f"{key}.npy")
        with archive.open(info) as stream:
            _refuse_large(path, key, stream.read(HEADER_BYTES), info.file_size)
        with archive.open(info) as stream, _header_of_any_python():
            return npy_format.read_array(stream, allow_pickle=False)


def _read_mat(path: Path, key: str) -> Shaped[np.ndarray, "..."]:
    """Return an array of a .mat; a row or a column, as MATLAB has instead of a vector, as a vector."""
    array = next(array for name, array in mat_arrays(path) if name == key)
    return array.ravel() if array.ndim == 2 and 1 in array.shape else array


def _read_npy(path: Path) -> Shaped[np.ndarray, "..."]:
    with path.open("rb") as stream:
        _refuse_large(path, "the array", stream.read(HEADER_BYTES), path.stat().st_size)
        stream.seek(0)
        with _header_of_any_python():
            return npy_format.read_array(stream, allow_pickle=False)


@contextmanager
def _header_of_any_python() -> Iterator[None]:
    """Read a header of Python 2 without the warning; what else it may hold is refused."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def _refuse_large(path: Path, name: str, head: bytes, n_bytes: int) -> None:
    """Refuse an array whose header declares no plain numbers, too many, or another number than the file holds."""
    header = _header(head)
    if header is None:
        raise RecordingError(f"{path}: {name} does not begin as an array.")
    shape, dtype = header
    if dtype.kind not in NUMBER_KINDS:
        raise RecordingError(f"{path}: {name} holds {_what(dtype)}; plain numbers are read.")
    declared = 8  # bytes of a number once it is read
    for length in shape:
        declared *= length
    if declared > MAX_POSITION_BYTES:
        raise RecordingError(
            f"{path}: {name} has shape {quoted(shape)}; at most {MAX_POSITION_BYTES} bytes are read: split "
            "the recording, or keep fewer points or frames."
        )
    if declared // 8 * dtype.itemsize > n_bytes:
        raise RecordingError(f"{path}: {name} has shape {shape}, but the file ends before that.")


def _header(head: bytes) -> tuple[tuple[int, ...], np.dtype] | None:
    """Return shape and type of the array that begins with these bytes; None where none does."""
    stream = BytesIO(head)
    try:
        reader = HEADERS.get(npy_format.read_magic(stream))
        if reader is None:
            return None
        with _header_of_any_python():
            shape, _, dtype = reader(stream)
    except ValueError:
        return None
    return (shape, dtype) if all(length >= 0 for length in shape) else None
