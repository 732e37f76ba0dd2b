"""The verbs `import` and `inspect` on robots' bags: what is printed, exit codes, and the same estimate."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from jiggle_mj import Recording
from tests.support.robot_bags import STEP, RobotBag, small_bag, small_camera, write_images
from tests.support.tiny_scene import call, scene_file


def test_import_prints_what_it_guessed_and_measured(tmp_path, monkeypatch, capsys):
    assert call(monkeypatch, "import", small_bag(tmp_path / "bag"), "--out", tmp_path / "run.mcap", "--json") == 0
    shown = capsys.readouterr()
    for words in ("/left/image_raw", "guessed", "right minus left 0 ms", "4 frames over 0.3 s, 1 grasps"):
        assert words in shown.err
    summary = json.loads(shown.out)
    assert summary["topics"]["tool"] == "/tool/pose" and summary["n_frames"] == 4


def test_inspect_lists_topics_and_what_is_missing(tmp_path, monkeypatch, capsys):
    with RobotBag(tmp_path / "bag") as bag:
        bag.cameras(small_camera())
        write_images(bag)
        bag.pose("/psm1/measured_cp", 0, [0, 0, 0])
        bag.pose("/psm2/measured_cp", 0, [0, 0, 0])
        bag.joint("/psm1/jaw", 0, jaw=0.6)
        bag.write("/odd", 0, "std_msgs/String", data="x")
    assert call(monkeypatch, "inspect", bag.path, "--json") == 0
    shown = capsys.readouterr()
    assert "one of /psm1/measured_cp, /psm2/measured_cp (--topic tool=TOPIC)" in shown.err
    assert "next: jiggle-mj import" in shown.err
    report = json.loads(shown.out)
    topics = {each["name"]: each for each in report["topics"]}
    assert topics["/left/image_raw"]["rate"] == pytest.approx(10)
    assert topics["/left/image_raw"]["span"] == [0.0, 0.3] and topics["/left/image_raw"]["role"] == "left"
    assert topics["/tf_static"]["frames"] == ["left_optical > right_optical", "world > left_optical"]
    assert len(report["missing"]) == 2 and "--closed 'jaw<0.1'" in report["missing"][1]


def test_a_topic_may_be_named_as_markup_is_written(tmp_path, monkeypatch, capsys):
    with RobotBag(tmp_path / "bag") as bag:
        bag.cameras(small_camera())
        write_images(bag)
        bag.pose("/[/b]t", 0, [0, 0, 0])
        bag.write("/[red]c", 0, "std_msgs/Bool", data=True)
    assert call(monkeypatch, "inspect", bag.path) == 0
    shown = capsys.readouterr().err
    assert "/[/b]t" in shown and "/[red]c" in shown


def test_inspect_reads_recordings_of_ours(tmp_path, monkeypatch, capsys):
    call(monkeypatch, "import", small_bag(tmp_path / "bag"), "--out", tmp_path / "run.mcap")
    capsys.readouterr()
    assert call(monkeypatch, "inspect", tmp_path / "run.mcap", "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert report["kind"] == "recording" and report["missing"] == []
    assert {each["name"]: each["count"] for each in report["topics"]}["/camera/left/image_raw"] == 4


@pytest.mark.parametrize("verb", ("run", "estimate"))
def test_a_verb_that_needs_a_recording_names_the_command(tmp_path, monkeypatch, capsys, verb):
    path = small_bag(tmp_path / "bag")
    assert call(monkeypatch, verb, path, "--out", tmp_path / "out") == 1
    assert f"import it first: jiggle-mj import {path} --out run.mcap" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("verb", "given", "code", "says"),
    [
        ("init", "tracks.npz", 2, "tracks.npz is a file; give its folder"),
        ("import", "tracks.npz", 2, "tracks.npz is a file; give its folder"),
        ("init", "missing", 2, "missing does not exist; give the folder"),
        ("import", "missing", 2, "missing does not exist; give the folder"),
        ("init", "run.mcap", 2, "run.mcap' names the next command"),
        ("init", "bag", 1, "import it first: jiggle-mj import"),
    ],
)
def test_what_is_no_folder_of_points_is_named_with_what_to_do(tmp_path, monkeypatch, capsys, verb, given, code, says):
    for name in ("tracks.npz", "run.mcap"):
        (tmp_path / name).touch()
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "metadata.yaml").touch()
    out = () if verb == "init" else ("--out", tmp_path / "out.mcap")
    assert call(monkeypatch, verb, tmp_path / given, *out) == code
    assert says in capsys.readouterr().err


def test_inspect_never_breaks_the_name_of_a_topic(tmp_path, monkeypatch, capsys):
    name = "/endoscope/of/a/robot/" + "x" * 30
    with RobotBag(tmp_path / "bag") as bag:
        bag.pose(name, 0, [0, 0, 0])
    assert call(monkeypatch, "inspect", bag.path) == 0
    assert f" {name} " in capsys.readouterr().err


def test_options_of_bags_and_folders_are_not_mixed(tmp_path, monkeypatch, capsys):
    for path, option in ((small_bag(tmp_path / "bag"), "--recording"), (tmp_path, "--closed")):
        assert call(monkeypatch, "import", path, option, "x", "--out", tmp_path / "run.mcap") == 2
        assert f"{option} " in capsys.readouterr().err


def test_without_rosbags_the_extra_is_named(tmp_path):
    path = small_bag(tmp_path / "bag")
    program = (
        "import sys; sys.modules['rosbags'] = None\n"
        "from jiggle_mj.cli import main\n"
        f"sys.argv = ['jiggle-mj', 'import', {str(path)!r}, '--out', {str(tmp_path / 'run.mcap')!r}]\n"
        "main()"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 1 and "pip install 'jiggle-mj[ros]'" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.slow
@pytest.mark.render
@pytest.mark.parametrize("kind", ("ros1", "mcap"))
def test_the_estimate_from_a_bag_is_that_from_the_recording(tmp_path, monkeypatch, kind):
    """All figures but times, name and seed are equal, as images, poses, camera and declaration are, bit by bit."""
    monkeypatch.chdir(tmp_path)
    assert call(monkeypatch, "record", scene_file(tmp_path), "--out", tmp_path / "run.mcap") == 0
    bag, radius = as_bag(tmp_path / "run.mcap", tmp_path / "bag", kind)
    options = ("--grasp-radius", radius, "--topics", tmp_path / "map.toml")
    assert call(monkeypatch, "import", bag, "--out", tmp_path / "again.mcap", *options) == 0
    figures = []
    for name in ("run", "again"):
        assert call(monkeypatch, "estimate", tmp_path / f"{name}.mcap", "--out", tmp_path / name) == 0
        figures.append(json.loads((tmp_path / name / "result.json").read_text()))
    for each in figures:
        del each["timing"], each["scene"], each["seed"]
    assert figures[0] == figures[1]


def as_bag(path: Path, folder: Path, kind) -> tuple[Path, float]:
    """Write a recording as a robot would, and its declaration as map.toml."""
    recording = Recording.open(path)
    radius = 0.0
    with RobotBag(folder, kind) as bag:
        bag.cameras(recording.camera)
        for seen in recording:
            for report in seen.reports:
                bag.pose("/psm/measured_cp", report.time, report.position)
            bag.pose("/psm/measured_cp", seen.time, seen.tool.position, seen.tool.quat_wxyz)
            bag.write("/psm/closed", seen.time, "std_msgs/Bool", data=seen.tool.closed)
            bag.image("/left/image_raw", seen.time, "rgb8", seen.images.left)
            bag.compressed("/right/image_raw/compressed", seen.time + STEP // 100, seen.images.right)
            radius = seen.tool.radius
    declared = recording.declaration
    text = f"[declaration]\nmembrane_stiffness = {declared.membrane_stiffness}\npoisson = {declared.poisson}\n"
    text += f"thickness = {declared.thickness}\nareal_density = {declared.areal_density}\n"
    text += f"gravity = {list(declared.gravity)}\nbed = {str(declared.bed).lower()}\n"
    (folder.parent / "map.toml").write_text(text)
    return bag.path, radius
