"""A changed bit is noticed wherever it lies, and a small file does not fill the memory."""

import io
import json
import tracemalloc
import zipfile
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard

from jiggle_mj.errors import RecordingError
from jiggle_mj.observation import Declaration
from jiggle_mj.recording.declaration import DECLARATION, DECLARED_MESH
from jiggle_mj.recording.npz_arrays import read_npz
from jiggle_mj.recording.reader import Recording
from jiggle_mj.recording.truth import read_truth, write_truth
from tests.support.mcap_edits import assembled, chunk, framed, records_of
from tests.support.recordings import declared_mesh, observations, truth, write

MEGABYTE = 1 << 20
"""Bytes."""


def peak_memory(read, path: Path, message: str) -> int:
    """Return the most memory [byte] that a reading takes before it is refused."""
    tracemalloc.start()
    with pytest.raises(RecordingError, match=message):
        read(path)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return most


def test_a_bit_of_the_declaration_is_covered(tmp_path):
    """k = 30 becomes 70 by one bit; metadata lie outside the chunks, which have checksums of their own."""
    path = write(tmp_path / "run.mcap", observations(1))
    data = path.read_bytes()
    assert data.count(b'"membrane_stiffness": 30.0') == 1
    changed = data.replace(b'"membrane_stiffness": 30.0', b'"membrane_stiffness": 70.0')
    path.write_bytes(changed)
    with pytest.raises(RecordingError, match=r"damaged before byte .*crc validation failed"):
        Recording.open(path)


def test_a_file_of_another_program_without_checksums_is_read(tmp_path):
    path = write(tmp_path / "run.mcap", observations(2))
    other = tmp_path / "other.mcap"
    other.write_bytes(assembled(records_of(path.read_bytes()), chunked=True))
    assert len(list(Recording.open(other))) == 2


def test_a_mesh_before_its_declaration_is_kept(tmp_path):
    path = write(tmp_path / "run.mcap", observations(1), declaration=Declaration(poisson=0.3, mesh=declared_mesh()))
    records = records_of(path.read_bytes())
    mesh = next(record for record in records if record.name == DECLARED_MESH)
    for place in (0, len(records) - 1):
        path.write_bytes(assembled([*(rest := [r for r in records if r is not mesh])[:place], mesh, *rest[place:]]))
        declared = Recording.open(path).declaration
        assert declared.poisson == 0.3 and declared.mesh is not None


@pytest.mark.parametrize(
    ("entries", "complaint"),
    [
        ({"gravity": "yes"}, "gravity = 'yes'; it must be three numbers"),
        ({"gravity": [1, 2]}, r"gravity = \[1, 2\]; it must be three numbers"),
        ({"thickness": "1"}, "thickness = '1'; it must be a number above 0"),
        ({"thickness": 10**400}, "thickness = 1000.*; it must be a number above 0"),
        ({"bed": 1}, "bed = 1; it must be true or false"),
    ],
)
def test_a_declaration_of_other_kinds_is_refused(tmp_path, entries, complaint):
    path = write(tmp_path / "run.mcap", observations(1))
    records = records_of(path.read_bytes())
    for record in records:
        if record.name == DECLARATION:
            record.entries["json"] = json.dumps(entries)
    path.write_bytes(assembled(records))
    with pytest.raises(RecordingError, match=complaint):
        Recording.open(path)


def test_a_chunk_that_is_larger_than_it_states_is_refused(tmp_path):
    """64 MB of zeros in a few kB, which state 100 bytes."""
    path, zeros = tmp_path / "bomb.mcap", bytes(64 * MEGABYTE)
    for compression, data in (("zstd", zstandard.compress(zeros)), ("lz4", lz4.frame.compress(zeros))):
        path.write_bytes(framed(chunk(data, 100, compression)))
        assert peak_memory(Recording.open, path, "a chunk holds more than 100 bytes and states 100") < 8 * MEGABYTE
        path.write_bytes(framed(chunk(data, 3 << 30, compression)))
        assert peak_memory(Recording.open, path, "a chunk of 3221225472 bytes exceeds the limit") < 8 * MEGABYTE
    path.write_bytes(framed(chunk(b"x", 1, "brotli")))
    with pytest.raises(RecordingError, match="compressed by 'brotli'; zstd, lz4 and none are read"):
        Recording.open(path)


def test_an_archive_that_is_larger_than_allowed_is_refused():
    """A member of 64 MB of zeros in 64 kB, and an array that states more than the archive holds."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", bytes(64 * MEGABYTE))
    with pytest.raises(RecordingError, match="1 arrays of 67108864 bytes; at most 1000 arrays of 1048576"):
        read_npz(buffer.getvalue(), limit=MEGABYTE)
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12, 3)})
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("a.npy", header.getvalue())
    with pytest.raises(RecordingError, match="needs 24000000000000 bytes"):
        read_npz(buffer.getvalue())


def test_pickled_arrays_are_never_loaded():
    buffer = io.BytesIO()
    np.savez(buffer, a=np.array([{}], dtype=object))
    with pytest.raises(RecordingError, match="holds objects"):
        read_npz(buffer.getvalue())


@pytest.mark.parametrize(
    ("name", "array", "complaint"),
    [
        ("faces", np.array([[0, 1, 3]]), "faces of 0 to 3; it must be numbers from 0 to 2"),
        ("faces", np.array([[0.0, 1.0, 2.0]]), "faces of float64; it must be whole numbers"),
        ("vertices", np.zeros((3, 2)), r"vertices of \(3, 2\); it must be of shape \(any, 3\)"),
        ("vertices", np.full((3, 3), np.nan), "vertices of NaN or infinity; it must be finite"),
        ("track_id", np.array([0, 1]), r"track_id of \(2,\); it must be of shape \(3\)"),
        ("held", np.array([0, 2, 1]), "held of int64; it must be true or false"),
    ],
)
def test_a_declared_mesh_of_wrong_arrays_is_refused(tmp_path, name, array, complaint):
    from tests.support.valid_files import packed

    path = write(tmp_path / "run.mcap", observations(1), declaration=Declaration(mesh=declared_mesh()))
    changed = []
    for record in records_of(path.read_bytes()):
        if record.name == DECLARED_MESH:
            record.__dict__["data"] = packed(read_npz(record.data) | {name: array})
        changed.append(record)
    path.write_bytes(assembled(changed))
    with pytest.raises(RecordingError, match=complaint):
        Recording.open(path)


def test_a_truth_whose_frames_are_out_of_order_is_refused(tmp_path):
    path = tmp_path / "run.truth.mcap"
    write_truth(path, truth())
    records = records_of(path.read_bytes())
    of_frame = [record for record in records if record.kind == "message" and record.time == 20]
    path.write_bytes(assembled([*records, *of_frame]))
    with pytest.raises(RecordingError, match="frame 2 at 20 ns follows frame 5 at 50 ns"):
        read_truth(path)
