"""Tables with a row for each point of each frame, rows that are named by a track, and units in headings."""

import numpy as np
import pytest

from jiggle_mj.errors import RecordingError
from jiggle_mj.importing.init import draft
from tests.support.measured_folder import ROUNDING, TOML, bring_in, folder, grid

FILES = 'files = ["rest.xyz", "pulled_*.xyz"]'
NAMES = ("rest.xyz", "pulled_1.xyz", "pulled_2.xyz")


def frames() -> np.ndarray:
    """Three frames of the grid, moved off whole numbers, with a corner that rises [mm]."""
    values = np.stack([grid() + 0.125] * 3)
    values[1:, :2, 2] += 3
    values[2] += 1
    return values


def orders() -> list[list[int]]:
    """The order of the points in each frame: as they are in the first, shuffled in the others."""
    rng = np.random.default_rng(0)
    return [list(range(12)), rng.permutation(12).tolist(), rng.permutation(12).tolist()]


TIMES = [f"{0.5 * number:g}" for number in range(12)]
"""Times of the rows of the first frame."""


def line(point: int, frame: int, form: str) -> str:
    x, y, z = frames()[frame, point]
    return form.format(frame=frame, time=f"{0.25 * frame:g}", point=point, point_time=TIMES[point], x=x, y=y, z=z)


def long_table(tmp_path, heading: str, form: str, *, keys: str = "", lost=()):
    """A folder with all frames in one table, whose rows are in no order after the first frame."""
    toml = TOML.replace("period = 0.5\n", "") if "times" in keys else TOML
    where = folder(tmp_path, toml=toml.replace(FILES, f'files = ["all.csv"]\n{keys}'))
    rows = [line(p, f, form) for f, order in enumerate(orders()) for p in order if (f, p) not in lost]
    (where / "all.csv").write_text("\n".join([heading, *rows]))
    return where


def tables(tmp_path, heading: str, form: str, keys: str = ""):
    """A folder with a table for each frame."""
    where = folder(tmp_path, toml=TOML.replace(FILES, f"{FILES}\n{keys}"))
    for frame, (name, order) in enumerate(zip(NAMES, orders(), strict=True)):
        (where / name).write_text("\n".join([heading, *(line(point, frame, form) for point in order)]))
    return where


def positions(recording) -> np.ndarray:
    return np.stack([observation.points.positions for observation in recording]) * 1e3


@pytest.mark.parametrize(
    ("heading", "form", "keys"),
    [
        ("frame,id,x,y,z", "{frame},{point},{x},{y},{z}", ""),
        ("X;Y;Z;TRACK_ID;LABEL;Frame", "{x};{y};{z};{point};7;{frame}", ""),
        ("time [s]\tmarker\tx [mm]\ty [mm]\tz [mm]", "{time}\tM{point}\t{x}\t{y}\t{z}", ""),
        ("Bild,Nr,x,y,z", "{frame},{point},{x},{y},{z}", 'frame_column = "Bild"\ntrack_column = 1'),
        ("# frame id x y z", "{frame} {point} {x} {y} {z}", ""),
    ],
)
def test_a_table_of_all_frames_is_read_by_frame_and_track(tmp_path, heading, form, keys):
    where = long_table(tmp_path, heading, form, keys=keys, lost={(1, 5), (2, 0)})
    summary, recording = bring_in(where)
    expected = frames()
    expected[1, 5] = expected[2, 0] = np.nan
    np.testing.assert_allclose(positions(recording), expected, atol=1e3 * ROUNDING)
    assert any("matched between frames by the column" in note for note in summary.notes)


def test_a_column_of_times_times_the_frames(tmp_path):
    where = long_table(tmp_path, "t,id,x,y,z", "{time},{point},{x},{y},{z}", keys='times = "t"')
    _, recording = bring_in(where)
    assert [observation.time for observation in recording] == [0, 250_000_000, 500_000_000]


def test_init_describes_a_table_of_all_frames(tmp_path):
    where = long_table(tmp_path, "t_s,id,x_mm,y_mm,z_mm", "{time},{point},{x},{y},{z}")
    for path in where.iterdir():
        if path.name != "all.csv":
            path.unlink()
    text = draft(where)
    assert 'files = ["all.csv"]' in text and 'times = "t_s"' in text and 'unit = "mm"  # as the headings say' in text
    assert "3 frames of 12 points" in text


@pytest.mark.parametrize("column", ["id", "Point #", "track_id", "label"])
def test_a_column_of_track_ids_orders_the_rows_of_each_file(tmp_path, column):
    summary, recording = bring_in(tables(tmp_path, f"{column},x,y,z", "{point},{x},{y},{z}"))
    np.testing.assert_allclose(positions(recording), frames(), atol=1e3 * ROUNDING)
    assert f"points are matched between frames by the column '{column}'" in summary.notes[1]


def test_a_column_that_repeats_in_every_file_names_no_track(tmp_path):
    """Alike in all files: the rows are in order, whatever it means."""
    summary, recording = bring_in(tables(tmp_path, "label,x,y,z", "7,{x},{y},{z}"))
    shuffled = np.stack([frame[order] for frame, order in zip(frames(), orders(), strict=True)])
    np.testing.assert_allclose(positions(recording), shuffled, atol=1e3 * ROUNDING)
    assert summary.notes == ("x, y and z are columns [1, 2, 3], by the heading",)


def test_a_value_of_each_point_that_is_headed_t_is_no_time(tmp_path):
    where = folder(tmp_path)
    for number, name in enumerate(NAMES):
        rows = [f"{x},{y},{z},{300 - (7 * k) % 5}" for k, (x, y, z) in enumerate(frames()[number])]
        (where / name).write_text("\n".join(["x,y,z,T", *rows]))
    np.testing.assert_allclose(positions(bring_in(where)[1]), frames(), atol=1e3 * ROUNDING)


@pytest.mark.parametrize(
    ("heading", "form", "message"),
    [
        ("t,x,y,z", "{point_time},{x},{y},{z}", "several values in the column 't', and there are further files"),
        ("frame,x,y,z", "{point},{x},{y},{z}", "several values in the column 'frame', and there are further files"),
        ("id,x,y,z", "{frame}{point:02d},{x},{y},{z}", "no id is in two frames"),
        ("id,x,y,z", "{frame},{x},{y},{z}", "has the id '0' in several rows.*track_column = \"none\""),
        ("id,u,v,w", "{point},{x},{y},{z}", "names no x, y and z: give columns"),
        ("x [m],y [m],z [m]", "{x},{y},{z}", 'unit = "mm", but .* in m: give unit = "m"'),
        ("x_cm,y_cm,z_cm", "{x},{y},{z}", 'in cm: give unit = "cm"'),
        ("x,y,z\ncm,cm,cm", "{x},{y},{z}", 'in cm: give unit = "cm"'),
        ("X(mm),Y(mm),Z(cm)", "{x},{y},{z}", 'in cm: give unit = "cm"'),
        ("x [in],y [in],z [in]", "{x},{y},{z}", "in inches: convert them to one of m, cm, mm, um"),
        ("x_px,y_px,z_px", "{x},{y},{z}", "in pixels; pixels are no length"),
    ],
)
def test_a_heading_that_contradicts_the_rows_or_the_unit_is_refused(tmp_path, heading, form, message):
    with pytest.raises(RecordingError, match=message):
        bring_in(tables(tmp_path, heading, form))


@pytest.mark.parametrize(
    ("heading", "form", "keys", "message"),
    [
        ("frame,x,y,z", "{frame}{point:02d},{x},{y},{z}", "", "one row for each value of 'frame'"),
        ("frame,x,y,z", "f{frame},{x},{y},{z}", "", "the column 'frame' must hold numbers.*f0"),
        ("frame,t,x,y,z", "{frame},{point},{x},{y},{z}", 'times = "t"', "several times in 't'"),
        ("frame,x,y,z", "{frame},{x},{y},{z}", 'frame_column = "Bild"', "no columns headed 'Bild'"),
        ("frame,x,y,z", "{frame},{x},{y},{z}", "track_column = -1", "track_column must be a column"),
    ],
)
def test_a_table_of_all_frames_that_is_none_is_refused(tmp_path, heading, form, keys, message):
    with pytest.raises(RecordingError, match=message):
        bring_in(long_table(tmp_path, heading, form, keys=keys))


def test_rows_without_names_must_be_as_many_in_every_frame(tmp_path):
    where = long_table(tmp_path, "frame,x,y,z", "{frame},{x},{y},{z}", lost={(1, 5)})
    with pytest.raises(RecordingError, match=r"frame 0 has 12 rows, .*frame 1 has 11.*track_column"):
        bring_in(where)


def test_none_reads_a_table_as_one_frame_and_says_so(tmp_path):
    where = long_table(tmp_path, "frame,x,y,z", "{frame},{x},{y},{z}", keys='frame_column = "none"\nmissing = "none"')
    summary, _ = bring_in(where)
    assert (summary.n_frames, summary.n_points) == (1, 36) and "one text file is one frame" in summary.notes[1]


def test_the_name_of_an_array_states_its_unit(tmp_path):
    where = folder(tmp_path, toml=TOML.replace(FILES, 'files = ["d.npz"]\nkey = "p_cm"'))
    np.savez(where / "d.npz", p_cm=frames())
    with pytest.raises(RecordingError, match='in cm: give unit = "cm"'):
        bring_in(where)


@pytest.mark.parametrize("key", ['frame_column = "frame"', "track_column = 0", 'times = "t"'])
def test_columns_are_for_text(tmp_path, key):
    toml = TOML.replace("period = 0.5\n", "") if "times" in key else TOML
    where = folder(tmp_path, toml=toml.replace(FILES, f'files = ["d.npy"]\n{key}'))
    np.save(where / "d.npy", frames())
    with pytest.raises(RecordingError, match=r"text files; d\.npy is read as npy"):
        bring_in(where)
