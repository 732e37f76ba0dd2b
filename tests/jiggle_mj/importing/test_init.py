"""`jiggle-mj init`: the recording.toml that it writes runs, and says what is guessed."""

import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest

from jiggle_mj.errors import OutputError, RecordingError
from jiggle_mj.importing.folder import import_folder
from jiggle_mj.importing.init import describe_folder
from jiggle_mj.recording.reader import Recording
from tests.support.tiny_scene import call

SAMPLE = Path(__file__).parents[3] / "docs" / "recordings" / "sample"
NOISE = 2e-4
"""Noise of the sample [m]."""


def frames() -> np.ndarray:
    """Return 12 frames of an 8 x 8 sheet of 5 mm pitch [mm] that is lifted at row 0, with a noise of 0.05 mm."""
    x, y = np.meshgrid(5.0 * np.arange(8), 5.0 * np.arange(8))
    rest = np.column_stack([x.ravel(), y.ravel(), np.full(64, 100.0)])
    share = np.exp(-np.linalg.norm(rest[:, :2], axis=1) / 8.0)
    lifted = np.array([rest + step * share[:, None] * [0, 0, 1.0] for step in range(12)])
    return lifted + np.random.default_rng(0).normal(scale=0.05, size=lifted.shape)


def test_text_files_are_described(tmp_path):
    for number, points in enumerate(frames()):
        np.savetxt(tmp_path / f"f{number}.csv", points, delimiter=",", header="x,y,z", comments="")
    description = describe_folder(tmp_path)
    assert description.problem is None
    given = tomllib.loads(description.text)
    assert given["unit"] == "mm" and given["points"]["files"] == ["f*.csv"]
    assert 0.3 * 5e-5 < given["noise_sd"] < 3 * 5e-5  # a guess that the user checks: within a factor of 3
    assert 0 in given["grasp"]["rows"] and set(given["grasp"]["rows"]) <= {0, 1, 8, 9}
    summary = import_folder(tmp_path, None, tmp_path / "run.mcap")
    assert (summary.n_frames, summary.n_points) == (12, 64)


def test_an_archive_with_units_a_tool_and_triangles_is_described(tmp_path):
    points = frames()
    np.savez(
        tmp_path / "d.npz",
        pts_mm=points,
        stamp_ns=1_732_800_000_000_000_000 + 100_000_000 * np.arange(12),
        tool_mm=points[:, 0],
        tool_stamp_s=100.0 + 0.1 * np.arange(12),
        faces=np.array([[1, 2, 9], [2, 10, 9]]),
    )
    description = describe_folder(tmp_path)
    given = tomllib.loads(description.text)
    assert (given["unit"], given["time_unit"], given["points"]["times"]) == ("mm", "ns", "stamp_ns")
    assert given["mesh"] == {"faces": "faces", "first_vertex": 1}
    grasp = given["grasp"]
    assert (grasp["tool"], grasp["tool_times"], grasp["tool_time_unit"]) == ("tool_mm", "tool_stamp_s", "s")
    assert grasp["tool_clock_offset"] == "start together"
    assert description.problem is None


@pytest.mark.parametrize(
    ("key", "per_mm", "unit", "why"),
    [("points_m", 1.0, "mm", "guessed"), ("points_m", 1e-3, "m", "guessed"), ("points_mm", 1.0, "mm", "as the name")],
)
def test_a_name_that_ends_in_m_states_no_unit(tmp_path, key, per_mm, unit, why):
    """It may mean marker, mean or measured: the extent of the sheet decides."""
    np.savez(tmp_path / "d.npz", **{key: per_mm * frames()})
    description = describe_folder(tmp_path)
    assert description.problem is None and f'unit = "{unit}"  # {why}' in description.text


def test_points_of_which_few_are_seen_together_are_described_without_a_warning(tmp_path):
    """No point has all its neighbours in any later frame, and those that move most are unseen at rest."""
    points = frames()
    points[:, ::2] = np.nan
    points[0] = frames()[0]
    points[0, [1, 9]] = np.nan
    np.savez(tmp_path / "d.npz", p=points)
    given = tomllib.loads(describe_folder(tmp_path).text)
    assert not {1, 9} & set(given["grasp"]["rows"])
    still = np.repeat(frames()[:1], 12, axis=0)
    still[:, :13] = np.nan
    (tmp_path / "still").mkdir()
    np.savez(tmp_path / "still" / "d.npz", p=still)
    assert min(tomllib.loads(describe_folder(tmp_path / "still").text)["grasp"]["rows"]) == 13


def comma(value: float) -> str:
    return f"{value:.4f}".replace(".", ",")


def point(value: float) -> str:
    return f"{value:.4f}"


@pytest.mark.parametrize(
    ("heading", "form", "number", "cure"),
    [
        ("Bild;Punkt;x;y;z", "{t};{i};{x};{y};{z}", comma, 'frame_column = "Bild" and track_column = "Punkt".'),
        ("id,cuadro,x,y,z", "{i},{t},{x},{y},{z}", point, 'frame_column = "cuadro" and track_column = "id".'),
        ("", "{t} {i} {x} {y} {z}", point, "frame_column = 0 and track_column = 1, and columns = "),
        ("Bild;X-Achse;Y-Achse;Z-Achse", "{t};{x};{y};{z}", comma, 'columns = ["X-Achse", "Y-Achse", "Z-Achse"]'),
        (
            "frame,id,x,y",
            "{t},{i},{x},{y}",
            point,
            'two coordinates, and no z: .* columns = ["x", "y"] .*pixels are no',
        ),
        ("Nr;X_px;Y_px", "{i};{x};{y}", comma, 'two coordinates, and no z: .* columns = ["X_px", "Y_px"]'),
        ("a b", "{x} {y}", point, "two coordinates, and no z: .* columns = [0, 1]"),
    ],
)
def test_a_table_that_needs_keys_is_refused_with_them(tmp_path, heading, form, number, cure):
    table = [
        form.format(t=t, i=i, x=number(x), y=number(y), z=number(z))
        for t, each in enumerate(frames()[:3])
        for i, (x, y, z) in enumerate(each)
    ]
    (tmp_path / "all.csv").write_text("\n".join([heading, *table]))
    with pytest.raises(RecordingError, match=cure.replace("[", r"\[")) as failure:
        describe_folder(tmp_path)
    assert "MODEL_COORDINATES" not in str(failure.value)


def test_an_array_of_lost_points_is_taken_as_its_opposite(tmp_path):
    outlier = np.zeros((12, 64), np.uint8)
    outlier[3:5, 40] = 1
    np.savez(tmp_path / "d.npz", p=frames(), outlier=outlier)
    description = describe_folder(tmp_path)
    assert description.problem is None and 'visibility = "not outlier"' in description.text
    assert import_folder(tmp_path, None, tmp_path / "run.mcap").n_unseen == 2


def test_tracks_in_pixels_are_asked_for_what_they_lack(tmp_path):
    np.savez(tmp_path / "d.npz", tracks=40 * frames()[:, :, :2])
    description = describe_folder(tmp_path)
    assert "pixels are no length" in description.text
    problem = str(description.problem)
    assert "m is expected: " in problem and "pixels times the mm of one" in problem


def test_pixels_by_name_are_no_points(tmp_path):
    np.savez(tmp_path / "d.npz", tracks_px=10 * frames()[:, :, :2])
    assert "in pixels" in str(describe_folder(tmp_path).problem)


@pytest.mark.parametrize("suffix", ["stl", "glb"])
def test_a_folder_of_meshes_is_told_which_are_read(tmp_path, suffix):
    for number in range(3):
        (tmp_path / f"m{number}.{suffix}").write_bytes(b"glTF" + bytes(84))
    with pytest.raises(RecordingError, match=r"save the mesh of each frame as \.ply or \.obj"):
        describe_folder(tmp_path)


def test_the_sample_is_what_init_writes_but_for_gravity_and_bed(tmp_path):
    for name in ("tracks.npz", "attached.txt"):
        shutil.copy(SAMPLE / name, tmp_path / name)
    written = tomllib.loads(describe_folder(tmp_path).text)
    shipped = tomllib.loads((SAMPLE / "recording.toml").read_text())
    for changed in ("gravity", "bed"):
        del written["declaration"][changed], shipped["declaration"][changed]
    assert written | {"name": "sample"} == shipped
    assert NOISE / 1.5 < shipped["noise_sd"] < 1.5 * NOISE
    assert sum(path.stat().st_size for path in SAMPLE.iterdir()) <= 200_000


def test_a_recording_toml_is_never_replaced_and_an_empty_folder_is_refused(tmp_path):
    with pytest.raises(RecordingError, match="holds no points"):
        describe_folder(tmp_path)
    (tmp_path / "recording.toml").write_text("mine")
    with pytest.raises(OutputError, match="exists and is kept"):
        describe_folder(tmp_path)
    assert (tmp_path / "recording.toml").read_text() == "mine"


def test_the_verb_writes_and_import_without_a_description_offers_it(tmp_path, monkeypatch, capsys):
    np.savez(tmp_path / "d.npz", p=frames())
    assert call(monkeypatch, "import", tmp_path, "--out", tmp_path / "run.mcap") == 1
    assert "jiggle-mj init" in capsys.readouterr().err
    assert call(monkeypatch, "init", tmp_path) == 0
    assert "jiggle-mj import" in capsys.readouterr().err
    assert call(monkeypatch, "import", tmp_path, "--out", tmp_path / "run.mcap") == 0
    assert len(list(Recording.open(tmp_path / "run.mcap"))) == 12
