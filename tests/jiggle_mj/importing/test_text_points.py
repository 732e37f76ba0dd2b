"""Text tables of points: separator, decimal mark, encoding, headings and lost points are found, or asked for."""

import codecs

import numpy as np
import pytest

from jiggle_mj.errors import RecordingError
from tests.support.measured_folder import ROUNDING, TOML, bring_in, folder, grid

CELLS = [[f"{value:.3f}" for value in row] for row in grid() + 0.125]
"""The grid, moved off whole numbers, so that each cell has a decimal mark."""


def table(separator: str, decimal: str = ".", *, end: str = "\n", heading: str = "") -> str:
    rows = [separator.join(cell.replace(".", decimal) for cell in row) for row in CELLS]
    return end.join([heading, *rows] if heading else rows) + end


def first_frame(tmp_path, content: str | bytes, keys: str = "") -> np.ndarray:
    """Positions [mm] of a recording whose only frame has that content."""
    where = folder(tmp_path, toml=TOML.replace('"rest.xyz", "pulled_*.xyz"]', f'"rest.xyz"]\n{keys}'))
    (where / "rest.xyz").write_bytes(content if isinstance(content, bytes) else content.encode())
    _, recording = bring_in(where)
    return next(iter(recording)).points.positions * 1e3


@pytest.mark.parametrize(
    "content",
    [
        table(","),
        table(", "),
        table(";"),
        table("\t"),
        table("   "),
        table("|"),
        table(" | ", ","),
        table(":"),
        table(" : ", ","),
        table(";", ","),
        table("\t", ","),
        table("  ", ","),
        table(",", end="\r\n"),
        table(",", end="\r"),
        table(";", ",", heading="X;Y;Z", end="\r\n"),
        table(",", heading="x [mm],y [mm],z [mm]"),
        table(",", heading="x,y,z\nmm,mm,mm"),
        table(",", heading="0,1,2"),
        table(",", heading="Project 3\nx,y,z"),
        table(" ", heading="# x y z\n% second\n// third\n*** DICe"),
        table(",", heading='"x","y","z"').replace("0.125", '"0.125"'),
        table(",", end=",\n", heading="x,y,z"),
        table(";", ",", heading="sep=;\nx;y;z"),
        table('";"', ",").replace("\n", '"\n"').join('""').removesuffix('"\n""') + '"',
        table(" ").replace("0.125", "1.25D-1").replace("2.125", "0.2125d+01"),
        codecs.BOM_UTF8 + table(",").encode(),
        table(",").encode("utf-16"),
        table(",", heading="Größe\nx,y,z").encode("cp1252"),
    ],
)
def test_one_table_in_many_forms_is_the_same_points(tmp_path, content):
    np.testing.assert_allclose(first_frame(tmp_path, content), grid() + 0.125, atol=1e3 * ROUNDING)


@pytest.mark.parametrize("word", ["", "nan", "-nan(ind)", "NULL", "NA", "#N/A", "inf", "-1.#IND", '""', "None"])
def test_a_cell_without_a_number_is_a_lost_point_and_shifts_nothing(tmp_path, word):
    rows = table(",").splitlines()
    rows[0] = f"{word},{word},{word}"
    rows[5] = f"{word},1.5,2.5"
    found = first_frame(tmp_path, "\n".join(rows))
    lost = np.isnan(found).all(axis=1)
    assert np.flatnonzero(lost).tolist() == [0, 5]
    np.testing.assert_allclose(found[~lost], grid()[~lost] + 0.125, atol=1e3 * ROUNDING)


@pytest.mark.parametrize("columns", ['["X", "Y", "Z"]', '["x", "y", "z"]', "[1, 2, 4]"])
def test_columns_are_named_by_heading_or_number(tmp_path, columns):
    rows = [f"{i};{x};{y};note;{z}" for i, (x, y, z) in enumerate(CELLS)]
    found = first_frame(tmp_path, "\n".join(["id;X [mm];Y [mm];text;Z [mm]", *rows]), f"columns = {columns}")
    np.testing.assert_allclose(found, grid() + 0.125, atol=1e3 * ROUNDING)


def test_a_heading_of_x_y_and_z_decides_the_columns_and_is_said(tmp_path):
    where = folder(tmp_path)
    for path in where.glob("*.xyz"):
        rows = [f"{i},{x},{y},{z}" for i, (x, y, z) in enumerate(np.loadtxt(path))]
        path.write_text("\n".join(["id,x,y,z", *rows]))
    summary, recording = bring_in(where)
    np.testing.assert_allclose(next(iter(recording)).points.positions, grid() * 1e-3, atol=ROUNDING)
    assert summary.notes == ("x, y and z are columns [1, 2, 3], by the heading",)


def test_two_columns_are_points_of_a_plane(tmp_path):
    rows = "\n".join(f"{x},{y}" for x, y, _ in CELLS)
    found = first_frame(tmp_path, rows, "columns = [0, 1]")
    np.testing.assert_allclose(found[:, :2], grid()[:, :2] + 0.125, atol=1e3 * ROUNDING)
    assert (found[:, 2] == 0).all()


WHOLE = "\n".join(f"{i * i},125,{3 * i},250,7,5" for i in range(12))
THOUSANDS = "\n".join(f"{1 + i},{100 + i};2,{200 + i * i};3,500" for i in range(12))


@pytest.mark.parametrize(
    ("content", "keys", "expected"),
    [
        (THOUSANDS, 'separator = ";"\ndecimal = ","', [1.1, 2.2, 3.5]),
        (WHOLE, 'separator = ","\ndecimal = "."', [0.0, 125.0, 0.0]),
    ],
)
def test_what_can_be_read_in_two_ways_is_asked_for(tmp_path, content, keys, expected):
    """Thousands or decimals? Six whole numbers, or three with a decimal comma?"""
    (tmp_path / "asked").mkdir()
    with pytest.raises(RecordingError, match=r"line 1, .* more than one way: give separator .* and decimal"):
        first_frame(tmp_path / "asked", content)
    np.testing.assert_allclose(first_frame(tmp_path, content, keys)[0], expected, atol=1e3 * ROUNDING)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (table(" ").replace("0.125", "0.125 7", 1), "line 2 has 3 columns, line 1 has 4"),
        ("0.0 0.0 oops\n" + table(" "), "line 1 holds text that is not a number"),
        ("lost,lost,lost\n" + table(","), r"line 1 holds text that is not a number \('lost'\)"),
        ("x,y,z\noops,oops,oops\n" + table(","), "line 2 holds text that is not a number .*below a heading"),
        (table(" ").replace("2.125", "2_1.25"), "holds text that is not a number"),
        (table(",").replace("2.125", "1.002,125"), r"line 2 has 4 columns|holds text"),
        ("a picture \0 of bytes", "is not text: it holds bytes of 0"),
        (b"\x80\x04pickle", "Python pickle"),
        (b"\x89HDF\r\n", "HDF5"),
        (b"", "is empty"),
        (b"x" * 200_000, "line 1 has 200000 characters"),
        (
            "\n".join(f"{i} {x} {y} {z}" for i, (x, y, z) in enumerate(CELLS)),
            r"counts the rows.* columns = \[1, 2, 3\]",
        ),
        ("v 1 2 3\nv x\n", "line 2, 'v x', is no vertex or face of an OBJ"),
    ],
)
def test_what_is_no_table_is_refused_with_its_line(tmp_path, content, message):
    with pytest.raises(RecordingError, match=message) as refusal:
        first_frame(tmp_path, content)
    assert "\n" not in str(refusal.value) and len(str(refusal.value)) < 700


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ('columns = ["q", "y", "z"]', "no columns headed 'q'; its heading is 'x, y, z'"),
        ('separator = "/"', "separator must be one of"),
        ('separator = ","\ndecimal = ","', "both ','; they must differ"),
        ("columns = [0, 0, 1]", "different columns"),
        ('missing = "sigma is -1"', 'missing must be "COLUMN OPERATOR NUMBER"'),
        ('missing = "sigma == -1"', "no columns headed 'sigma'"),
        ('layout = "points"', "layout must order frames, points and xyz"),
        ('layout = "points, frames"', "layout is for arrays"),
        ('format = "ncorr"', "must be one of dice, vic-3d; got 'ncorr'; save x, y, z as one array"),
        ('format = "dice"', "no columns headed 'MODEL_COORDINATES_X'"),
        ("displacements = [0, 1]\ncolumns = [0, 1, 2]", "as many columns as columns; got 2 and 3"),
        ('visibility = "v"', "visibility name arrays"),
    ],
)
def test_a_wrong_key_of_points_is_refused(tmp_path, keys, message):
    with pytest.raises(RecordingError, match=message):
        first_frame(tmp_path, table(",", heading="x,y,z"), keys)
