"""What a cloud says of the particles, against sheets that were moved by a known way."""

import jax.numpy as jnp
import numpy as np
import pytest

from jiggle_mj.errors import PerceptionError
from jiggle_mj.estimate import Sheet
from jiggle_mj.estimator.perception.cloud_surface import Cloud, CloudSurface
from jiggle_mj.estimator.perception.cloud_tracker import CloudTracker, matched
from jiggle_mj.observation import MeasuredPoints
from tests.support.small_sheet import DECLARATION, SPACING, cloud, lifts, sheet

SD = 2e-4
"""Noise of a point [m]."""
STEP = 1e-7
"""Step of central differences of a quadratic [m]: their rounding is below 1e-6 of it."""
STILL = [cloud(sheet().rest, seed, SD) for seed in range(10)]
SURFACE = CloudSurface.build(sheet(), STILL, sd=SD)
NONE_HELD = jnp.zeros(sheet().n, bool)


def seen(points: np.ndarray, surface: CloudSurface = SURFACE) -> Cloud:
    return Cloud(surface=surface, points=jnp.asarray(points), sd=jnp.asarray(SD), sd_ratio=jnp.asarray(1.0))


def look(points: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    pull, precision = seen(points).matched(jnp.asarray(x), NONE_HELD)
    return np.asarray(pull), np.asarray(precision)


def inner() -> np.ndarray:
    return ~sheet().border


def test_the_pull_is_the_gradient_of_the_squared_heights():
    """On a flat sheet, whose points keep their triangles while particles move along its normal; none lies outside."""
    rng, points = np.random.default_rng(1), cloud(sheet().rest, 11, SD) * [0.95, 0.95, 1]
    direction = rng.normal(size=sheet().n)

    def cost(step: float) -> float:
        height = seen(points)._heights(jnp.asarray(sheet().rest + step * direction[:, None] * [0, 0, 1]), 0.0)[2]
        return 0.5 * float(jnp.sum((height / SD) ** 2))

    slope = (cost(STEP) - cost(-STEP)) / (2 * STEP)
    pull, _ = look(points, sheet().rest)
    assert -np.sum(pull[:, 2] * direction) == pytest.approx(slope, rel=1e-5)


def test_inside_the_outline_a_cloud_shows_the_height_alone():
    """Every point counts once; the precision of a particle has rank one."""
    points = cloud(sheet().rest, 12, SD) * [0.95, 0.95, 1]
    pull, precision = look(points + np.array([0, 0, 5e-4]), sheet().rest)
    assert precision[:, 2, 2].sum() == pytest.approx(len(points) / SD**2, rel=1e-6)
    np.testing.assert_allclose(precision[inner()][:, :2], 0, atol=1e-6 / SD**2)
    height = pull[:, 2] / precision[:, 2, 2]
    assert abs(height.mean() - 5e-4) < 3 * SD / np.sqrt(len(points))
    assert np.sqrt(np.mean((height - 5e-4) ** 2 * precision[:, 2, 2])) < 1  # corners share points: below 1


@pytest.mark.parametrize("shift", [(1e-3, 0.0), (-5e-4, 1.5e-3)])
def test_the_outline_shows_how_the_sheet_slides(shift):
    """Once the sheet is moved to where it is seen, within the standard deviations that the precisions claim."""
    errors = []
    for seed in range(20, 30):
        found, covariance = np.zeros(2), np.eye(2)
        for _ in range(4):
            x = sheet().rest + np.append(found, 0)
            pull, precision = look(cloud(sheet().rest, seed, SD) + np.append(shift, 0), x)
            covariance = np.linalg.inv(precision.sum(axis=0)[:2, :2])
            found = found + covariance @ pull.sum(axis=0)[:2]
        errors.append((found - shift) / np.sqrt(np.diagonal(covariance)))
    assert np.sqrt(np.mean(np.square(errors))) < 1.5  # 20 figures of about 1: below 1.45 in 99 of 100


def test_other_things_and_hidden_parts_change_nothing_elsewhere():
    """One point in ten lies anywhere above the sheet, and half of the sheet is hidden."""
    rng, points = np.random.default_rng(3), cloud(lifts()[3].x, 13, SD)
    hidden = points[:, 1] > 0.5 * SPACING
    others = rng.uniform(points.min(axis=0) - 0.01, points.max(axis=0) + 0.05, (len(points) // 10, 3))
    alone, precision = look(points[~hidden], lifts()[3].x)
    pull, _ = look(np.concatenate([points[~hidden], others]), lifts()[3].x)
    far = np.asarray(lifts()[3].x)[:, 1] > 2 * SPACING
    assert far.any() and (precision[far] == 0).all()
    shown = inner() & (np.trace(precision, axis1=1, axis2=2) > 1 / SD**2)
    moved = np.linalg.norm(pull - alone, axis=1)[shown] / np.trace(precision, axis1=1, axis2=2)[shown]
    assert np.median(moved) < 0.1 * SD and shown.sum() > 10


def test_a_lifted_minority_counts_while_the_state_is_searched():
    """By the spread of most points it would be something else, and the state stay behind."""
    points = cloud(sheet().rest, 16, SD)
    lifted = points[:, 0] > 1.5 * SPACING
    points[lifted, 2] += 0.4 * SPACING
    on = np.asarray(sheet().rest)[:, 0] > 2 * SPACING
    assert lifted.mean() < 0.4
    for gate, follows in ((0.5, True), (0.0, False)):
        pull, _ = seen(points).matched(jnp.asarray(sheet().rest), NONE_HELD, gate=gate)
        assert (np.asarray(pull)[on & inner(), 2] > 0).all() == follows


def test_a_learned_factor_widens_points_and_outline_alike():
    points = cloud(sheet().rest, 14, SD)
    twice = Cloud(surface=SURFACE, points=jnp.asarray(points), sd=jnp.asarray(SD), sd_ratio=jnp.asarray(2.0))
    for one, other in zip(look(points, sheet().rest), twice.matched(jnp.asarray(sheet().rest), NONE_HELD), strict=True):
        np.testing.assert_allclose(np.asarray(other), one / 4, rtol=1e-9, atol=1e-3)


def test_gaps_at_the_outline_need_one_cloud():
    """A gap is as large as it is spread where points lie at random."""
    one = CloudSurface.build(sheet(), STILL[:1], sd=SD)
    assert 0.5 < float(one.gap_sd) / float(SURFACE.gap_sd) < 2
    hidden = [still[still[:, 0] < 0] for still in STILL]
    half = CloudSurface.build(sheet(), hidden, sd=SD)
    assert 0 < np.isnan(np.asarray(half.gap)).sum() < len(half.gap)


def test_a_cloud_of_something_else_is_refused():
    laid = Sheet(rest=sheet().rest, faces=sheet().faces)
    tracker = CloudTracker(laid, DECLARATION, [MeasuredPoints(positions=still, sd=SD) for still in STILL])
    for points in (STILL[0] + [0, 0, 0.1], STILL[0] + [0.3, 0, 0], STILL[0] * 1e3):
        track = tracker.unmatched(MeasuredPoints(positions=points, sd=SD))
        assert track.cloud is not None
        with pytest.raises(PerceptionError, match="of the cloud's points lie on the sheet, and 50% are needed"):
            matched(track.cloud, sheet().rest, np.zeros(sheet().n, bool))
    with pytest.raises(PerceptionError, match="the cloud has 10 points; a sheet needs 20"):
        tracker.unmatched(MeasuredPoints(positions=STILL[0][:10], sd=SD))
    many = np.concatenate([cloud(sheet().rest, seed, SD) for seed in range(40, 60)])
    track = tracker.unmatched(MeasuredPoints(positions=many, sd=SD))
    assert track.cloud is not None and np.isfinite(track.cloud.points).all(axis=1).sum() == 3000
    shown, share = matched(track.cloud, sheet().rest, np.zeros(sheet().n, bool))
    assert share > 0.99 and shown.visible.all() and np.abs(shown.positions - sheet().rest)[inner()].max() < SD


def test_dense_clouds_move_the_outline_by_no_more_than_its_noise():
    """Clouds at rest are thinned as later ones are: else their points would lie nearer to the edge."""
    dense = [np.concatenate([cloud(sheet().rest, 50 + 20 * k + j, SD) for j in range(20)]) for k in range(4)]
    laid = Sheet(rest=sheet().rest, faces=sheet().faces)
    tracker = CloudTracker(laid, DECLARATION, [MeasuredPoints(positions=still, sd=SD) for still in dense[:3]])
    track = tracker.unmatched(MeasuredPoints(positions=dense[3], sd=SD))
    assert track.cloud is not None
    _, beyond, weight = track.cloud._edges(jnp.asarray(sheet().rest), jnp.asarray(4 * SD))
    shown = np.asarray(weight) > 0
    sd = float(track.cloud.surface.gap_sd) * np.sqrt(1 + 1 / 3)  # the gaps are the mean of three clouds
    assert abs(np.asarray(beyond)[shown].mean()) < 3 * sd / np.sqrt(shown.sum())
