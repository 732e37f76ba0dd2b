"""Noise of observed positions, measured from still frames."""

import numpy as np
import pytest

from jiggle_mj.estimator.perception.still_noise import MAX_MODES, MODE_MULTIPLE, StillNoise, measure
from tests.support.small_sheet import sheet

NOISE_ERROR = 0.25
"""Relative error of standard deviations and range: the smooth field has few independent values on this sheet."""
MODES_ERROR = 0.02
"""Share of the smooth variance that the fields do not hold, and that is spread evenly as white noise instead."""
JUMP_ERROR = 5e-6
"""Change of a standard deviation [m] by leaving out one of 19 differences."""
JITTER = 1e-9
"""Added to a covariance of fields before its factorisation."""


def test_noise_is_measured_from_still_frames_with_its_smooth_part():
    draw, rest = np.random.default_rng(0), sheet().rest
    squared_distance = np.sum((rest[:, None] - rest[None]) ** 2, axis=2)
    root = np.linalg.cholesky(np.exp(-0.5 * squared_distance / 0.012**2) + JITTER * np.eye(len(rest)))
    smooth = 2e-4 * np.einsum("ij,tjk->tik", root, draw.normal(size=(40, len(rest), 3)))
    noise = measure([rest[None] + smooth + 1e-4 * draw.normal(size=(40, len(rest), 3))], rest)
    assert noise is not None
    assert noise.sd == pytest.approx(1e-4, rel=NOISE_ERROR)
    assert noise.smooth_sd == pytest.approx(2e-4, rel=NOISE_ERROR)
    assert noise.length == pytest.approx(0.012, rel=NOISE_ERROR)
    fields, white = noise.fields(rest)
    total = np.sum(fields**2, axis=1) + white**2
    assert total.mean() == pytest.approx(noise.sd**2 + noise.smooth_sd**2, rel=MODES_ERROR)


def test_smooth_noise_counts_as_white_where_it_is_small():
    rest = sheet().rest
    nearly_white = StillNoise(sd=2e-4, smooth_sd=4e-5, length=0.004, frames=9)
    fields, white = nearly_white.fields(rest)
    assert fields.shape == (len(rest), 0)
    assert white == pytest.approx(np.hypot(nearly_white.sd, nearly_white.smooth_sd))
    shared = StillNoise(sd=1e-4, smooth_sd=2e-4, length=0.02, frames=9).fields(rest)[0]
    assert shared.shape[1] % MODE_MULTIPLE == 0
    assert 0 < np.sum(np.any(shared != 0, axis=0)) <= MAX_MODES


def test_a_jump_between_still_frames_is_no_noise():
    draw, rest = np.random.default_rng(0), sheet().rest
    still = rest[None] + 1e-4 * draw.normal(size=(20, len(rest), 3))
    jumped = still + np.where(np.arange(20) < 17, 0.0, 3e-3)[:, None, None]
    plain, noise = measure([still], rest), measure([jumped], rest)
    assert plain is not None and noise is not None
    assert (noise.sd, noise.smooth_sd) == pytest.approx((plain.sd, plain.smooth_sd), abs=JUMP_ERROR)


def test_too_few_still_frames_give_no_noise():
    assert measure([np.zeros((2, 5, 3))], np.zeros((5, 3))) is None


def test_fields_are_those_of_the_measured_particles_and_zero_elsewhere():
    rest, noise = sheet().rest, StillNoise(sd=1e-4, smooth_sd=2e-4, length=0.02, frames=9)
    measured = rest[:, 0] < np.median(rest[:, 0])
    fields, white = noise.fields(rest, measured)
    alone, same = noise.fields(rest[measured])
    np.testing.assert_array_equal(fields[measured], alone)
    assert not fields[~measured].any()
    assert white == same


def test_the_range_is_searched_within_the_extent_of_what_is_measured():
    """A declared mesh may reach far beyond the points; their noise has the same range then."""
    draw, rest = np.random.default_rng(0), sheet().rest
    squared_distance = np.sum((rest[:, None] - rest[None]) ** 2, axis=2)
    root = np.linalg.cholesky(np.exp(-0.5 * squared_distance / 0.012**2) + JITTER * np.eye(len(rest)))
    smooth = 2e-4 * np.einsum("ij,tjk->tik", root, draw.normal(size=(40, len(rest), 3)))
    seen = rest[None] + smooth + 1e-4 * draw.normal(size=(40, len(rest), 3))
    far = np.array([[5.0, 0.0, 0.0], [-5.0, 0.0, 0.0]])
    wide = np.concatenate([seen, np.full((40, 2, 3), np.nan)], axis=1)
    assert measure([wide], np.concatenate([rest, far])) == measure([seen], rest)
