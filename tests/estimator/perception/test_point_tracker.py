"""The tracker of measured points: noise of a declared mesh, and outliers among the frames at rest."""

import numpy as np
import pytest

from jiggle_mj.errors import PerceptionError
from jiggle_mj.estimator.perception import PointTracker
from jiggle_mj.observation import MAX_PARTICLES, DeclaredMesh, MeasuredPoints
from tests.support.small_sheet import sheet

SD = 2e-4
"""Noise of a coordinate [m]."""
SAMPLING = 0.1
"""Relative sampling error of a mean square of 81 x 3 coordinates: one standard deviation is sqrt(2 / 243) = 0.09."""


def points(positions, ids=None):
    return MeasuredPoints(positions=positions, track_id=np.arange(sheet().n) if ids is None else ids, sd=SD)


def variance(mesh, still):
    """Return the variance of a coordinate in a frame: its own noise and the mesh's."""
    tracker = PointTracker(DeclaredMesh(vertices=mesh, faces=sheet().faces, track_id=np.arange(sheet().n)))
    tracker.start(still)
    return tracker.track(points(sheet().rest)).covariance[0, 0, 0]


def noisy(seed):
    return sheet().rest + SD * np.random.default_rng(seed).normal(size=(sheet().n, 3))


@pytest.mark.parametrize("frames", [1, 4])
def test_an_exact_mesh_adds_no_noise_and_a_measured_one_its_own(frames):
    still = [points(noisy(seed)) for seed in range(frames)]
    assert variance(sheet().rest, still) == pytest.approx(SD**2, rel=SAMPLING)
    assert variance(noisy(9), still) == pytest.approx(2 * SD**2, rel=SAMPLING)


def test_a_mesh_that_is_a_frame_itself_has_that_frames_noise():
    first = noisy(0)
    assert variance(first, [points(first)]) == pytest.approx(2 * SD**2)
    assert variance(first, [points(first), points(noisy(1))]) == pytest.approx(2 * SD**2)


def test_a_mesh_that_no_frame_shows_has_a_frames_noise():
    elsewhere = points(sheet().rest, ids=np.arange(sheet().n) + 1000)
    assert variance(sheet().rest, [elsewhere]) == pytest.approx(2 * SD**2)


def test_a_mesh_far_from_every_frame_is_no_worse_than_a_frame():
    """A shift of all particles is no noise of the rest shape."""
    assert variance(sheet().rest + 0.01, [points(noisy(0))]) == pytest.approx(2 * SD**2)


def test_frames_in_which_the_sheet_has_moved_already_do_not_count_as_rest():
    still = [points(noisy(seed)) for seed in range(18)] + [points(noisy(seed) + 2e-3) for seed in (18, 19)]
    rest = PointTracker().start(still).rest
    np.testing.assert_array_equal(rest, PointTracker().start(still[:18]).rest)
    noise_of_a_mean = SD / np.sqrt(18 * sheet().n)
    assert np.abs(np.mean(rest - sheet().rest, axis=0)).max() < 3 * noise_of_a_mean


def test_frames_that_differ_by_noise_alone_or_half_of_the_time_all_count():
    alike = [points(noisy(seed)) for seed in range(20)]
    np.testing.assert_allclose(PointTracker().start(alike).rest, np.mean([frame.positions for frame in alike], axis=0))
    halved = alike[:10] + [points(noisy(seed) + 2e-3) for seed in range(10)]
    assert np.mean(PointTracker().start(halved).rest - sheet().rest) == pytest.approx(
        1e-3,
        abs=3 * SD / np.sqrt(10 * 3 * sheet().n),  # the same ten noises twice
    )


def test_noise_that_neighbours_share_is_found_in_still_frames():
    """Half of the variance is shared over 14 mm; the covariance holds all of it, the fields the shared part."""
    draw, rest = np.random.default_rng(0), sheet().rest
    squared = np.sum((rest[:, None] - rest[None]) ** 2, axis=2)
    values, vectors = np.linalg.eigh(np.exp(-0.5 * squared / 0.014**2))
    root = vectors * np.sqrt(np.maximum(values, 0))
    white, smooth = draw.normal(size=(2, 20, sheet().n, 3)) * SD / np.sqrt(2)
    tracker = PointTracker()
    tracker.start([points(rest + own + root @ shared) for own, shared in zip(white, smooth, strict=True)])
    track = tracker.track(points(rest))
    assert track.fields is not None
    assert tracker.track(points(rest)).fields is track.fields  # one array for all frames
    share = np.sum(track.fields**2, axis=1) / track.covariance[:, 0, 0]
    assert np.mean(share) == pytest.approx(0.5, abs=0.1)  # of few independent values in 20 frames
    assert track.covariance[:, 0, 0].mean() == pytest.approx(SD**2 * (1 + 1 / 20), rel=2 * SAMPLING)


def test_white_noise_has_no_shared_part():
    tracker = PointTracker()
    tracker.start([points(noisy(seed)) for seed in range(20)])
    track = tracker.track(points(sheet().rest))
    assert track.fields is None
    np.testing.assert_allclose(track.covariance[:, 0, 0], SD**2 * (1 + 1 / 20))


@pytest.mark.parametrize("declared", [False, True])
def test_more_points_than_can_be_estimated_are_refused_before_anything_is_computed_from_them(declared):
    n = MAX_PARTICLES + 1
    row = np.column_stack([np.arange(n) * 1e-5, np.zeros((n, 2))])
    ids = np.arange(n)
    mesh = DeclaredMesh(vertices=row, faces=np.array([[0, 1, 2]]), track_id=ids) if declared else None
    with pytest.raises(PerceptionError, match="at most 20000 can be estimated"):
        PointTracker(mesh).start([MeasuredPoints(positions=row, track_id=ids, sd=SD)] * 2)


def test_vertices_that_nothing_measures_have_no_shared_noise_and_do_not_change_that_of_the_others():
    draw, rest = np.random.default_rng(0), sheet().rest
    squared = np.sum((rest[:, None] - rest[None]) ** 2, axis=2)
    values, vectors = np.linalg.eigh(np.exp(-0.5 * squared / 0.014**2))
    root = vectors * np.sqrt(np.maximum(values, 0))
    white, smooth = draw.normal(size=(2, 20, sheet().n, 3)) * SD / np.sqrt(2)
    still = [points(rest + own + root @ shared) for own, shared in zip(white, smooth, strict=True)]
    beyond = rest + np.array([2 * np.ptp(rest[:, 0]), 0.0, 0.0])
    ids = np.arange(sheet().n)
    fields = []
    for vertices, faces, track_id in (
        (rest, sheet().faces, ids),
        (
            np.concatenate([rest, beyond]),
            np.concatenate([sheet().faces, sheet().faces + sheet().n]),
            np.append(ids, -np.ones_like(ids)),
        ),
    ):
        tracker = PointTracker(DeclaredMesh(vertices=vertices, faces=faces, track_id=track_id))
        tracker.start(still)
        fields.append(tracker.track(still[0]).fields)
    assert fields[0] is not None and fields[1] is not None
    np.testing.assert_array_equal(fields[1][: sheet().n], fields[0])
    assert not np.any(fields[1][sheet().n :])
