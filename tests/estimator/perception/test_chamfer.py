"""The chamfer distance against brute force and differences; a sheet that meets a cloud."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from jiggle_mj.errors import PerceptionError
from jiggle_mj.estimate import Sheet
from jiggle_mj.estimator.perception.chamfer import Chamfer, nearest
from jiggle_mj.estimator.perception.cloud_tracker import CloudTracker, lay_mesh, offset, thinned
from jiggle_mj.estimator.physics.environment import Grip
from jiggle_mj.estimator.physics.mesh import SheetMesh
from jiggle_mj.observation import MeasuredPoints
from tests.support.small_sheet import DECLARATION, GRIP_RADIUS, SPACING, attached, cloud, corners, lifts, sheet

SD = 2e-4


def measured(x: np.ndarray, seed: int) -> MeasuredPoints:
    return MeasuredPoints(positions=cloud(x, seed, SD), sd=SD)


@pytest.mark.parametrize("reach", [np.inf, 1.5e-3])
def test_distance_and_gradient(reach):
    """Against all pairs, and against central differences over steps in which no nearest point changes."""
    chamfer, there = Chamfer.build(sheet(), count=400, reach=reach), cloud(lifts()[3].x, 0, SD)
    x = jnp.asarray(lifts()[2].x)
    apart = cdist(chamfer.sampled(x), there) ** 2
    points = np.asarray(chamfer.sampled(x))
    back = points[apart.argmin(axis=0)[apart.argmin(axis=1)]]
    shown = np.linalg.norm(points - back, axis=1) <= reach
    assert 0.5 < shown.mean() and shown.all() == np.isinf(reach)
    expected = apart.min(axis=0).sum() + apart.min(axis=1)[shown].sum()
    assert float(chamfer.distance(x, jnp.asarray(there))) == pytest.approx(expected, rel=1e-12)
    distance = lambda y: chamfer.distance(y, jnp.asarray(there))  # noqa: E731
    way = np.random.default_rng(2).normal(size=x.shape)
    step = 1e-9
    difference = (distance(x + step * way) - distance(x - step * way)) / (2 * step)
    assert float(jnp.sum(jax.grad(distance)(x) * way)) == pytest.approx(float(difference), rel=1e-4)


def test_sampled_points_lie_on_the_mesh():
    chamfer = Chamfer.build(sheet(), count=400, reach=np.inf)
    np.testing.assert_allclose(np.sum(chamfer.weights, axis=1), 1, rtol=1e-12)
    assert (np.asarray(chamfer.weights) > -1e-12).all()
    rotated = lambda x: x[:, [1, 2, 0]] + 0.1  # noqa: E731
    rest = jnp.asarray(sheet().rest)
    np.testing.assert_allclose(chamfer.sampled(rotated(rest)), rotated(chamfer.sampled(rest)), atol=1e-12)


def test_points_that_are_nan_are_nearest_to_nothing():
    one, other = np.zeros((3, 3)), np.array([[np.nan] * 3, [1.0, 0, 0], [0.1, 0, 0]])
    of_one, of_other = nearest(jnp.asarray(one), jnp.asarray(other))
    np.testing.assert_array_equal(of_one, 2)
    assert int(of_other[1]) == int(of_other[2]) == 0
    chamfer, x = Chamfer.build(sheet(), count=400, reach=np.inf), jnp.asarray(sheet().rest)
    there = cloud(sheet().rest, 0, SD)
    padded = np.concatenate([there, np.full((200, 3), np.nan)])
    assert float(chamfer.distance(x, jnp.asarray(padded))) == float(chamfer.distance(x, jnp.asarray(there)))


@pytest.fixture(scope="module")
def met():
    """Three increments of a lift, each met from the one before; and what was seen of the last."""
    tracker = CloudTracker(Sheet(rest=sheet().rest, faces=sheet().faces), DECLARATION)
    corner, x, tracks = corners()[0], sheet().rest, []
    length = jnp.asarray(np.linalg.norm(x - corner, axis=1))
    for seed, frame in enumerate(lifts()[1:4]):
        grip = Grip.of(jnp.asarray(frame.tip), length, jnp.where(length <= GRIP_RADIUS, 90.0, 0.0))
        tracks.append(tracker.track(measured(frame.x, seed), x, 3.0 * attached(), grip))
        x = tracks[-1].positions
    return tracks


def test_the_state_lies_on_the_cloud(met):
    """Across the surface within the noise of a point and what the facets are off; along it less closely."""
    truth = lifts()[3].x
    error = met[-1].positions - truth
    moved = np.linalg.norm(truth - sheet().rest, axis=1)
    sd = np.sqrt(np.linalg.eigvalsh(met[-1].covariance))
    np.testing.assert_allclose(sd[:, 0], SD)
    normal = np.linalg.eigh(met[-1].covariance)[1][:, :, 0]
    across = np.abs(np.sum(error * normal, axis=1))
    assert met[-1].visible.all() and moved.max() > 0.015
    assert np.sqrt(np.mean(across**2)) < 3 * SD
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.25 * np.sqrt(np.mean(moved**2))


def test_the_offset_is_the_mean_of_the_points_around_along_the_normal():
    x, normal = np.array([[0.0, 0, 0], [1.0, 0, 0]]), np.array([[0.0, 0, 1], [0.0, 0, 1]])
    around = np.array([[0.01, 0, 0.02], [-0.01, 0, 0.04], [0.5, 0, 9.0]])
    np.testing.assert_allclose(offset(x, normal, around, 0.1), [0.03, np.nan])


def test_what_no_point_lies_near_is_not_seen():
    tracker = CloudTracker(Sheet(rest=sheet().rest, faces=sheet().faces), DECLARATION)
    there = cloud(sheet().rest, 0, SD)
    half = MeasuredPoints(positions=there[there[:, 0] < 0], sd=SD)
    grip = Grip.build(jnp.asarray(sheet().rest), jnp.asarray(corners()[0]), radius=GRIP_RADIUS, stiffness=90.0)
    track = tracker.track(half, sheet().rest, np.zeros(sheet().n), grip)
    hidden = sheet().rest[:, 0] > 0.012 + SPACING
    assert not track.visible[hidden].any() and track.visible[sheet().rest[:, 0] < 0].all()
    assert np.isnan(track.positions[hidden]).all()
    assert np.nanmax(np.linalg.norm(track.positions - sheet().rest, axis=1)) < 1.5e-3


def test_without_reach_the_hidden_part_is_pulled_to_the_seen_one():
    """Why the paper's form is not the default."""
    there = cloud(sheet().rest, 0, SD)
    half, x = jnp.asarray(there[there[:, 0] < 0]), jnp.asarray(sheet().rest)
    hidden = np.asarray(sheet().rest)[:, 0] > 0.02
    built = [Chamfer.build(sheet(), count=400, reach=reach) for reach in (np.inf, SPACING)]
    pull = [np.abs(jax.grad(chamfer.distance)(x, half)) for chamfer in built]
    assert (pull[0][hidden, 0] > 1e-3).all() and (pull[1][hidden] == 0).all()


def test_a_mesh_over_clouds_at_rest():
    still = [measured(sheet().rest, seed) for seed in range(3)]
    found = lay_mesh(still, spacing=SPACING)
    gaps = cdist(found.rest, found.rest) + np.eye(len(found.rest))
    assert 0.5 * SPACING < gaps.min(axis=1).mean() < 1.2 * SPACING
    assert np.abs(found.rest[:, 2]).max() < 2 * SD
    assert 0.8 * sheet().face_area.sum() < SheetMesh(found.rest, found.faces).face_area.sum() < sheet().face_area.sum()


def test_thinning_keeps_points_apart_and_leaves_no_hole():
    flat = np.random.default_rng(0).uniform(0, 1, (2000, 2))
    chosen = flat[thinned(flat, 0.1)]
    apart = cdist(chosen, chosen) + np.eye(len(chosen))
    assert apart.min() > 0.1 and cdist(flat, chosen).min(axis=1).max() <= 0.1


def test_too_few_points_are_refused():
    with pytest.raises(PerceptionError, match=r"a sheet needs 20 \(more points, or a smaller"):
        lay_mesh([measured(sheet().rest, 0)], spacing=0.05)
    nothing = MeasuredPoints(positions=np.full((100, 3), np.nan), sd=SD)
    with pytest.raises(PerceptionError, match="have 0 points at most; a sheet needs 20"):
        lay_mesh([nothing], spacing=SPACING)
    rest = [nothing, measured(sheet().rest, 0)]
    np.testing.assert_array_equal(lay_mesh(rest, spacing=SPACING).rest, lay_mesh(rest[1:], spacing=SPACING).rest)


def test_a_cloud_of_nothing_shows_nothing():
    tracker = CloudTracker(Sheet(rest=sheet().rest, faces=sheet().faces), DECLARATION)
    nothing = MeasuredPoints(positions=np.full((100, 3), np.nan), sd=SD)
    grip = Grip.build(jnp.asarray(sheet().rest), jnp.asarray(corners()[0]), radius=GRIP_RADIUS, stiffness=90.0)
    assert not tracker.track(nothing, sheet().rest, np.zeros(sheet().n), grip).visible.any()
