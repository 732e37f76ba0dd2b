"""Each disturbance of the tissue displaces the lifted sheet as measured; those with a closed form agree with it."""

import dataclasses
from functools import cache

import numpy as np
import pytest

from jiggle_mj.actions import Grasp, Move, Release, Wait
from jiggle_mj.errors import SceneError
from jiggle_mj.scenes import DISTURBANCES, Reference, disturbed
from jiggle_mj.scenes.load_tests import hold
from jiggle_mj.scenes.scene.attachments import Disc
from jiggle_mj.scenes.scene.disturbance import TissueDisturbance
from jiggle_mj.scenes.scene.scene import BedConfig, Scene, TissueConfig
from jiggle_mj.scenes.scene_file import scene_from_table
from jiggle_mj.scenes.tissue.model import CONTACT_SOLIMP, CONTACT_SOLREF
from jiggle_mj.scenes.tissue.simulation import Simulation
from jiggle_mj.truth import TruthFrame

SCENE = Scene(
    name="lift",
    tissue=TissueConfig(size=(0.1, 0.1), spacing=7e-3),
    attachments=(Disc(centre=(0.0, 0.0), radius=0.016, stiffness=5.0),),
)
CORNER = np.array([-0.047, -0.047])
HEIGHT = 0.03
DISPLACEMENT = {
    "gravity=0": 6.041,
    "gravity=2": 1.080,
    "bed=0.002": 1.931,
    "friction=2": 1.325,
    "viscous_drag=1": 0.132,
    "material_damping=0.5": 0.271,
    "tissue_creep=0.3": 0.270,
    "inclusion=10": 0.501,
    "inclusion=0.1": 0.861,
    "heterogeneity=0.5": 0.640,
    "anisotropy=3": 1.101,
    "poisson=0.1": 0.389,
    "stretch=2": 0.936,
    "bending=20": 0.850,
    "pre_strain=0.03": 1.364,
    "strain_stiffening=400": 1.548,
    "tissue_yield=0.05": 2.051,
    "point_pull=5": 2.173,
    "adhesion=0.1": 2.019,
    "anchor_shift=0.002": 0.337,
    "anchor_creep=0.5": 0.143,
    "anchor_yield=0.001": 0.433,
    "anchor_break=0.01": 0.680,
    "substrate=1": 1.219,
    "grasp_slip=0.02": 8.459,
    "inertia=0.04": 0.711,
}
"""Root mean square displacement of the lifted sheet by each disturbance [mm], measured with MuJoCo 4.

On another layout and mesh, lifted as high, with 36 anchors of 5 N/m: friction 0.84, bending 0.60, inclusions 0.81 and
0.75, anisotropy 1.1, pre-strain 0.92, lag 0.46, slip 6.8.
"""
ENGINE = 0.05
"""Relative difference left for other releases of MuJoCo: contacts and slips may start a step earlier or later."""
AT_REST = 1e-3
"""Relative error of an equilibrium, since rest means a small speed and not 0."""


@cache
def lifted(*disturbances: str, scene: Scene = SCENE) -> tuple[TruthFrame, TruthFrame]:
    """Return the sheet at rest, and with a corner lifted by `HEIGHT` in three steps."""
    reference = Reference(disturbed(scene, disturbances), seed=0, sensing="particles")
    reference.step(Wait())
    rest = reference.truth_frame()
    point = rest.positions[np.argmin(np.linalg.norm(rest.positions[:, :2] - CORNER, axis=1))]
    reference.step(Grasp(point=point, radius=7e-3))
    for height in np.linspace(0, HEIGHT, 4)[1:]:
        reference.step(Move(to=point + np.array([0.0, 0.0, height])))
    return rest, reference.truth_frame()


def rms(first: TruthFrame, second: TruthFrame) -> float:
    """Return the root mean square distance between the vertices of two frames [mm]."""
    return 1e3 * float(np.sqrt(((first.positions - second.positions) ** 2).sum(axis=1).mean()))


def test_every_disturbance_of_the_tissue_is_measured():
    of_tissue = {name for name, cls in DISTURBANCES.items() if issubclass(cls, TissueDisturbance)}
    assert {text.partition("=")[0] for text in DISPLACEMENT} == of_tissue


@pytest.mark.parametrize("text", DISPLACEMENT)
def test_the_lifted_sheet_is_displaced_as_measured(text):
    assert rms(lifted(text)[1], lifted()[1]) == pytest.approx(DISPLACEMENT[text], rel=ENGINE)


def test_neutral_magnitudes_change_nothing():
    for text in (
        "gravity=1",
        "poisson=0.45",
        "stretch=1",
        "bending=1",
        "inclusion=1",
        "anisotropy=0",
        "pre_strain=0",
        "bed=0",
    ):
        np.testing.assert_array_equal(lifted(text)[1].positions, lifted()[1].positions)


def test_twice_all_stiffnesses_is_twice_youngs_modulus():
    """The two models are equal up to rounding, which numpy's default of 1e-7 leaves room for."""
    stiffer = dataclasses.replace(SCENE, tissue=dataclasses.replace(SCENE.tissue, young=60e3))
    np.testing.assert_allclose(lifted("stretch=2", "bending=2")[1].positions, lifted(scene=stiffer)[1].positions)


def test_another_poissons_ratio_is_a_tissue_of_that_ratio_that_bends_as_before():
    """To 1e-9: the difference of the energies is added to the compiled stiffness, with rounding."""
    other = dataclasses.replace(SCENE, tissue=dataclasses.replace(SCENE.tissue, poisson=0.1))
    changed, declared, plain = (
        Simulation(scene, drawn=False).model for scene in (disturbed(SCENE, ["poisson=0.1"]), other, SCENE)
    )
    np.testing.assert_allclose(changed.flex_stiffness, declared.flex_stiffness, rtol=1e-9)
    np.testing.assert_array_equal(changed.flex_bending, plain.flex_bending)


def test_a_raised_bed_raises_the_sheet():
    rest = lifted("bed=0.002")[0].positions[:, 2] - lifted()[0].positions[:, 2]
    np.testing.assert_allclose(rest, 2e-3, atol=5e-5)  # a fortieth of the rise: the springs pull the middle down


def test_a_tilted_bed_tilts_the_sheet():
    """By the tangent of its tilt, within 5 %: the attachments hold the middle of the sheet level."""
    table = {"disturbances": [{"name": "bed", "magnitude": 0.0, "tilt_deg": 3.0, "azimuth_deg": 180.0}]}
    x, _, z = lifted(scene=dataclasses.replace(SCENE, disturbances=_read(table)))[0].positions.T
    assert np.polyfit(x, z, 1)[0] == pytest.approx(np.tan(np.radians(3.0)), rel=0.05)


WEIGHTLESS = disturbed(
    Scene(name="floating", tissue=TissueConfig(size=(0.06, 0.06), spacing=8e-3), bed=BedConfig(present=False)),
    ["gravity=0"],
)


@pytest.mark.parametrize(("uniaxial", "direction_deg"), [(0.0, 0.0), (1.0, 30.0)])
def test_a_floating_sheet_shrinks_by_its_pre_strain(uniaxial, direction_deg):
    """Homogeneously, in all directions or along one: affine within 2 um, and the strain within 1 % of 0.03."""
    pre_strain = DISTURBANCES["pre_strain"](magnitude=0.03, uniaxial=uniaxial, direction_deg=direction_deg)
    scene = dataclasses.replace(WEIGHTLESS, disturbances=(*WEIGHTLESS.disturbances, pre_strain))
    simulation = Simulation(scene, drawn=False)
    simulation.settle(speed=1e-7)
    place = simulation.tissue.sheet.vertices
    homogeneous = np.column_stack([place, np.ones(len(place))])
    shrunk = place + simulation.anchors.displacement[:, :2]
    affine, *_ = np.linalg.lstsq(homogeneous, shrunk)
    np.testing.assert_allclose(homogeneous @ affine, shrunk, atol=2e-6)
    along = np.array([np.cos(np.radians(direction_deg)), np.sin(np.radians(direction_deg))])
    across = np.array([-along[1], along[0]])
    assert along @ affine[:2] @ along == pytest.approx(0.97, abs=3e-4)
    assert across @ affine[:2] @ across == pytest.approx(1.0 if uniaxial else 0.97, abs=3e-4)


@pytest.mark.parametrize("stretch", [0.02, 0.05])
def test_strain_stiffening_multiplies_the_force_by_its_formula(stretch):
    """By 1 + 400 E^2 for a sheet that is stretched along x only, with E = e + e^2 / 2."""
    forces = []
    for texts in ([], ["strain_stiffening=400"]):
        simulation = Simulation(disturbed(WEIGHTLESS, texts), drawn=False)
        sheet, springs = simulation.tissue.sheet, simulation.anchors.attachments
        stretched = stretch * np.column_stack([sheet.vertices[:, 0], np.zeros((len(sheet.vertices), 2))])
        hold(simulation, sheet.outline(), stretched)
        simulation.settle(speed=1e-7)
        pull = springs.stiffness * (springs.anchor - simulation.anchors.displacement)[:, 0]
        forces.append(sheet.vertices[:, 0] @ pull)
    assert forces[1] / forces[0] == pytest.approx(1 + 400 * (stretch + stretch**2 / 2) ** 2, rel=AT_REST)


def test_a_tilted_weight_pulls_along_its_direction():
    """The displacements of a sheet on springs of 1 N/m sum to its weight over 1 N/m, along gravity."""
    held = (Disc(centre=(0.0, 0.0), radius=0.1, stiffness=1.0),)
    tilted = _read({"disturbances": [{"name": "gravity", "magnitude": 0.5, "tilt_deg": 30.0, "azimuth_deg": 60.0}]})
    simulation = Simulation(dataclasses.replace(WEIGHTLESS, attachments=held, disturbances=tilted), drawn=False)
    tissue, moved = WEIGHTLESS.tissue, simulation.anchors.displacement
    weight = 0.5 * 9.81 * tissue.density * tissue.thickness * tissue.size[0] * tissue.size[1]
    direction = [np.sin(np.pi / 6) * np.cos(np.pi / 3), np.sin(np.pi / 6) * np.sin(np.pi / 3), -np.cos(np.pi / 6)]
    np.testing.assert_allclose(moved.sum(axis=0), weight * np.array(direction), rtol=AT_REST)


@pytest.mark.parametrize("softness", [100.0, 1000.0])
def test_a_sheet_sinks_into_a_soft_bed_by_its_weight_over_the_contacts_stiffness(softness):
    """The stiffness at a vertex of mass m is m times that of MuJoCo's direct form times d / (1 - d), d the impedance.

    Within 1 %: d is taken at its largest value, which it nears with depth.
    """
    table = {"disturbances": [{"name": "bed", "magnitude": 0.0, "softness": softness}]}
    scene = Scene(name="soft", tissue=WEIGHTLESS.tissue, disturbances=_read(table))
    simulation = Simulation(scene, drawn=False)
    simulation.settle(speed=1e-8)
    (hard, _), (_, impedance, *_) = CONTACT_SOLREF, CONTACT_SOLIMP
    depth = 9.81 * softness / -hard * (1 - impedance) / impedance
    assert -simulation.anchors.displacement[:, 2].mean() == pytest.approx(depth, rel=0.01)


def test_broken_attachments_are_gone_and_have_no_load():
    frame = lifted("anchor_break=0.01")[1]
    broken = (lifted()[1].stiffness > 0) & (frame.stiffness == 0)
    assert 0 < broken.sum() < (lifted()[1].stiffness > 0).sum()
    assert not frame.load[broken].any()
    assert frame.load.max() <= 0.01


def test_vertices_that_slip_are_lost_and_the_others_stay_below_the_limit():
    limit, point = 0.02, np.array([*CORNER, 4e-4])
    reference = Reference(disturbed(SCENE, [f"grasp_slip={limit}"]), seed=0, sensing="particles")
    reference.step(Grasp(point=point, radius=9e-3))
    held = reference.held
    for height in (0.01, 0.02, 0.03):
        reference.step(Move(to=point + np.array([0.0, 0.0, height])))
    assert reference.held.sum() < held.sum() and not (reference.held & ~held).any()
    assert reference.simulation.jaws.force().max() <= limit
    reference.step(Release())
    reference.step(Wait())
    place = reference.truth_frame().positions
    reference.step(Grasp(point=place[np.argmin(place[:, 0] + place[:, 1])], radius=9e-3))
    assert reference.held.any()


def test_a_later_disturbance_is_not_undone_by_strain_stiffening():
    """A sheet that stiffens from the start and is twice as stiff from 0.5 s on.

    It differs from one that only stiffens by 0.3 mm, a third of the effect of twice the stiffness, and by less than
    0.1 mm, a tenth, from one that had both from the start.
    """
    late = [{"name": "strain_stiffening", "magnitude": 400.0}, {"name": "stretch", "magnitude": 2.0, "start": 0.5}]
    both = lifted(scene=dataclasses.replace(SCENE, disturbances=_read({"disturbances": late})))[1]
    assert rms(both, lifted("strain_stiffening=400")[1]) > 0.3
    assert rms(both, lifted("strain_stiffening=400", "stretch=2")[1]) < 0.1


def test_a_disturbance_waits_for_its_start():
    """Nothing differs before; later the sheet differs by over 1 mm, a sixth of what gravity does from the start."""
    table = {"disturbances": [{"name": "gravity", "magnitude": 0.0, "start": 0.5}]}
    late = lifted(scene=dataclasses.replace(SCENE, disturbances=_read(table)))
    np.testing.assert_array_equal(late[0].positions, lifted()[0].positions)
    assert rms(late[1], lifted()[1]) > 1


def test_several_act_together():
    """The sheet differs from each alone by more than 0.2 mm, under half of the smaller displacement."""
    both = lifted("inclusion=10", "friction=2")[1]
    assert min(rms(both, lifted(text)[1]) for text in ("inclusion=10", "friction=2")) > 0.2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("gravitation", r"no disturbance named 'gravitation'.* There are gravity, bed, "),
        ("gravty=2", "no disturbance named 'gravty'; did you mean 'gravity'\\?"),
        ("gravity.tilt_deg=20", "other keys of gravity go into a scene file"),
        ("gravity=much", "'gravity=much': the magnitude must be a number"),
        ("gravity=11", r"gravity = 11\.0: must be a number in \[0, 10\]"),
        ("bed=nan", "bed = nan: must be a number in"),
    ],
)
def test_an_impossible_disturbance_is_refused(text, message):
    with pytest.raises(SceneError, match=message):
        disturbed(SCENE, [text])


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"disturbances": [{"name": "gravitation"}]}, r"no disturbance named 'gravitation'.* There are gravity"),
        ({"disturbances": [{"magnitude": 1.0}]}, "lacks its name"),
        ({"disturbances": [{"name": "bed", "hight": 1.0}]}, "hight"),
        ({"disturbances": [{"name": "bed", "magnitude": 1.0}]}, "magnitude = 1.0: must be a number in"),
        ({"disturbances": [{"name": "bed", "start": -1.0}]}, "start = -1.0"),
        ({"disturbances": [{"name": "inclusion", "centre": [0.5, 0.5]}]}, r"inclusion.centre = .*off the sheet"),
        ({"disturbances": [{"name": "point_pull", "at": [0.0, -0.08]}]}, r"point_pull.at = .*: 30.0 mm off the sheet"),
        ({"disturbances": [{"name": "tool_bias", "direction": [0, 0, 0]}]}, "3 numbers, not all 0"),
        ({"disturbances": "gravity"}, "must be an array of tables"),
        ({"secret": "yes"}, "secret = 'yes': must be true or false"),
    ],
)
def test_a_scene_file_with_an_impossible_disturbance_is_refused(table, message):
    with pytest.raises(SceneError, match=message):
        scene_from_table(table, name="it")


def _read(table: dict) -> tuple:
    return scene_from_table(table, name="it").disturbances
