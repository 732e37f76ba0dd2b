"""The estimator as its users see it: what it waits for, skips and refuses, and that it repeats itself to the byte."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jiggle_mj.errors import MeshError, PerceptionError, RecordingError
from jiggle_mj.estimator import Estimator, EstimatorConfig
from jiggle_mj.estimator.belief.gaussian_belief import GaussianBelief
from jiggle_mj.estimator.filters.nnls import NonNegativeLeastSquares
from jiggle_mj.estimator.filters.posterior_summary import Convergence, PosteriorSummary
from jiggle_mj.estimator.perception import Track
from jiggle_mj.observation import DeclaredMesh, MeasuredPoints, Observation, StereoPair, ToolState
from tests.support.perception_plane import camera
from tests.support.small_sheet import DECLARATION, GRIP_RADIUS, SPACING, attached, cloud, lifts, sheet

NOISE = 5e-5
CONFIG = EstimatorConfig(force_sd=5e-4)
"""A small force error, as the data come from the estimator's own model."""


def observe(index: int, x: np.ndarray, tip: np.ndarray, grasp: int, *, closed: bool = True) -> Observation:
    """Return an observation of noisy tracked positions of all particles."""
    noisy = x + NOISE * np.random.default_rng(index).normal(size=x.shape)
    return Observation(
        index=index,
        time=index * 100_000_000,
        tool=ToolState(
            position=tip, quat_wxyz=np.array([1.0, 0, 0, 0]), closed=closed, grasp=grasp, radius=GRIP_RADIUS
        ),
        points=MeasuredPoints(positions=noisy, track_id=np.arange(len(x)), sd=NOISE),
    )


def still() -> list[Observation]:
    return [observe(i, sheet().rest, np.array([0.0, 0.0, 0.05]), 0, closed=False) for i in range(2)]


def episode() -> list[Observation]:
    """Return two frames at rest, then the four closings and twelve lifts."""
    return [*still(), *(observe(2 + i, lift.x, lift.tip, lift.grasp) for i, lift in enumerate(lifts()))]


def with_points(observation: Observation, **changes) -> Observation:
    return dataclasses.replace(observation, points=dataclasses.replace(observation.points, **changes))


@pytest.fixture(scope="module")
def run():
    """Return an estimator that has seen the whole episode, and its estimates."""
    estimator = Estimator(DECLARATION, config=CONFIG)
    return estimator, [estimator.update(one) for one in episode()]


def test_attachments_are_found_from_tracked_points(run):
    """The estimator triangulates the points anew, in the points' order; one particle in 81 may be wrong."""
    estimator, _ = run
    assert np.sum(estimator.detection.attached != attached()) <= 1


def test_frames_before_the_first_grasp_give_no_estimate_and_those_with_closed_jaws_do(run):
    _, estimates = run
    assert estimates[:2] == [None, None]
    assert [one.index for one in estimates[2:]] == list(range(2, 18))


def test_the_belief_sharpens_and_starts_from_the_prior(run):
    estimator, estimates = run
    entropies = [estimator.prior_entropy, *(one.entropy for one in estimates[2:])]
    assert entropies[-1] < entropies[0] - 100
    after = np.array([entropies[1:][last] for last in np.flatnonzero(np.diff([*(lift.grasp for lift in lifts()), 0]))])
    assert (np.diff([entropies[0], *after]) < 0).all()
    assert estimator.belief.covariance.shape == (sheet().n, sheet().n)


def test_open_jaws_between_grasps_give_no_estimate(run):
    estimator = Estimator(DECLARATION)
    frames = episode()
    for one in frames[:3]:
        estimator.update(one)
    assert estimator.update(observe(3, sheet().rest, frames[2].tool.position, 1, closed=False)) is None
    assert estimator.skipped == []


@pytest.mark.bits
def test_the_same_input_gives_the_same_bytes():
    def estimates() -> list:
        estimator = Estimator(DECLARATION)
        return [estimator.update(one) for one in episode()[:5]][2:]

    for one, other in zip(estimates(), estimates(), strict=True):
        for name in ("positions", "mean", "sd"):
            assert getattr(one, name).tobytes() == getattr(other, name).tobytes()
        assert (one.entropy, one.nis) == (other.entropy, other.nis)


def test_a_frame_in_which_every_particle_is_hidden_is_skipped_and_named():
    frames = episode()
    hidden = with_points(frames[3], positions=np.full((sheet().n, 3), np.nan))
    estimator = Estimator(DECLARATION)
    for one in frames[:3]:
        estimator.update(one)
    before = estimator.belief
    assert estimator.update(hidden) is None
    assert estimator.skipped == [(3, "no particle was seen")]
    np.testing.assert_array_equal(estimator.belief.covariance, before.covariance)
    assert estimator.update(frames[4]) is not None


def test_nan_points_are_unseen_particles():
    """The other particles locate the hidden ones within 2 mm, where the frame before would be wrong by 5 mm."""
    frames = episode()
    positions = frames[4].points.positions.copy()
    hidden = np.zeros(sheet().n, bool)
    hidden[[11, 12, 30, 55]] = True
    positions[hidden] = np.nan
    estimator = Estimator(DECLARATION)
    for one in frames[:4]:
        estimator.update(one)
    found = estimator.update(with_points(frames[4], positions=positions))
    np.testing.assert_array_equal(np.isnan(found.observed).any(axis=1), hidden)
    assert np.isfinite(found.positions).all()
    assert np.linalg.norm(found.positions - lifts()[2].x, axis=1)[hidden].max() < 2e-3
    assert np.linalg.norm(lifts()[1].x - lifts()[2].x, axis=1)[hidden].max() > 2e-3


@pytest.mark.slow
def test_clouds_without_identities_are_followed_by_a_mesh_of_the_estimators_own():
    """The mesh stays within 0.5 mm (rms) of the surface without noise: ten times the noise of a point."""
    estimator, states = Estimator(DECLARATION, config=EstimatorConfig(spacing=SPACING)), [sheet().rest] * 2
    states += [lift.x for lift in lifts()]
    found = [
        estimator.update(with_points(one, track_id=None, positions=cloud(states[i], i, NOISE)))
        for i, one in enumerate(episode()[:6])
    ][-1]
    assert np.nanmax(np.linalg.norm(found.observed - estimator.sheet.rest, axis=1)) > 0.01
    surface = trimesh.Trimesh(states[5], sheet().faces, process=False)
    seen = found.observed[np.isfinite(found.observed).all(axis=1)]
    distance = trimesh.proximity.closest_point_naive(surface, seen)[1]
    assert len(estimator.sheet.rest) != sheet().n and np.sqrt(np.mean(distance**2)) < 5e-4


def test_two_sheets_of_points_are_refused():
    gap = np.where(sheet().rest[:, :1] > 0, 0.03, 0.0) * np.array([1.0, 0, 0])
    estimator = Estimator(DECLARATION)
    with pytest.raises(MeshError, match="2 disconnected sheets"):
        for one in episode()[:3]:
            estimator.update(with_points(one, positions=one.points.positions + gap))


def test_too_few_points_are_refused():
    estimator = Estimator(DECLARATION)
    with pytest.raises(
        PerceptionError, match="10 points are seen in at least 50% of the 2 frames at rest; a sheet needs 20"
    ):
        for one in episode()[:3]:
            points = MeasuredPoints(positions=one.points.positions[:10], track_id=np.arange(10), sd=NOISE)
            estimator.update(dataclasses.replace(one, points=points))


def test_points_that_are_missing_in_some_frames_are_particles():
    """Each of ten still frames misses another 8 of 81 points; none of them misses one point in more than half."""
    estimator = Estimator(DECLARATION)
    for index in range(10):
        missing = still()[0].points.positions.copy()
        missing[(8 * index + np.arange(8)) % sheet().n] = np.nan
        estimator.update(dataclasses.replace(with_points(still()[0], positions=missing), index=index))
    estimator.update(dataclasses.replace(episode()[2], index=10))
    assert len(estimator.sheet.rest) == sheet().n


def test_a_grasp_whose_first_frame_is_lost_still_knows_where_the_jaws_closed():
    """Nothing is seen of the closing; the hidden corner, 5 mm up in the next frame, is believed nearer there."""
    frames = episode()
    lost = with_points(frames[2], positions=np.full((sheet().n, 3), np.nan))
    held = lifts()[1].held
    blind = frames[3].points.positions.copy()
    blind[held] = np.nan
    estimator = Estimator(DECLARATION)
    for one in (*frames[:2], lost):
        estimator.update(one)
    found = estimator.update(with_points(frames[3], positions=blind))
    np.testing.assert_array_equal(found.held, held)
    error, lifted = (np.linalg.norm((x - lifts()[1].x)[held], axis=1).mean() for x in (found.positions, sheet().rest))
    assert error < lifted / 2


def test_a_later_grasp_off_the_tissue_is_skipped_by_name_and_keeps_what_was_learned():
    estimator = Estimator(DECLARATION)
    for one in episode()[:4]:
        estimator.update(one)
    estimator.release()
    before = estimator.belief
    assert estimator.update(observe(4, sheet().rest, np.array([0.2, 0.0, 0.0]), 2)) is None
    ((index, why),) = estimator.skipped
    assert index == 4 and "grasp 2 is off the tissue" in why
    np.testing.assert_array_equal(estimator.belief.covariance, before.covariance)
    assert estimator.update(episode()[6]) is not None


@pytest.mark.slow
def test_the_papers_edge_springs_find_the_attachments_too(run):
    """The data come from triangles, so some are missed; none further than a ring is reported."""
    estimator = Estimator(DECLARATION, config=dataclasses.replace(CONFIG, membrane="edges"))
    for one in episode():
        estimator.update(one)
    assert estimator.detection.attached[attached()].mean() >= 0.5
    near = np.linalg.norm(sheet().rest, axis=1) < 11e-3 + 1.5 * SPACING
    assert not estimator.detection.attached[~near].any()


@pytest.mark.parametrize("when", [0, 3])
def test_an_observation_with_nothing_to_see_is_refused_or_skipped_by_its_index(when):
    """Refused at the start, where something is wrong with all of them."""
    estimator = Estimator(DECLARATION)
    frames = episode()
    for one in frames[:when]:
        estimator.update(one)
    why = f"observation {when} has neither points nor images"
    if when == 0:
        with pytest.raises(PerceptionError, match=why):
            estimator.update(dataclasses.replace(frames[when], points=None))
    else:
        assert estimator.update(dataclasses.replace(frames[when], points=None)) is None
        assert why in estimator.skipped[0][1]


def test_images_without_a_calibrated_camera_are_refused():
    black = np.zeros((48, 64, 3), np.uint8)
    pictured = dataclasses.replace(still()[0], points=None, images=StereoPair(left=black, right=black))
    with pytest.raises(PerceptionError, match="observation 0 has neither points nor images with a calibrated camera"):
        Estimator(DECLARATION).update(pictured)


def test_black_images_are_skipped_by_name_until_the_jaws_close_and_refused_then():
    black = np.zeros((300, 400, 3), np.uint8)
    first, _, closed = (
        dataclasses.replace(one, points=None, images=StereoPair(left=black, right=black)) for one in episode()[:3]
    )
    estimator = Estimator(DECLARATION, camera())
    assert estimator.update(first) is None
    ((index, why),) = estimator.skipped
    assert index == 0 and "black" in why
    with pytest.raises(PerceptionError, match="black"):
        estimator.update(closed)


def test_images_of_two_sizes_are_refused():
    with pytest.raises(RecordingError, match=r"differ in size: left \(48, 64, 3\), right \(48, 63, 3\)"):
        StereoPair(left=np.zeros((48, 64, 3), np.uint8), right=np.zeros((48, 63, 3), np.uint8))


def test_a_grasp_off_the_tissue_says_how_far_off():
    estimator = Estimator(DECLARATION)
    for one in still():
        estimator.update(one)
    with pytest.raises(PerceptionError, match=r"grasp 1 is off the tissue: .* mm from the nearest particle"):
        estimator.update(observe(2, sheet().rest, np.array([0.2, 0.0, 0.0]), 1))


def test_asking_for_the_sheet_before_the_first_grasp_is_refused():
    estimator = Estimator(DECLARATION)
    estimator.update(still()[0])
    with pytest.raises(ValueError, match="not known before the first frame with closed jaws"):
        _ = estimator.sheet


@pytest.mark.parametrize("change", [{"spacing": 0.0}, {"prior_sd": -1.0}, {"force_sd": float("nan")}])
def test_settings_out_of_range_are_refused(change):
    ((name, _),) = change.items()
    with pytest.raises(ValueError, match=rf"EstimatorConfig\.{name} must be above 0"):
        EstimatorConfig(**change)


@pytest.mark.parametrize("change", [{"grip_stiffness": 1e8}, {"reference": 1e-8}])
def test_settings_that_float32_cannot_add_to_the_membranes_stiffness_are_refused(change):
    ((name, _),) = change.items()
    with pytest.raises(ValueError, match=rf"EstimatorConfig\.{name} is a share .* between 1e-07 and 1e\+07"):
        EstimatorConfig(**change)


def folded() -> DeclaredMesh:
    """Return the sheet with its right part folded over onto its left, 1 mm above it."""
    rest = sheet().rest.copy()
    right = rest[:, 0] > 5e-3
    rest[right] = np.column_stack([1e-2 - rest[right, 0], rest[right, 1], np.full(right.sum(), 1e-3)])
    return DeclaredMesh(vertices=rest, faces=sheet().faces, track_id=np.arange(sheet().n))


def test_a_sheet_that_is_folded_at_rest_is_refused_with_what_to_do():
    declared = folded()
    estimator = Estimator(dataclasses.replace(DECLARATION, mesh=declared))
    tip = sheet().rest[0] + 1e-3
    for index, closed in enumerate((False, False, True)):
        one = observe(index, declared.vertices, tip, int(closed), closed=closed)
        if closed:
            with pytest.raises(MeshError, match=r"folded: .* triangles are turned over .* Spread the tissue"):
                estimator.update(one)
        else:
            assert estimator.update(one) is None


def test_a_covariance_that_is_not_positive_definite_is_refused_by_the_particles_number():
    covariance = np.tile(1e-8 * np.eye(3), (4, 1, 1))
    covariance[2, 0, 0] = -1e-8
    with pytest.raises(PerceptionError, match="covariance of particle 2 is not positive definite"):
        Track(positions=np.zeros((4, 3)), covariance=covariance, visible=np.ones(4, bool))


def test_an_update_of_no_sample_is_refused():
    with pytest.raises(ValueError, match=r"EstimatorConfig\.samples = 0: must be an integer of at least 1"):
        EstimatorConfig(samples=0)


def test_the_papers_filter_runs_in_the_same_estimator():
    """Six frames with two samples each lower the entropy; the table of filters compares their detections."""
    estimator = Estimator(DECLARATION, config=dataclasses.replace(CONFIG, filter="explicit", samples=2))
    estimates = [estimator.update(one) for one in episode()[:6]][2:]
    entropies = [estimator.prior_entropy, *(one.entropy for one in estimates)]
    assert (np.diff(entropies) < 0).all()
    assert all((one.mean >= 0).all() and np.isfinite(one.positions).all() for one in estimates)


def test_a_belief_that_is_no_number_when_the_jaws_open_is_refused_and_the_last_one_stays(monkeypatch):
    """The frame in which they open is skipped with the reason; a filter that cannot identify the sheet refuses."""
    estimator = Estimator(DECLARATION, config=dataclasses.replace(CONFIG, filter="nnls"))
    frames = episode()
    for one in frames[:4]:
        estimator.update(one)
    before, none = estimator.detection, jnp.full(sheet().n, jnp.nan)
    spoilt = PosteriorSummary(
        belief=GaussianBelief.prior(sheet().n, mean=0.0, sd=1.0),
        b=none,
        sd=none,
        probability=none,
        entropy=none[0],
        convergence=Convergence.CONVERGED.code,
    )
    monkeypatch.setattr(NonNegativeLeastSquares, "release", lambda self, state, thorough: (state, spoilt))
    with pytest.raises(PerceptionError, match="leave no finite belief"):
        estimator.release()
    opened = dataclasses.replace(frames[4], tool=dataclasses.replace(frames[4].tool, closed=False))
    assert estimator.update(opened) is None
    assert [index for index, why in estimator.skipped if "no finite belief" in why] == [opened.index]
    np.testing.assert_array_equal(estimator.detection.stiffness, before.stiffness)
    with pytest.raises(ValueError, match="only the filter 'implicit' can identify the sheet; this one is 'nnls'"):
        estimator.identify()


def test_a_negative_seed_is_refused():
    with pytest.raises(ValueError, match=r"EstimatorConfig\.seed = -1: must be an integer of at least 0"):
        EstimatorConfig(seed=-1)


def test_another_seed_draws_other_samples_and_the_same_seed_the_same():
    """Samples are drawn when the jaws open."""
    found = []
    for seed in (0, 0, 1):
        estimator = Estimator(DECLARATION, config=dataclasses.replace(CONFIG, seed=seed))
        for one in episode()[:6]:
            estimator.update(one)
        estimator.release()
        found.append(np.asarray(estimator.detection.score))
    np.testing.assert_array_equal(found[0], found[1])
    assert not np.array_equal(found[0], found[2])


@pytest.mark.parametrize("ask", ["belief", "detection", "balance", "attachment_belief", "point_precision"])
def test_asking_for_results_before_the_first_grasp_is_refused_in_words(ask):
    with pytest.raises(ValueError, match="not known before the first frame with closed jaws"):
        getattr(Estimator(DECLARATION), ask)
