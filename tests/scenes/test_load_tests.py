"""The load tests against closed forms: the stiffness of the scene's material, and what disturbances of it change."""

import dataclasses
import json
import math

import numpy as np
import pytest

from jiggle_mj.scenes import disturbed
from jiggle_mj.scenes.load_tests import floating, load_tests, measured_stiffness, typed, upward_stiffness
from jiggle_mj.scenes.scene.scene import DeclaredConfig, Scene, TissueConfig
from tests.support.tiny_scene import call, scene_file

COARSE = Scene(name="sheet", tissue=TissueConfig(size=(0.1, 0.1), spacing=9e-3))
FINITE_STRAIN = 1e-3
"""Relative error of a stiffness: a membrane is tested at strains of 2e-3 with both signs, and clamps give a little."""


def on(mesh: str, spacing: float) -> Scene:
    return dataclasses.replace(COARSE, tissue=dataclasses.replace(COARSE.tissue, mesh=mesh, spacing=spacing))


@pytest.mark.parametrize("mesh", ["equilateral", "unstructured"])
def test_the_membrane_is_the_typed_one(mesh):
    """In uniaxial stress along both axes and in shear; the strain is homogeneous, so any mesh is exact."""
    measured, nominal = measured_stiffness(on(mesh, 9e-3)), typed(COARSE.tissue)
    for name in ("stretch_x", "stretch_y", "poisson", "shear"):
        assert getattr(measured, name) == pytest.approx(getattr(nominal, name), rel=FINITE_STRAIN / 2), name


def test_a_clamped_disc_bends_as_a_plate_does():
    """Within 2 % on equilateral triangles of 6 mm, and within 6 % on jittered ones."""
    for mesh, within in (("equilateral", 0.02), ("unstructured", 0.06)):
        measured, nominal = measured_stiffness(on(mesh, 6e-3)), typed(COARSE.tissue)
        assert measured.bending == pytest.approx(nominal.bending, rel=within)


def test_a_cantilever_deflects_as_a_beam_does():
    """By q L^4 / (8 D) at its end, without contraction across.

    Half a row of triangles bends freely along each free edge, so meshes converge linearly: 1.19 at 5 mm, 1.08 at
    2.5 mm; extrapolated to a spacing of 0 the ratio is 1 within 3 %.
    """
    coarse, fine = (deflection_over_beam(spacing) for spacing in (5e-3, 2.5e-3))
    assert 1 < fine < coarse
    assert 2 * fine - coarse == pytest.approx(1.0, abs=0.03)


def deflection_over_beam(spacing: float) -> float:
    """Return the deflection of a strip that is clamped up to x = -0.02 under a unit pressure, over that of a beam."""
    tissue = TissueConfig(size=(0.12, 0.08), spacing=spacing, mesh="equilateral", poisson=0.0)
    simulation = floating(Scene(name="beam", tissue=tissue))
    sheet = simulation.tissue.sheet
    x = sheet.vertices[:, 0]
    free = np.flatnonzero(x > -0.02)
    deflection = np.zeros(len(x))
    deflection[free] = np.linalg.solve(upward_stiffness(simulation, free), sheet.vertex_areas()[free])
    length = x.max() - x[x <= -0.02].max()
    return deflection[x > x.max() - 1e-6].mean() / (length**4 / (8 * typed(tissue).bending))


def test_disturbances_of_the_material_are_measured():
    """Fibres along x add m E t to the stiffness xx, and nothing else; bending is scaled up to rounding of its fit."""
    plain, nominal, m = measured_stiffness(COARSE), typed(COARSE.tissue), 3.0
    assert measured_stiffness(disturbed(COARSE, ["stretch=2"])).stretch_x == pytest.approx(
        2 * nominal.stretch_x, rel=FINITE_STRAIN
    )
    assert measured_stiffness(disturbed(COARSE, ["bending=20"])).bending == pytest.approx(20 * plain.bending, rel=1e-6)
    narrower = measured_stiffness(disturbed(COARSE, ["poisson=0.1"]))
    assert narrower.poisson == pytest.approx(0.1, abs=1e-3)
    assert (narrower.stretch_x, narrower.bending) == pytest.approx(
        (nominal.stretch_x, plain.bending), rel=FINITE_STRAIN
    )
    fibres = measured_stiffness(disturbed(COARSE, [f"anisotropy={m}"]))
    nu = COARSE.tissue.poisson
    membrane = nominal.stretch_x / (1 - nu**2) * np.array([[1, nu], [nu, 1]]) + np.diag([m * nominal.stretch_x, 0.0])
    compliance = np.linalg.inv(membrane)
    assert fibres.stretch_x == pytest.approx(1 / compliance[0, 0], rel=FINITE_STRAIN)
    assert fibres.stretch_y == pytest.approx(1 / compliance[1, 1], rel=FINITE_STRAIN)
    assert fibres.shear == pytest.approx(nominal.shear, rel=FINITE_STRAIN)


def test_a_stiff_spot_makes_the_sheet_stiffer_but_not_as_stiff_as_itself():
    """A spot of 4.5 % of the area and 10 times the stiffness: by more than 2 %, by less than a factor of 2."""
    assert 1.02 < measured_stiffness(disturbed(COARSE, ["inclusion=10"])).stretch_x / typed(COARSE.tissue).stretch_x < 2


def test_a_mesh_that_would_be_too_coarse_is_left_out():
    rough = Scene(name="rough", tissue=TissueConfig(size=(0.06, 0.06), spacing=0.012))
    assert [result.spacing for result in load_tests(rough)] == pytest.approx([0.012, 0.009])


def test_bending_is_nan_on_a_mesh_too_coarse_for_it():
    assert math.isnan(measured_stiffness(on("equilateral", 0.02)).bending)


def test_scene_check_names_quantities_that_differ_from_the_declared_ones(tmp_path, monkeypatch, capsys):
    assert call(monkeypatch, "scene-check", scene_file(tmp_path), "--disturb", "stretch=2", "--json") == 0
    printed = capsys.readouterr()
    result = json.loads(printed.out)
    assert [mesh["spacing"] for mesh in result["effective"]] == pytest.approx([10.5e-3, 7e-3, 5.25e-3])
    assert result["effective"][1]["stretch_x"] == pytest.approx(
        2 * DeclaredConfig().membrane_stiffness, rel=FINITE_STRAIN
    )
    assert result["typed"]["stretch_x"] == pytest.approx(DeclaredConfig().membrane_stiffness)
    assert "stretch x is 2 times what [declared] says" in printed.err
    assert "shear is 2 times" in printed.err and "poisson is" not in printed.err
