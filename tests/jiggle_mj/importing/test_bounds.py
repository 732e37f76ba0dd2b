"""An import reads inside its folder alone, and no size that a file declares makes it read without bound."""

import io
import zipfile

import numpy as np
import pytest

from jiggle_mj.errors import RecordingError
from tests.support.measured_folder import TOML, bring_in, folder, grid

FILES = 'files = ["rest.xyz", "pulled_*.xyz"]'


@pytest.mark.parametrize(
    "name",
    ["../outside.xyz", "../*.xyz", "sub/../../outside.xyz", "ABSOLUTE", "link.xyz", "linked/outside.xyz", "l*.xyz"],
)
def test_names_that_lead_out_of_the_folder_are_refused_unless_allowed(tmp_path, name):
    outside = tmp_path / "outside.xyz"
    name = name.replace("ABSOLUTE", str(outside))
    where = folder(tmp_path, toml=TOML.replace(FILES, f'files = ["{name}"]'))
    np.savetxt(outside, grid())
    (where / "sub").mkdir()
    (where / "link.xyz").symlink_to(outside)
    (where / "linked").symlink_to(tmp_path)
    with pytest.raises(RecordingError, match=r"leads out of the folder.*--allow-outside"):
        bring_in(where)
    summary, _ = bring_in(where, allow_outside=True)
    assert summary.n_points == 12


@pytest.mark.parametrize("key", ["rows_file", "faces"])
def test_other_files_that_lead_out_are_refused(tmp_path, key):
    toml = TOML.replace("rows = [0, 1]", 'rows_file = "/etc/hostname"')
    if key == "faces":
        toml = TOML.replace("[grasp]", '[mesh]\nfaces = "/etc/hostname"\n[grasp]')
    with pytest.raises(RecordingError, match="'/etc/hostname' leads out of the folder"):
        bring_in(folder(tmp_path, toml=toml))


@pytest.mark.parametrize(
    ("name", "message"),
    [("f\\u0000", r"'f\\x00' is no name"), ("", "'' is no name"), ("a**b/*", "is no pattern|no file that matches")],
)
def test_what_is_no_name_is_refused(tmp_path, name, message):
    with pytest.raises(RecordingError, match=message):
        bring_in(folder(tmp_path, toml=TOML.replace(FILES, f'files = ["{name}"]')))


def header(shape: str, descr: str = "'<f8'") -> bytes:
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    text += b" " * (63 - (len(text) + 10) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


def npz(member: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("p.npy", member)
    return buffer.getvalue()


NUL_IN_HEADER = header("(2, 12, 3)").replace(b"{'descr':", b" " * 9).replace(b"\x76\x00", b"\x7e\x00") + bytes(600)
"""An array whose header closes a brace that it never opened, and goes on: Python 3.12's tokenizer ends in a
SystemError."""


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (npz(header("(1000000000000, 3)")), "at most 134217728 bytes are read"),
        (npz(header("(1" + "0" * 400 + ", 3)")), "at most 134217728 bytes are read|cannot be read"),
        (npz(header("(400, 30000, 3)") + bytes(30_000_000)), "at most 134217728 bytes are read"),
        (npz(header("(2, 12, 3)") + bytes(100)), "the file ends before that"),
        (npz(header("(2, 12, 3)", "'|O'") + bytes(600)), "p holds objects, which are never read"),
        (npz(header("(-2, 12, 3)")), "has no array 'p'|cannot be read"),
        (npz(b"\x80\x04K\x01."), "has no array 'p'"),
        (npz(header("(2, 12, 3)") + bytes(576))[:-40], r"cannot be read as \.npz"),
        (header("(2, 12, 3)"), "has no array|ends before"),
        (npz(NUL_IN_HEADER), "has no array|cannot be read|does not begin as an array"),
    ],
    ids=["terabytes", "digits", "bomb", "short", "objects", "negative", "pickle", "cut-off", "no-archive", "NUL"],
)
def test_what_an_archive_declares_is_checked_before_it_is_read(tmp_path, data, message):
    where = folder(tmp_path, toml=TOML.replace(FILES, 'files = ["d.npz"]\nkey = "p"'))
    (where / "d.npz").write_bytes(data)
    with pytest.raises(RecordingError, match=message) as refusal:
        bring_in(where)
    assert len(str(refusal.value)) < 700


def test_more_points_than_are_read_are_refused_before_the_second_file(tmp_path):
    """4000 frames of 3000 points are 12 million positions; one frame says so."""
    where = folder(tmp_path, toml=TOML.replace(FILES, 'files = ["f*.xyz"]'))
    rows = "\n".join(f"{i}.5 {i % 7}.5 0" for i in range(3000))
    (where / "f0000.xyz").write_text(rows)
    for number in range(1, 4000):
        (where / f"f{number:04d}.xyz").hardlink_to(where / "f0000.xyz")
    with pytest.raises(RecordingError, match="4000 frames of 3000 points are more than the 5592405 positions"):
        bring_in(where)
