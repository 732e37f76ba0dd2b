"""The load tests against closed forms: what is typed is found, and what a disturbance of the material adds."""

import dataclasses
import json
import math

import numpy as np
import pytest

from jiggle_mj.scenes import disturbed
from jiggle_mj.scenes.load_tests import floating, load_tests, stiffness, typed, upward_stiffness
from jiggle_mj.scenes.scene.scene import DeclaredConfig, Scene, TissueConfig
from tests.support.tiny_scene import call, scene_file

COARSE = Scene(name="sheet", tissue=TissueConfig(size=(0.1, 0.1), spacing=9e-3))


def on(mesh: str, spacing: float) -> Scene:
    return dataclasses.replace(COARSE, tissue=dataclasses.replace(COARSE.tissue, mesh=mesh, spacing=spacing))


@pytest.mark.parametrize("mesh", ["equilateral", "unstructured"])
def test_the_membrane_is_the_typed_one(mesh):
    """Uniaxial stress both ways and shear, of triangles whose strain is homogeneous: exact on any mesh."""
    found, stated = stiffness(on(mesh, 9e-3)), typed(COARSE.tissue)
    for name in ("stretch_x", "stretch_y", "poisson", "shear"):
        assert getattr(found, name) == pytest.approx(getattr(stated, name), rel=5e-4), name


def test_a_clamped_disc_bends_as_a_plate_does():
    """Within 2 % on equilateral triangles of 6 mm, and within 6 % on jittered ones."""
    for mesh, within in (("equilateral", 0.02), ("unstructured", 0.06)):
        found, stated = stiffness(on(mesh, 6e-3)), typed(COARSE.tissue)
        assert found.bending == pytest.approx(stated.bending, rel=within)


def test_a_cantilever_droops_as_a_beam_does():
    """q L^4 / (8 D) at its end, without contraction across. Half a row of triangles bends freely along each free edge,
    so that meshes come to it linearly: 1.19 at 5 mm, 1.08 at 2.5 mm, and what both say of a spacing of 0 is right."""
    coarse, fine = (droop_over_beam(spacing) for spacing in (5e-3, 2.5e-3))
    assert 1 < fine < coarse
    assert 2 * fine - coarse == pytest.approx(1.0, abs=0.03)


def droop_over_beam(spacing: float) -> float:
    """Of the end of a strip that is held up to x = -0.02 and bears a unit pressure."""
    tissue = TissueConfig(size=(0.12, 0.08), spacing=spacing, mesh="equilateral", poisson=0.0)
    simulation = floating(Scene(name="beam", tissue=tissue))
    sheet = simulation.tissue.sheet
    x = sheet.vertices[:, 0]
    free = np.flatnonzero(x > -0.02)
    droop = np.zeros(len(x))
    droop[free] = np.linalg.solve(upward_stiffness(simulation, free), sheet.vertex_areas()[free])
    length = x.max() - x[x <= -0.02].max()
    return droop[x > x.max() - 1e-6].mean() / (length**4 / (8 * typed(tissue).bending))


def test_disturbances_of_the_material_show():
    """Fibres along x add m E t to the stiffness xx, and nothing else."""
    plain, stated, m = stiffness(COARSE), typed(COARSE.tissue), 3.0
    assert stiffness(disturbed(COARSE, ["stretch=2"])).stretch_x == pytest.approx(2 * stated.stretch_x, rel=1e-3)
    assert stiffness(disturbed(COARSE, ["bending=20"])).bending == pytest.approx(20 * plain.bending, rel=1e-6)
    narrower = stiffness(disturbed(COARSE, ["poisson=0.1"]))
    assert narrower.poisson == pytest.approx(0.1, abs=1e-3)
    assert (narrower.stretch_x, narrower.bending) == pytest.approx((stated.stretch_x, plain.bending), rel=1e-3)
    fibres = stiffness(disturbed(COARSE, [f"anisotropy={m}"]))
    nu = COARSE.tissue.poisson
    own = stated.stretch_x / (1 - nu**2) * np.array([[1, nu], [nu, 1]]) + np.diag([m * stated.stretch_x, 0.0])
    compliance = np.linalg.inv(own)
    assert fibres.stretch_x == pytest.approx(1 / compliance[0, 0], rel=1e-3)
    assert fibres.stretch_y == pytest.approx(1 / compliance[1, 1], rel=1e-3)
    assert fibres.shear == pytest.approx(stated.shear, rel=1e-3)


def test_a_stiff_spot_makes_the_sheet_stiffer_but_not_as_stiff_as_itself():
    assert 1.02 < stiffness(disturbed(COARSE, ["inclusion=10"])).stretch_x / typed(COARSE.tissue).stretch_x < 2


def test_a_mesh_that_would_be_too_coarse_is_left_out():
    rough = Scene(name="rough", tissue=TissueConfig(size=(0.06, 0.06), spacing=0.012))
    assert [one.spacing for one in load_tests(rough)] == pytest.approx([0.012, 0.009])


def test_bending_is_not_told_on_a_mesh_too_coarse_for_it():
    assert math.isnan(stiffness(on("equilateral", 0.02)).bending)


def test_the_verb_says_where_the_declared_material_is_not_the_sheets(tmp_path, monkeypatch, capsys):
    assert call(monkeypatch, "scene-check", scene_file(tmp_path), "--disturb", "stretch=2", "--json") == 0
    printed = capsys.readouterr()
    said = json.loads(printed.out)
    assert [one["spacing"] for one in said["effective"]] == pytest.approx([10.5e-3, 7e-3, 5.25e-3])
    assert said["effective"][1]["stretch_x"] == pytest.approx(2 * DeclaredConfig().membrane_stiffness, rel=1e-3)
    assert said["typed"]["stretch_x"] == pytest.approx(DeclaredConfig().membrane_stiffness)
    assert "stretch x is 2 times what [declared] says" in printed.err
    assert "shear is 2 times" in printed.err and "poisson is" not in printed.err
