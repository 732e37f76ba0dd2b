"""Scene files: the shipped ones, reading and writing, and the messages of refusals."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jiggle_mj.errors import SceneError
from jiggle_mj.scenes import Scene, load_scene, scene_table, shipped_scenes
from jiggle_mj.scenes.scene.attachments import owners
from jiggle_mj.scenes.scene.programme import grasp_points
from jiggle_mj.scenes.scene.scene import TissueConfig
from jiggle_mj.scenes.scene_file import scene_from_table
from jiggle_mj.scenes.tissue.mesh import build_sheet

PAPER_COUNTS = {"line": 30, "arc": 54, "line_dot": 98, "arc_line": 110, "u_shape": 104}
"""Attached particles of the shapes in Shinde et al. 2024 (arXiv 2405.09743), as the project's brief lists them."""


def attached_vertices(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    tissue = scene.tissue
    sheet = build_sheet(size=tissue.size, spacing=tissue.spacing, kind=tissue.mesh, seed=tissue.seed)
    return sheet.vertices, owners(scene.attachments, sheet.vertices) >= 0


STIFFNESSES = {"arc_soft": 0.003, "arc": 1 / 30, "arc_stiff": 1.0, "arc_weld": np.inf}
"""Stiffness of an attached vertex over the membrane stiffness."""


PROCEDURES = {"detach": "large_attach", "suture": "line"}
"""Scenes for the policy of the same name, and the scenes that they are copies of."""


def test_the_shipped_scenes_are_complete():
    assert set(shipped_scenes()) == {*PAPER_COUNTS, *STIFFNESSES, *PROCEDURES, "large_attach", "free"}


@pytest.mark.parametrize("name", sorted(PROCEDURES))
def test_the_scenes_of_procedures_differ_in_their_policy_alone(name):
    original = load_scene(PROCEDURES[name])
    assert load_scene(name) == replace(original, name=name, programme=replace(original.programme, policy=name))


@pytest.mark.parametrize("name", sorted(STIFFNESSES))
def test_the_arcs_differ_in_stiffness_alone(name):
    scene, arc = load_scene(name), load_scene("arc")
    share = scene.attachments[0].stiffness / scene.declared.membrane_stiffness
    assert share == pytest.approx(STIFFNESSES[name])
    same = replace(scene.attachments[0], stiffness=arc.attachments[0].stiffness)
    assert replace(scene, name=arc.name, attachments=(same,)) == arc


@pytest.mark.parametrize("name", sorted(PAPER_COUNTS))
def test_attached_counts_are_within_a_tenth_of_the_papers(name):
    vertices, attached = attached_vertices(load_scene(name))
    assert 590 <= len(vertices) <= 630
    assert abs(attached.sum() - PAPER_COUNTS[name]) <= 0.1 * PAPER_COUNTS[name]


def test_the_free_scene_has_no_attachment():
    assert not attached_vertices(load_scene("free"))[1].any()


@pytest.mark.parametrize("name", [name for name in shipped_scenes() if name != "free"])
def test_no_shipped_grasp_holds_an_attached_vertex(name):
    scene = load_scene(name)
    vertices, attached = attached_vertices(scene)
    for point in grasp_points(scene):
        held = np.linalg.norm(vertices - point, axis=1) <= scene.tweezer.radius
        assert held.any() and not (held & attached).any()


@pytest.mark.parametrize("name", shipped_scenes())
def test_shipped_scenes_declare_what_the_tissue_is(name):
    scene = load_scene(name)
    declared, tissue = scene.declared.declaration(), scene.tissue
    assert declared.membrane_stiffness == pytest.approx(tissue.young * tissue.thickness)
    assert declared.areal_density == pytest.approx(tissue.density * tissue.thickness)
    assert (declared.poisson, declared.thickness, declared.bed) == (tissue.poisson, tissue.thickness, True)
    assert "[declared]" in (Path(__file__).parents[2] / "scenes" / f"{name}.toml").read_text()


@pytest.mark.parametrize("name", shipped_scenes())
def test_the_table_of_a_scene_reads_back_as_the_same_scene(name):
    scene = load_scene(name)
    assert scene_from_table(scene_table(scene), name=name) == scene


def test_every_shape_with_a_weld_reads_back(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(
        """
        [[attachments]]
        shape = "polygon"
        points = [[0, 0], [0.01, 0], [0.01, 0.01]]
        stiffness = "weld"
        [[attachments]]
        shape = "disc"
        centre = [-0.02, 0]
        radius = 0.008
        stiffness = 3
        """
    )
    scene = load_scene(path)
    assert scene.name == "mine"
    assert [shape.stiffness for shape in scene.attachments] == [math.inf, 3.0]
    assert scene_from_table(scene_table(scene), name="mine") == scene
    assert scene_table(scene)["attachments"][0]["stiffness"] == "weld"


BAD = {
    "unknown table": ({"tisue": {}}, ["tisue", "tissue"]),
    "unknown key": ({"tissue": {"yung": 1.0}}, ["yung", "young", "tissue"]),
    "wrong type": ({"tissue": {"young": "soft"}}, ["tissue.young", "'soft'", "a number"]),
    "boolean for a number": ({"tissue": {"young": True}}, ["tissue.young", "True"]),
    "not finite": ({"tissue": {"young": math.nan}}, ["tissue.young", "nan"]),
    "zero thickness": ({"tissue": {"thickness": 0}}, ["tissue.thickness", "0", "(0, 0.02]"]),
    "incompressible": ({"tissue": {"poisson": 0.5}}, ["tissue.poisson", "0.5", "[0, 0.5)"]),
    "millimetres": ({"tissue": {"size": [60, 60]}}, ["tissue.size", "60", "(0, 1]"]),
    "too fine a mesh": ({"tissue": {"spacing": 1e-4}}, ["tissue.spacing", "vertices", "20000"]),
    "crossing sides": (
        {"attachments": [{"shape": "polygon", "points": [[0, 0], [0.01, 0.01], [0.01, 0], [0, 0.01]], "stiffness": 1}]},
        ["attachments[0].points", "point 0 and point 2 cross"],
    ),
    "two-number size": ({"tissue": {"size": [0.1]}}, ["tissue.size", "[0.1]", "2 numbers"]),
    "negative size": ({"tissue": {"size": [0.1, -0.1]}}, ["tissue.size", "(0, 1]"]),
    "mesh": ({"tissue": {"mesh": "grid"}}, ["tissue.mesh", "'grid'", "'equilateral'", "'unstructured'"]),
    "coarse mesh": ({"tissue": {"spacing": 0.04}}, ["tissue.spacing", "0.04", "0.025"]),
    "fraction of a frame": ({"programme": {"still_frames": 2.5}}, ["programme.still_frames", "whole number"]),
    "grasp off the sheet": ({"programme": {"points": [[0.0, 0.08]]}}, ["programme.points", "0.08", "0.05"]),
    "points": ({"programme": {"points": [[0.0]]}}, ["programme.points", "[x, y]"]),
    "bed": ({"bed": {"present": 1}}, ["bed.present", "true or false"]),
    "seed": ({"seed": -1}, ["seed", "-1"]),
    "section is no table": ({"bed": 3}, ["bed", "table"]),
    "attachments are no array": ({"attachments": {}}, ["[[attachments]]"]),
    "shape": ({"attachments": [{"shape": "star"}]}, ["attachments[0].shape", "'star'", "'polygon'"]),
    "missing": ({"attachments": [{"shape": "disc", "radius": 0.01, "stiffness": 1.0}]}, ["attachments[0]", "centre"]),
    "stiffness": (
        {"attachments": [{"shape": "disc", "centre": [0, 0], "radius": 0.01, "stiffness": 0}]},
        ["attachments[0].stiffness", "'weld'"],
    ),
    "foreign key of a shape": (
        {"attachments": [{"shape": "disc", "centre": [0, 0], "radius": 0.01, "stiffness": 1, "start": [0, 0]}]},
        ["'start'", "attachments[0]", "centre"],
    ),
    "arc backwards": (
        {
            "attachments": [
                {"shape": "arc", "centre": [0, 0], "radius": 0.02, "start_deg": 90, "end_deg": 0, "width": 0.01}
                | {"stiffness": 1}
            ]
        },
        ["end_deg", "start_deg", "90"],
    ),
    "declared": ({"declared": {"poisson": 0.7}}, ["declared.poisson", "0.7", "[0, 0.5)"]),
}


@pytest.mark.parametrize("case", sorted(BAD))
def test_a_wrong_scene_is_refused_with_key_value_and_what_is_allowed(case):
    table, words = BAD[case]
    with pytest.raises(SceneError) as refusal:
        scene_from_table(table, name="bad")
    for word in words:
        assert word in str(refusal.value)


def test_a_scene_built_in_python_is_checked_like_a_file():
    with pytest.raises(SceneError, match=r"tissue\.poisson = 0\.5: must be a number in \[0, 0\.5\)"):
        TissueConfig(poisson=0.5)


def test_an_unknown_name_lists_the_shipped_scenes():
    with pytest.raises(SceneError, match=r"no scene named 'ark'.*arc, arc_line, arc_soft"):
        load_scene("ark")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(SceneError, match=r"cannot read the scene file .*absent\.toml"):
        load_scene(tmp_path / "absent.toml")


@pytest.mark.parametrize("content", [b"tissue = [", b"\xff\xfe\x00"])
def test_a_malformed_file_is_named(tmp_path, content):
    path = tmp_path / "broken.toml"
    path.write_bytes(content)
    with pytest.raises(SceneError, match=r"broken\.toml"):
        load_scene(path)
