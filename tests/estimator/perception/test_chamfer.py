"""The chamfer distance against brute force and differences; a sheet that is matched to a cloud."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from jiggle_mj.estimate import Sheet
from jiggle_mj.estimator.perception.chamfer import Chamfer, nearest
from jiggle_mj.estimator.perception.cloud_tracker import CloudTracker, offset
from jiggle_mj.estimator.physics.environment import Grip
from jiggle_mj.observation import MeasuredPoints
from tests.support.small_sheet import DECLARATION, GRIP_RADIUS, SPACING, attached, cloud, corners, lifts, sheet

SD = 2e-4
"""Noise of a point [m]."""
ROUNDING = 1e-12
"""Relative; sums of hundreds of terms of one sign in float64."""


def measured(x: np.ndarray, seed: int) -> MeasuredPoints:
    return MeasuredPoints(positions=cloud(x, seed, SD), sd=SD)


def cloud_tracker() -> CloudTracker:
    laid = Sheet(rest=sheet().rest, faces=sheet().faces)
    return CloudTracker(laid, DECLARATION, [measured(sheet().rest, seed) for seed in (100, 101)])


@pytest.mark.parametrize("reach", [np.inf, 1.5e-3])
def test_distance_and_gradient(reach):
    """Against all pairs, and against central differences over steps in which no nearest point changes."""
    chamfer, target = Chamfer.build(sheet(), count=400, reach=reach), cloud(lifts()[3].x, 0, SD)
    x = jnp.asarray(lifts()[2].x)
    squared = cdist(chamfer.sampled(x), target) ** 2
    points = np.asarray(chamfer.sampled(x))
    back = points[squared.argmin(axis=0)[squared.argmin(axis=1)]]
    shown = np.linalg.norm(points - back, axis=1) <= reach
    assert 0.5 < shown.mean() and shown.all() == np.isinf(reach)
    expected = squared.min(axis=0).sum() + squared.min(axis=1)[shown].sum()
    assert float(chamfer.distance(x, jnp.asarray(target))) == pytest.approx(expected, rel=ROUNDING)
    distance = lambda y: chamfer.distance(y, jnp.asarray(target))  # noqa: E731
    direction = np.random.default_rng(2).normal(size=x.shape)
    step = 1e-9
    difference = (distance(x + step * direction) - distance(x - step * direction)) / (2 * step)
    assert float(jnp.sum(jax.grad(distance)(x) * direction)) == pytest.approx(
        float(difference), rel=1e-8
    )  # rounding of a difference over 1e-9 m


def test_sampled_points_lie_on_the_mesh():
    chamfer = Chamfer.build(sheet(), count=400, reach=np.inf)
    np.testing.assert_allclose(np.sum(chamfer.weights, axis=1), 1, rtol=ROUNDING)
    assert (np.asarray(chamfer.weights) > -ROUNDING).all()
    moved = lambda x: x[:, [1, 2, 0]] + 0.1  # noqa: E731
    rest = jnp.asarray(sheet().rest)
    np.testing.assert_allclose(chamfer.sampled(moved(rest)), moved(chamfer.sampled(rest)), atol=ROUNDING)


def test_points_that_are_nan_are_nearest_to_nothing():
    first, second = np.zeros((3, 3)), np.array([[np.nan] * 3, [1.0, 0, 0], [0.1, 0, 0]])
    in_second, in_first = nearest(jnp.asarray(first), jnp.asarray(second))
    np.testing.assert_array_equal(in_second, 2)
    assert int(in_first[1]) == int(in_first[2]) == 0
    chamfer, x = Chamfer.build(sheet(), count=400, reach=np.inf), jnp.asarray(sheet().rest)
    target = cloud(sheet().rest, 0, SD)
    padded = np.concatenate([target, np.full((200, 3), np.nan)])
    assert float(chamfer.distance(x, jnp.asarray(padded))) == float(chamfer.distance(x, jnp.asarray(target)))


@pytest.fixture(scope="module")
def tracks():
    """Return the tracks of three increments of a lift, each matched from the one before."""
    tracker = cloud_tracker()
    corner, x, tracks = corners()[0], sheet().rest, []
    length = jnp.asarray(np.linalg.norm(x - corner, axis=1))
    for seed, frame in enumerate(lifts()[1:4]):
        grip = Grip.of(jnp.asarray(frame.tip), length, jnp.where(length <= GRIP_RADIUS, 90.0, 0.0))
        tracks.append(tracker.simulated(measured(frame.x, seed), x, 3.0 * attached(), grip))
        x = tracks[-1].positions
    return tracks


def test_the_state_lies_on_the_cloud(tracks):
    """Across the surface within the noise of a point; along it within 8 % of the motion.

    Measured: 0.7 standard deviations of a point, and 5 %.
    """
    truth = lifts()[3].x
    error = tracks[-1].positions - truth
    moved = np.linalg.norm(truth - sheet().rest, axis=1)
    sd = np.sqrt(np.linalg.eigvalsh(tracks[-1].covariance))
    np.testing.assert_allclose(sd[:, 0], SD)
    normal = np.linalg.eigh(tracks[-1].covariance)[1][:, :, 0]
    across = np.abs(np.sum(error * normal, axis=1))
    assert tracks[-1].visible.all() and moved.max() > 0.015
    assert np.sqrt(np.mean(across**2)) < SD
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.08 * np.sqrt(np.mean(moved**2))


def test_the_offset_is_the_mean_of_the_points_around_along_the_normal():
    x, normal = np.array([[0.0, 0, 0], [1.0, 0, 0]]), np.array([[0.0, 0, 1], [0.0, 0, 1]])
    around = np.array([[0.01, 0, 0.02], [-0.01, 0, 0.04], [0.5, 0, 9.0]])
    np.testing.assert_allclose(offset(x, normal, around, 0.1), [0.03, np.nan])


def test_what_no_point_lies_near_is_not_seen():
    tracker = cloud_tracker()
    target = cloud(sheet().rest, 0, SD)
    half = MeasuredPoints(positions=target[target[:, 0] < 0], sd=SD)
    grip = Grip.build(jnp.asarray(sheet().rest), jnp.asarray(corners()[0]), radius=GRIP_RADIUS, stiffness=90.0)
    track = tracker.simulated(half, sheet().rest, np.zeros(sheet().n), grip)
    hidden = sheet().rest[:, 0] > 0.012 + SPACING
    assert not track.visible[hidden].any() and track.visible[sheet().rest[:, 0] < 0].all()
    assert np.isnan(track.positions[hidden]).all()
    assert np.nanmax(np.linalg.norm(track.positions - sheet().rest, axis=1)) < 1.5e-3


def test_without_reach_the_hidden_part_is_pulled_to_the_seen_one():
    """This is why the paper's form is not the default."""
    target = cloud(sheet().rest, 0, SD)
    half, x = jnp.asarray(target[target[:, 0] < 0]), jnp.asarray(sheet().rest)
    hidden = np.asarray(sheet().rest)[:, 0] > 0.02
    built = [Chamfer.build(sheet(), count=400, reach=reach) for reach in (np.inf, SPACING)]
    pull = [np.abs(jax.grad(chamfer.distance)(x, half)) for chamfer in built]
    assert (pull[0][hidden, 0] > 1e-3).all() and (pull[1][hidden] == 0).all()


def test_a_cloud_without_points_shows_no_particle():
    tracker = cloud_tracker()
    nothing = MeasuredPoints(positions=np.full((100, 3), np.nan), sd=SD)
    grip = Grip.build(jnp.asarray(sheet().rest), jnp.asarray(corners()[0]), radius=GRIP_RADIUS, stiffness=90.0)
    assert not tracker.simulated(nothing, sheet().rest, np.zeros(sheet().n), grip).visible.any()
