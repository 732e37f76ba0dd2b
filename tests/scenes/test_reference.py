"""The reference tissue: forces, grasps, determinism, and what it refuses. A small sheet keeps the tests quick."""

import dataclasses
import inspect
import itertools
import json
import math

import mujoco
import numpy as np
import pytest

from jiggle_mj.actions import Grasp, Move, Release, Wait
from jiggle_mj.errors import ActionError, OptionError, SimulationError
from jiggle_mj.scenes import Reference, Scene, programme
from jiggle_mj.scenes.scene.attachments import Disc
from jiggle_mj.scenes.scene.scene import BedConfig, ProgrammeConfig, TissueConfig, TweezerConfig
from jiggle_mj.scenes.tissue import simulation
from jiggle_mj.scenes.tissue.jaws import OPEN_ANGLE
from tests.support.small_scene import Explosion

TISSUE = TissueConfig(size=(0.06, 0.06), spacing=6e-3)
MIDDLE = Disc(centre=(0.0, 0.0), radius=0.012, stiffness=1.0)
CORNER = np.array([-0.027, -0.027, 4e-4])
SCENE = Scene(
    name="small",
    tissue=TISSUE,
    attachments=(MIDDLE,),
    tweezer=TweezerConfig(radius=8e-3),
    programme=ProgrammeConfig(still_frames=2, height=0.02, increments=2),
)


def particles(scene: Scene = SCENE, seed: int = 0) -> Reference:
    return Reference(scene, seed=seed, sensing="particles")


def net_force(reference: Reference) -> np.ndarray:
    """Return the net force of springs, weight and constraints (grip, bed, welds) [N]; elastic forces cancel."""
    model, data, tissue = reference.simulation.tissue.model, reference.simulation.data, reference.simulation.tissue
    mujoco.mj_forward(model, data)
    stretch = data.qpos[tissue.qpos_address] - model.qpos_spring[tissue.qpos_address]
    springs = -np.where(np.isfinite(tissue.stiffness), tissue.stiffness, 0)[:, None] * stretch
    constraint = data.qfrc_constraint[model.jnt_dofadr[tissue.joints]]
    mass = TISSUE.density * TISSUE.thickness * np.prod(TISSUE.size)
    return springs.sum(axis=0) + constraint.sum(axis=0) + mass * model.opt.gravity


def test_a_hanging_sheet_stretches_its_springs_by_its_weight():
    """Without a bed every vertex hangs on k: sum of k * dz = m g, for three decades of k."""
    for k in (0.5, 5.0, 50.0):
        everywhere = Disc(centre=(0.0, 0.0), radius=0.1, stiffness=k)
        scene = dataclasses.replace(SCENE, bed=BedConfig(present=False), attachments=(everywhere,))
        reference = particles(scene)
        for _ in range(10):
            reference.step(Wait())
        data, tissue = reference.simulation.data, reference.simulation.tissue
        drop = -data.qpos[tissue.qpos_address[:, 2]]
        weight = TISSUE.density * TISSUE.thickness * np.prod(TISSUE.size) * 9.81
        # The sheet starts from unstretched springs; a second later the rest of its fall is below 1e-5 of it.
        assert k * drop.sum() == pytest.approx(weight, rel=1e-4)


def test_the_compiled_sheet_weighs_density_times_volume():
    """m = rho * t * Lx * Ly, each vertex a third of its triangles."""
    model = particles().simulation.tissue.model
    flesh = [model.body_mass[model.body(f"v{i}").id] for i in range(model.nflexvert)]
    assert sum(flesh) == pytest.approx(TISSUE.density * TISSUE.thickness * np.prod(TISSUE.size), rel=1e-12)


def test_a_strip_pulled_at_both_ends_has_the_typed_modulus():
    """F / (width e) = E t (1 + e) (1 + e / 2), St Venant-Kirchhoff in uniaxial stress, e the strain of the middle.

    Measured 30.61 N/m against 30.60 at e = 1.3 %; 2 % is left for the effect of the ends, which cannot narrow.
    """
    length, width = 0.12, 0.03
    tissue = TissueConfig(size=(length, width), spacing=6e-3)
    ends = tuple(Disc(centre=(x, 0.0), radius=0.02, stiffness=math.inf) for x in (-length / 2, length / 2))
    reference = particles(dataclasses.replace(SCENE, tissue=tissue, attachments=ends, bed=BedConfig(friction=0.0)))
    model, data = reference.simulation.tissue.model, reference.simulation.data
    rest = reference.simulation.tissue.sheet.vertices
    right = np.flatnonzero(np.isinf(reference.simulation.tissue.stiffness) & (rest[:, 0] > 0))
    left = np.flatnonzero(np.isinf(reference.simulation.tissue.stiffness) & (rest[:, 0] < 0))
    for i in right:
        model.eq_data[model.equality(f"weld{i}").id, 3] += 0.01 * length
    for _ in range(5):
        reference.step(Wait())
    dofs = model.jnt_dofadr[reference.simulation.tissue.joints]
    moved = data.qpos[reference.simulation.tissue.qpos_address[:, 0]]
    inner = np.abs(rest[:, 0]) < 0.025
    strain = np.polyfit(rest[inner, 0], moved[inner], 1)[0]
    force = abs(data.qfrc_constraint[dofs[left, 0]].sum())
    assert strain > 0.01
    expected = tissue.young * tissue.thickness * (1 + strain) * (1 + strain / 2)
    assert force / (width * strain) == pytest.approx(expected, rel=0.02)


def test_forces_balance_at_rest_while_lifted():
    """Springs + weight + grip + bed = 0 within 0.5 % of the weight, as rest means 1 mm/s, not 0; measured 0.1 %."""
    reference = particles()
    reference.step(Grasp(point=CORNER, radius=8e-3))
    reference.step(Move(to=CORNER + np.array([0.0, 0.0, 0.02])))
    reference.step(Wait())
    weight = TISSUE.density * TISSUE.thickness * np.prod(TISSUE.size) * 9.81
    assert np.abs(net_force(reference)).max() < 0.005 * weight


def test_held_vertices_follow_the_tip_and_attached_ones_lag():
    """Held ones by the lift, attached ones by less than half of it."""
    reference = particles()
    reference.step(Grasp(point=CORNER, radius=8e-3))
    held, before = reference.held, reference.truth_frame().positions
    lift = np.array([0.003, 0.003, 0.02])
    reference.step(Move(to=CORNER + lift))
    moved = reference.truth_frame().positions - before
    assert held.sum() >= 3
    # Measured 0.17 mm: 0.08 mm slack of the grip's constraint, the rest from normals that rotate (radius 0.2 mm).
    assert np.linalg.norm(moved[held] - lift, axis=1).max() < 4e-4
    attached = reference.truth().attached
    assert np.linalg.norm(moved[attached], axis=1).max() < 0.5 * np.linalg.norm(lift)


def test_an_attached_vertex_can_be_held_too():
    """Grip and spring on one vertex: it follows the tip within a tenth of the lift, and its spring is stretched."""
    reference = particles()
    point = np.array([0.0, 0.0, 4e-4])
    reference.step(Grasp(point=point, radius=5e-3))
    both = reference.held & reference.truth().attached
    before = reference.truth_frame().positions
    reference.step(Move(to=point + np.array([0.0, 0.0, 0.01])))
    assert both.any()
    assert np.abs((reference.truth_frame().positions - before)[both, 2] - 0.01).max() < 1e-3


def test_a_weld_stays_where_it_is_while_a_corner_is_lifted():
    weld = dataclasses.replace(MIDDLE, stiffness=math.inf)
    reference = particles(dataclasses.replace(SCENE, attachments=(weld,)))
    rest = reference.truth().rest
    reference.step(Grasp(point=CORNER, radius=8e-3))
    reference.step(Move(to=CORNER + np.array([0.0, 0.0, 0.02])))
    attached = reference.truth().attached
    moved = np.linalg.norm(reference.simulation.data.flexvert_xpos - rest + [0, 0, TISSUE.radius], axis=1)
    # Measured 0.30 mm where the pull is strongest: the constraint is stiff, not rigid.
    assert moved[attached].max() < 5e-4
    assert np.isinf(reference.truth_frame().stiffness[attached]).all()


def lifted_load(stiffness: float) -> np.ndarray:
    """Return the attachment loads once a corner is 20 mm up [N]."""
    reference = particles(dataclasses.replace(SCENE, attachments=(dataclasses.replace(MIDDLE, stiffness=stiffness),)))
    reference.step(Grasp(point=CORNER, radius=8e-3))
    reference.step(Move(to=CORNER + np.array([0.0, 0.0, 0.02])))
    frame = reference.truth_frame()
    assert frame.load is not None and (frame.load[~reference.truth().attached] == 0).all()
    return frame.load[reference.truth().attached]


def test_a_springs_load_is_its_elongation_times_k_and_a_welds_that_of_a_stiff_spring():
    """Within 10 %: 300 N/m stretch by 0.3 mm under the largest load, about as much as the weld."""
    reference = particles()
    reference.step(Grasp(point=CORNER, radius=8e-3))
    reference.step(Move(to=CORNER + np.array([0.0, 0.0, 0.02])))
    frame, joints = reference.truth_frame(), reference.simulation.tissue.qpos_address
    stretched = np.linalg.norm(reference.simulation.data.qpos[joints], axis=1)
    np.testing.assert_allclose(frame.load, frame.stiffness * stretched, atol=1e-12)
    weld, spring = lifted_load(math.inf), lifted_load(300.0)
    assert weld.max() == pytest.approx(spring.max(), rel=0.1)
    assert weld.sum() == pytest.approx(spring.sum(), rel=0.1)


def test_welded_vertices_slip_out_of_the_jaws_and_a_grasp_of_nothing_else_is_refused():
    weld = dataclasses.replace(MIDDLE, stiffness=math.inf)
    scene = dataclasses.replace(SCENE, attachments=(weld,))
    point = np.array([0.0, 0.0, 4e-4])
    with pytest.raises(ActionError, match="meets welded vertices only"):
        particles(scene).step(Grasp(point=point, radius=5e-3))
    reference = particles(scene)
    reference.step(Grasp(point=point, radius=0.018))
    assert reference.held.any() and not (reference.held & reference.truth().attached).any()


def test_release_lets_the_sheet_return_and_another_corner_can_be_grasped():
    reference = particles()
    rest = reference.truth().rest
    for action in programme(SCENE):
        reference.step(action)
        if isinstance(action, Release):
            # Friction of 0.3 keeps the sheet from returning completely; measured 0.17 mm.
            assert np.linalg.norm(reference.truth_frame().positions - rest, axis=1).max() < 5e-4
            assert not reference.held.any()
    assert reference.truth().frames[-1].index == 2 + 4 * (1 + 2 + 1 + 1) - 1
    assert reference.capped == []


def test_the_bed_is_not_penetrated():
    """At the highest lift the sheet sinks by less than its radius, so the bed is never drawn above it."""
    reference = particles()
    for action in programme(SCENE):
        reference.step(action)
        assert reference.simulation.data.flexvert_xpos[:, 2].min() > 0


def test_the_same_seed_gives_the_same_bytes_and_another_seed_does_not():
    def episode(seed: int) -> bytes:
        reference = particles(seed=seed)
        observations = [reference.step(action) for action in list(programme(SCENE))[:5]]
        return b"".join(o.points.positions.tobytes() + o.tool.position.tobytes() for o in observations)

    assert episode(3) == episode(3)
    assert episode(3) != episode(4)


@pytest.mark.parametrize("sensing", ["particles", "points"])
def test_measured_points_keep_their_ids_and_have_the_declared_noise(sensing):
    """In still frames the sample standard deviation of a track is sd."""
    reference = Reference(SCENE, seed=0, sensing=sensing)
    measured = [reference.step(Wait()).points for _ in range(8)]
    positions = np.array([points.positions for points in measured])
    spread = np.sqrt((positions.var(axis=0, ddof=1)).mean())
    # 8 frames of over 100 points of 3 coordinates have a relative standard error below 2 %; 8 % is 4 of them.
    assert spread == pytest.approx(measured[0].sd, rel=0.08)
    assert measured[0].sd == SCENE.sensing.point_sd
    assert all(np.array_equal(points.track_id, measured[0].track_id) for points in measured)
    assert reference.camera is None


def test_a_cloud_shows_other_points_of_the_surface_in_each_frame():
    """Within 6 sd of the flat surface, over its extent up to 2 mm, and 5 mm from the points of the frame before."""
    reference = Reference(SCENE, seed=0, sensing="cloud")
    clouds = [reference.step(Wait()).points for _ in range(2)]
    surface = reference.truth_frame().positions
    for cloud in clouds:
        assert cloud.track_id is None and len(cloud.positions) == SCENE.sensing.cloud_points
        assert np.abs(cloud.positions[:, 2] - surface[:, 2].mean()).max() < 6 * cloud.sd
        np.testing.assert_allclose(np.ptp(cloud.positions, axis=0)[:2], np.ptp(surface, axis=0)[:2], atol=2e-3)
    assert np.linalg.norm(clouds[0].positions - clouds[1].positions, axis=1).mean() > 5e-3


def test_particles_are_the_vertices_in_another_order():
    """Each vertex once; a random order leaves one in place on average, so 0.9 of them move."""
    reference = particles()
    observation, frame = reference.step(Wait()), reference.truth_frame()
    distance = np.linalg.norm(observation.points.positions[:, None] - frame.positions, axis=2)
    nearest = distance.argmin(axis=1)
    assert sorted(nearest) == list(range(len(frame.positions)))
    assert (nearest != np.arange(len(nearest))).mean() > 0.9


def test_observations_are_numbered_and_timed_from_zero():
    reference = particles()
    observations = [reference.step(action) for action in list(programme(SCENE))[:4]]
    assert [o.index for o in observations] == [0, 1, 2, 3]
    assert observations[0].time >= 0
    assert all(later.time > earlier.time for earlier, later in itertools.pairwise(observations))
    assert [(o.tool.closed, o.tool.grasp) for o in observations] == [(False, 0), (False, 0), (True, 1), (True, 1)]


def test_the_truths_details_are_json_even_with_welds():
    weld = dataclasses.replace(MIDDLE, stiffness=math.inf)
    reference = particles(dataclasses.replace(SCENE, attachments=(weld,)))
    reference.step(Wait())
    text = json.dumps(reference.truth().details, allow_nan=False)
    assert '"weld"' in text


def test_a_grasp_off_the_tissue_is_refused_and_says_how_far_off():
    with pytest.raises(ActionError, match=r"holds nothing: the nearest tissue is 2[0-9]\.[0-9] mm away"):
        particles().step(Grasp(point=np.array([0.05, 0.0, 0.0]), radius=5e-3))


def test_a_second_grasp_and_an_idle_release_are_refused():
    reference = particles()
    with pytest.raises(ActionError, match="nothing is held"):
        reference.step(Release())
    reference.step(Grasp(point=CORNER, radius=8e-3))
    with pytest.raises(ActionError, match="grasp 1 holds"):
        reference.step(Grasp(point=-CORNER, radius=8e-3))


@pytest.mark.parametrize(
    "action",
    [
        Move(to=np.array([-25.0, -25.0, 20.0])),
        Move(to=np.array([0.0, 0.0, -0.01])),
        Grasp(point=CORNER, radius=6.0),
    ],
)
def test_actions_with_impossible_numbers_are_refused(action):
    with pytest.raises(ActionError, match="must be"):
        particles().step(action)


def test_a_tip_sent_a_little_below_the_bed_stops_on_it():
    below = CORNER * (1, 1, -1)
    reference = particles()
    grasped = reference.step(Grasp(point=below, radius=8e-3)).tool
    reference.step(Move(to=CORNER + np.array([0.0, 0.0, 0.01])))
    lowered = reference.step(Move(to=below)).tool
    for tool in (grasped, lowered):
        np.testing.assert_allclose(tool.position, [*below[:2], 0.0], atol=1e-12)


@pytest.mark.parametrize("action", ["grasp", Wait, None])
def test_anything_but_an_action_is_refused(action):
    with pytest.raises(ActionError, match="step takes a Grasp, Move, Release, Wait, Cut or Suture; got"):
        inspect.unwrap(Reference.step)(particles(), action)


def test_an_unstable_state_is_dumped_and_named(tmp_path):
    reference = Reference(SCENE, seed=0, sensing="particles", dump_dir=tmp_path)
    reference.simulation.data.qpos[7] = np.nan
    with pytest.raises(SimulationError, match=r"unstable_state\.npz"):
        reference.step(Wait())
    assert np.isnan(np.load(tmp_path / "unstable_state.npz")["qpos"][7])


def test_a_sheet_that_explodes_before_it_first_rests_is_dumped_too(tmp_path):
    scene = dataclasses.replace(SCENE, disturbances=(Explosion(),))
    with pytest.raises(SimulationError, match=rf"became unstable at t = 0\.\d\d s .*{tmp_path}"):
        Reference(scene, seed=0, sensing="particles", dump_dir=tmp_path)
    assert np.abs(np.load(tmp_path / "unstable_state.npz")["qvel"]).max() > simulation.MAX_SPEED


def test_mujocos_warnings_are_counted_and_write_no_file(tmp_path, tmp_path_factory, monkeypatch):
    dumps = tmp_path_factory.mktemp("dumps")
    monkeypatch.chdir(tmp_path)
    before = sum(simulation.warnings.values())
    reference = Reference(SCENE, seed=0, sensing="particles", dump_dir=dumps)
    reference.simulation.data.qpos[0] = np.nan
    with pytest.raises(SimulationError):
        reference.step(Wait())
    assert list(tmp_path.iterdir()) == []
    assert sum(simulation.warnings.values()) > before


def test_the_tweezer_touches_nothing_and_its_jaws_close():
    """Holding is done by constraints: no contact involves a tool geom, and the jaw joints near their set angle."""
    reference = particles()
    model, data = reference.simulation.tissue.model, reference.simulation.data
    tool = {i for i in range(model.ngeom) if model.geom(i).name.startswith("tweezer/")}
    open_angles = [data.qpos[model.jnt_qposadr[j]] for j in reference.simulation.tissue.jaws]
    reference.step(Grasp(point=CORNER, radius=8e-3))
    reference.step(Move(to=CORNER + np.array([0.0, 0.0, 0.01])))
    closed_angles = [data.qpos[model.jnt_qposadr[j]] for j in reference.simulation.tissue.jaws]
    assert tool and not tool & set(data.contact.geom.ravel().tolist())
    assert min(open_angles) > 0.8 * OPEN_ANGLE and max(np.abs(closed_angles)) < 0.08 * OPEN_ANGLE


def test_a_seed_below_zero_is_refused():
    with pytest.raises(OptionError, match="seed = -1: must be an integer of at least 0"):
        Reference(Scene(name="small", tissue=TISSUE), seed=-1, sensing="particles")
