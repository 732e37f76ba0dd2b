"""The noise of points that counts: what the recording states, and what frames at rest show."""

import numpy as np
import pytest

from jiggle_mj.errors import ObservationError
from jiggle_mj.estimator.perception import PointTracker
from jiggle_mj.estimator.perception.point_noise import CombinedNoise
from jiggle_mj.estimator.perception.still_noise import StillNoise
from jiggle_mj.observation import MeasuredPoints
from tests.support.small_sheet import sheet

WHITE, SMOOTH, LENGTH = 1.2e-4, 1.6e-4, 0.014
"""Parts of a noise of 0.2 mm, and the range of the smooth one [m]."""
TOTAL = 2e-4
"""Both together [m]."""
SAMPLING = 0.25
"""Relative error of a smooth noise from 20 frames: it has few independent values."""
HELD_VARIANCE = 0.9
"""Share of a smooth noise's variance that its fields hold at least, over the mean of the particles."""


def points(positions=None, **noise) -> MeasuredPoints:
    positions = sheet().rest if positions is None else positions
    return MeasuredPoints(positions=positions, track_id=np.arange(len(positions)), **noise)


STATED = {"sd": TOTAL, "smooth_sd": SMOOTH, "smooth_length": LENGTH}


def still(scale: float, **stated) -> list[MeasuredPoints]:
    """Return 20 frames at rest whose noise is `scale` times the one of above."""
    draw, rest = np.random.default_rng(0), sheet().rest
    squared = np.sum((rest[:, None] - rest[None]) ** 2, axis=2)
    values, vectors = np.linalg.eigh(np.exp(-0.5 * squared / LENGTH**2))
    root = vectors * np.sqrt(np.maximum(values, 0))
    white, smooth = draw.normal(size=(2, 20, len(rest), 3))
    return [
        points(rest + scale * (WHITE * one + SMOOTH * root @ shared), **stated)
        for one, shared in zip(white, smooth, strict=True)
    ]


def test_stated_noise_counts_without_frames_at_rest():
    tracker = PointTracker()
    tracker.start([points(**STATED)])
    track = tracker.track(points(**STATED))
    assert tracker.noise is not None and tracker.noise.published.source == "stated"
    assert tracker.noise.published.sd == pytest.approx(WHITE)
    assert tracker.noise.published.still_frames == 0
    assert track.fields is not None
    shared = np.sum(np.asarray(track.fields) ** 2, axis=1)
    assert HELD_VARIANCE * 2 * SMOOTH**2 < shared.mean() <= 2 * SMOOTH**2  # of the frame, and of the rest positions
    np.testing.assert_allclose(track.covariance[:, 0, 0], 2 * TOTAL**2)


def test_nothing_stated_and_nothing_measured_is_assumed_to_be_white():
    tracker = PointTracker()
    tracker.start([points(sd_stated=False)])
    assert tracker.noise is not None
    found = tracker.noise.published
    assert (found.source, found.stated_sd, found.smooth_sd, found.smooth_length) == ("assumed", None, 0.0, None)
    assert tracker.track(points()).fields is None


@pytest.mark.parametrize(("scale", "source"), [(0.5, "stated"), (1.0, "stated"), (3.0, "measured")])
def test_measured_noise_counts_where_it_is_more_than_stated(scale, source):
    tracker = PointTracker()
    tracker.start(still(scale, **STATED))
    assert tracker.noise is not None
    found = tracker.noise.published
    assert (found.source, found.stated_sd, found.still_frames) == (source, TOTAL, 20)
    expected = max(1.0, scale)
    assert found.total_sd == pytest.approx(expected * TOTAL, rel=SAMPLING if scale > 1 else 1e-12)
    assert found.smooth_sd == pytest.approx(expected * SMOOTH, rel=SAMPLING if scale > 1 else 1e-12)


def test_a_shared_part_that_is_not_stated_is_measured():
    tracker = PointTracker()
    tracker.start(still(1.0, sd=TOTAL))
    assert tracker.noise is not None
    found = tracker.noise.published
    assert found.source == "measured" and found.smooth_sd == pytest.approx(SMOOTH, rel=SAMPLING)
    assert found.total_sd >= TOTAL


def test_a_statement_of_shared_noise_alone_leaves_room_for_that_of_single_points():
    """The white part's inverse covariance stays finite."""
    nearly = points(sd=TOTAL, smooth_sd=TOTAL * (1 - 1e-12), smooth_length=LENGTH)
    noise = CombinedNoise.of(nearly, None).noise
    assert noise.sd > 0.1 * TOTAL and noise.total_sd == pytest.approx(TOTAL)
    measured = StillNoise(sd=1e-9, smooth_sd=5e-4, length=LENGTH, frames=9)
    assert CombinedNoise.of(nearly, measured).noise.sd > 0.1 * 5e-4


@pytest.mark.parametrize(
    ("noise", "match"),
    [
        ({"sd": TOTAL, "smooth_sd": TOTAL, "smooth_length": LENGTH}, "of which it is a part"),
        ({"sd": TOTAL, "smooth_sd": SMOOTH}, "needs a smooth_length"),
        ({"sd": TOTAL, "smooth_sd": SMOOTH, "smooth_length": 0.0}, "smooth_length must be above 0"),
        ({"sd": TOTAL, "smooth_sd": -SMOOTH}, "smooth_sd must be"),
    ],
)
def test_a_noise_that_cannot_be_is_refused(noise, match):
    with pytest.raises(ObservationError, match=match):
        points(**noise)
