from pathlib import Path

import pytest

from jiggle_mj.errors import OptionError, RecordingError
from jiggle_mj.importing.bags.settings import BagSettings, read_map, with_options
from jiggle_mj.observation import Declaration

MAP = """
[topics]
left = "/psm/left/image_raw"
tool = "tf:tip"
force = ""

[gripper]
closed = "jaw < 0.1"
radius = 0.004

[camera]
left = "left.yaml"
rectified = true

[time]
pairing_tolerance_ms = 12
clock = "receive"

[frames]
world = "base"

[points]
id = "label"
noise_sd = 1e-4

[depth]
range = [0.05, 0.3]
mask = "mask.png"
spacing = 0.003

[declaration]
membrane_stiffness = 12.0
"""


def test_every_key_of_a_map_is_read(tmp_path: Path):
    (tmp_path / "map.toml").write_text(MAP)
    found = read_map(tmp_path / "map.toml")
    assert found.topics == {"left": "/psm/left/image_raw", "tool": "tf:tip", "force": ""}
    assert (str(found.closed), found.grasp_radius) == ("closed where jaw.position < 0.1", 0.004)
    assert (found.camera_info, found.rectified) == ({"left": tmp_path / "left.yaml"}, True)
    assert (found.pairing_tolerance_ms, found.clock, found.world) == (12, "receive", "base")
    assert (found.id_field, found.noise_sd) == ("label", 1e-4)
    assert (found.depth.near, found.depth.far, found.depth.spacing) == (0.05, 0.3, 0.003)
    assert found.depth.mask == tmp_path / "mask.png"
    assert found.declaration == Declaration(membrane_stiffness=12.0)


def test_an_empty_map_says_nothing(tmp_path: Path):
    (tmp_path / "map.toml").write_text("")
    assert read_map(tmp_path / "map.toml") == BagSettings()


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("[topics]\nleftt = '/a'", r"unknown key 'leftt'; did you mean 'left'\? Known: depth"),
        ("[topic]\nleft = '/a'", "unknown key 'topic'"),
        ("[time]\nclock = 'gps'", "must be one of header, receive"),
        ("[depth]\nrange = [2, 1]", "the smaller first"),
        ("[gripper]\nclosed = 'jaw'", "must be a comparison"),
        ("[topics", "is not TOML"),
    ],
)
def test_a_map_that_cannot_be_is_named(tmp_path: Path, text: str, why: str):
    (tmp_path / "map.toml").write_text(text)
    with pytest.raises((RecordingError, OptionError), match=why):
        read_map(tmp_path / "map.toml")
    with pytest.raises(RecordingError, match="cannot be read"):
        read_map(tmp_path / "none.toml")


def test_options_go_before_the_map():
    given = BagSettings(topics={"left": "/a", "right": "/b"}, grasp_radius=0.004)
    found = with_options(given, topic=("left=/c",), closed="jaw<1", pairing_tolerance=9.0)
    assert found.topics == {"left": "/c", "right": "/b"} and found.grasp_radius == 0.004
    assert found.pairing_tolerance_ms == 9.0 and found.closed is not None


@pytest.mark.parametrize("changes", ({"topic": ("left",)}, {"topic": ("up=/a",)}, {"pairing_tolerance": -1.0}))
def test_options_out_of_range_are_refused(changes: dict):
    with pytest.raises(OptionError, match="must be"):
        with_options(BagSettings(), **changes)


def test_the_map_in_the_docs_is_read(tmp_path: Path):
    page = (Path(__file__).parents[4] / "docs" / "BAGS.md").read_text(encoding="utf-8")
    (tmp_path / "map.toml").write_text(page.partition("```toml\n")[2].partition("```")[0])
    found = read_map(tmp_path / "map.toml")
    assert found.topics["tool"] == "tf:psm_tool_tip" and found.declaration is not None
