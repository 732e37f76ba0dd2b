"""Attachments: the law of each against its closed form, and attachments that are cut and sewn."""

import dataclasses
import math
from typing import cast

import numpy as np
import pytest

from jiggle_mj.actions import Cut, Grasp, Move, Release, Suture, Wait
from jiggle_mj.episode import observe
from jiggle_mj.errors import ActionError
from jiggle_mj.recording.reader import Recording
from jiggle_mj.recording.truth import read_truth
from jiggle_mj.scenes import Reference
from jiggle_mj.scenes.scene.attachments import Attachment, Disc, Segment
from jiggle_mj.scenes.scene.scene import BedConfig, ProcedureConfig, Scene, TissueConfig
from jiggle_mj.scenes.tissue.mesh import build_sheet

TISSUE = TissueConfig(size=(0.06, 0.06), spacing=8e-3)
LIGHT = Scene(name="hanging", tissue=TISSUE, bed=BedConfig(present=False))
STRIP = Segment(start=(-0.02, 0.0), end=(0.02, 0.0), width=0.01, stiffness=2.0)
LYING = Scene(name="lying", tissue=TISSUE, attachments=(STRIP,))
AT_REST = 2e-3
"""Relative error of an equilibrium after three waits, since rest means a small speed and not 0."""
WEIGHT = TISSUE.density * TISSUE.thickness * np.prod(TISSUE.size) * 9.81


def held_everywhere(**law) -> Scene:
    """Return a scene without a bed whose every vertex is held by the same attachment."""
    return dataclasses.replace(LIGHT, attachments=(Disc(centre=(0.0, 0.0), radius=0.1, **law),))


def hanging(n_waits: int = 3, **law) -> tuple[float, Reference]:
    """Return the mean drop of the sheet below its rest position [m], and the experiment."""
    reference = Reference(held_everywhere(**law), seed=0, sensing="particles")
    for _ in range(n_waits):
        reference.step(Wait())
    simulation = reference.simulation
    return -float(simulation.anchors.displacement[:, 2].mean()), reference


def mean_weight() -> float:
    """Return the weight over the number of springs [N]."""
    return float(WEIGHT / len(build_sheet(size=TISSUE.size, spacing=TISSUE.spacing, kind=TISSUE.mesh, seed=0).vertices))


def test_a_slack_spring_hangs_by_its_slack_lower():
    taut, loose = hanging(stiffness=0.2)[0], hanging(stiffness=0.2, slack=3e-3)[0]
    assert taut == pytest.approx(mean_weight() / 0.2, rel=1e-3)
    assert loose - taut == pytest.approx(3e-3, rel=AT_REST)


def test_an_offset_of_the_anchors_moves_the_sheet():
    """By the offset, within 2 um, a thousandth of it."""
    rest = hanging(stiffness=0.2)[1].truth_frame().positions
    moved = hanging(stiffness=0.2, offset=(2e-3, -1e-3, 0.5e-3))[1].truth_frame().positions
    np.testing.assert_allclose(moved - rest, np.broadcast_to([2e-3, -1e-3, 0.5e-3], rest.shape), atol=2e-6)


def test_a_hardening_spring_stretches_less():
    """The forces k e (1 + c e^2) of all springs sum to the weight, and the drop is smaller by over 5 %."""
    drop, reference = hanging(stiffness=0.2, hardening=4e4)
    moved = -reference.simulation.anchors.displacement[:, 2]
    total = (0.2 * moved * (1 + 4e4 * moved**2)).sum()
    assert total == pytest.approx(WEIGHT, rel=AT_REST)
    assert drop < 0.95 * hanging(stiffness=0.2)[0]
    np.testing.assert_allclose(reference.truth_frame().load.sum(), total, rtol=1e-3)


def test_a_creeping_anchor_follows_at_its_rate():
    """Under a constant load the elongation is constant and the anchor sinks by creep times elongation per second.

    Within 2 %: a step of 20 ms takes 1 - exp(-0.01) of the elongation, 0.5 % less, and the sheet still settles.
    """
    _, reference = hanging(stiffness=0.2, creep=0.5)
    simulation = reference.simulation
    before, began = simulation.anchors.attachments.anchor[:, 2].mean(), simulation.data.time
    for _ in range(50):
        simulation.step()
    sunk = before - simulation.anchors.attachments.anchor[:, 2].mean()
    assert sunk == pytest.approx(0.5 * mean_weight() / 0.2 * (simulation.data.time - began), rel=0.02)


def test_a_yielding_anchor_is_never_stretched_further():
    _, reference = hanging(stiffness=0.2, yields_at=1e-3, n_waits=1)
    anchors = reference.simulation.anchors
    stretch = np.linalg.norm(anchors.displacement - anchors.attachments.anchor, axis=1)
    assert anchors.attachments.anchor[:, 2].mean() < -1e-3
    assert stretch.max() <= 1e-3 + 1e-9  # rounding


@pytest.mark.parametrize("stiffness", [5.0, math.inf])
def test_attachments_break_at_their_force_and_not_before(stiffness):
    """Some break, and the load of those that remain is below the limit."""
    strip = dataclasses.replace(STRIP, stiffness=stiffness)
    limit = 0.8 * lifted(dataclasses.replace(LYING, attachments=(strip,))).truth_frame().load.max()
    weak = dataclasses.replace(strip, breaks_at=limit)
    reference = lifted(dataclasses.replace(LYING, attachments=(weak,)))
    frame, held = reference.truth_frame(), reference.truth().attached
    assert 0 < (frame.stiffness[held] == 0).sum() < held.sum()
    assert frame.load.max() <= limit
    assert not frame.load[frame.stiffness == 0].any()


def lifted(scene: Scene) -> Reference:
    reference = Reference(scene, seed=0, sensing="particles")
    corner = np.array([-0.028, -0.028, 4e-4])
    reference.step(Grasp(point=corner, radius=9e-3))
    for height in (0.01, 0.02, 0.03):
        reference.step(Move(to=corner + np.array([0.0, 0.0, height])))
    return reference


def test_springs_and_welds_mix_in_one_scene():
    parts: tuple[Attachment, ...] = tuple(
        Disc(centre=(x, 0.0), radius=6e-3, stiffness=k) for x, k in ((-0.02, 3.0), (0.02, math.inf))
    )
    frame = lifted(dataclasses.replace(LYING, attachments=parts)).truth_frame()
    assert set(frame.stiffness) == {0.0, 3.0, math.inf}
    assert frame.load[frame.stiffness > 0].min() > 0


def test_a_cut_frees_its_region_and_nothing_else():
    reference = lifted(LYING)
    before = reference.truth_frame()
    reference.step(Cut(path=np.array([[-0.03, 0.0], [-0.005, 0.0]]), width=0.012))
    after = reference.truth_frame()
    left = reference.truth().rest[:, 0] < -0.004
    assert not after.stiffness[left].any()
    np.testing.assert_array_equal(after.stiffness[~left], before.stiffness[~left])
    rise = after.positions[left & (before.stiffness > 0), 2] - before.positions[left & (before.stiffness > 0), 2]
    assert rise.min() > 1e-3  # freed vertices follow a corner that is 30 mm up


def test_a_cut_opens_welds():
    welded = dataclasses.replace(LYING, attachments=(dataclasses.replace(STRIP, stiffness=math.inf),))
    reference = lifted(welded)
    reference.step(Cut(path=np.array([[0.0, 0.0]]), width=0.1))
    assert not reference.truth_frame().stiffness.any() and not reference.truth_frame().load.any()


def test_a_suture_pulls_beyond_its_slack_from_its_offset():
    """Its load is its stiffness times the distance from its anchor beyond the slack, up to rounding."""
    settings = ProcedureConfig(suture_slack=2e-3, suture_offset=(1e-3, 0.0, -1e-3))
    reference = Reference(dataclasses.replace(LYING, procedure=settings), seed=0, sensing="particles")
    reference.step(Suture(path=np.array([[-0.025, -0.025]]), width=0.02, stiffness=4.0))
    corner = np.array([-0.028, -0.028, 4e-4])
    reference.step(Grasp(point=corner + np.array([0.05, 0.0, 0.0]), radius=9e-3))
    reference.step(Move(to=corner + np.array([0.05, 0.0, 0.025])))
    sewn = np.linalg.norm(reference.simulation.tissue.sheet.vertices - [-0.025, -0.025], axis=1) <= 0.01
    frame, moved = reference.truth_frame(), reference.simulation.anchors.displacement
    stretch = np.linalg.norm(moved - [1e-3, 0.0, -1e-3], axis=1)
    assert sewn.sum() > 2 and (frame.stiffness[sewn] == 4.0).all()
    np.testing.assert_allclose(frame.load[sewn], 4.0 * np.maximum(stretch[sewn] - 2e-3, 0), atol=1e-9)


def test_sewing_over_an_attachment_adds_up_and_cutting_takes_both():
    reference = Reference(LYING, seed=0, sensing="particles")
    reference.step(Suture(path=np.array([[0.0, 0.0]]), width=0.012, stiffness=4.0))
    assert reference.truth_frame().stiffness.max() == 6.0
    reference.step(Cut(path=np.array([[0.0, 0.0]]), width=0.1))
    assert not reference.truth_frame().stiffness.any()


def test_a_failure_is_known_to_the_truth_alone(tmp_path):
    """The observation states the intended cut, whether or not it succeeded."""
    scene = dataclasses.replace(LYING, procedure=ProcedureConfig(cut_fails=0.5))
    cut = Cut(path=np.array([[-0.02, 0.0], [0.02, 0.0]]), width=0.012)
    outcomes = set()
    for seed in range(6):
        path = tmp_path / f"{seed}.mcap"
        with Reference(scene, seed=seed, sensing="particles") as reference:
            seen = list(observe(reference, [Wait(), cut, Wait()], path, seed=seed))
        truth = read_truth(path.with_suffix(".truth.mcap"))
        (event,) = cast("list[dict]", truth.details["events"])
        free = not truth.frames[-1].stiffness.any()
        assert event["succeeded"] == free and event["index"] == 1 and event["n_attached"] == truth.attached.sum()
        assert [observation.events for observation in seen] == [(), (cut,), ()]
        (read,) = [observation.events for observation in Recording.open(path) if observation.events]
        np.testing.assert_array_equal(read[0].path, cut.path)
        assert read[0].width == cut.width and type(read[0]) is Cut
        outcomes.add(free)
    assert outcomes == {True, False}


def test_failures_do_not_change_the_noise():
    """Whether a cut succeeds or fails, the same seed gives the same measurement noise, up to rounding."""
    noise = []
    for fails in (0.0, 1.0):
        reference = Reference(
            dataclasses.replace(LYING, procedure=ProcedureConfig(cut_fails=fails)), seed=0, sensing="particles"
        )
        observed = reference.step(Cut(path=np.array([[0.0, 0.0]]), width=0.1))
        assert observed.points is not None
        assert reference.observer.tracks is not None
        order = reference.observer.tracks.corners[:, 0]
        noise.append(observed.points.positions - reference.truth_frame().positions[order])
    np.testing.assert_allclose(*noise, atol=1e-12)


def test_a_suture_comes_back_from_a_recording(tmp_path):
    suture = Suture(path=np.array([[0.0, 0.02]]), width=0.01, stiffness=3.0)
    with Reference(LYING, seed=0, sensing="particles") as reference:
        list(observe(reference, [Wait(), suture], tmp_path / "run.mcap", seed=0))
    (read,) = list(Recording.open(tmp_path / "run.mcap"))[1].events
    assert isinstance(read, Suture) and (read.width, read.stiffness) == (0.01, 3.0)


def test_regrasping_elsewhere_works_after_a_release():
    reference = lifted(LYING)
    reference.step(Release())
    assert not reference.held.any()
    reference.step(Grasp(point=np.array([0.028, 0.028, 4e-4]), radius=9e-3))
    assert reference.held.any()


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (Cut(path=np.array([[0.1, 0.1]]), width=0.01), r"cut from .* meets no tissue: .* mm away"),
        (Suture(path=np.array([[0.1, 0.0]]), width=0.01, stiffness=1.0), "suture from .* meets no tissue"),
    ],
)
def test_impossible_cuts_and_sutures_are_refused(action, message):
    with pytest.raises(ActionError, match=message):
        Reference(LYING, seed=0, sensing="particles").step(action)
