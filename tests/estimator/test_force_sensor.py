"""The offset of a force sensor is what it shows with open jaws, and its noise what scatters there."""

from dataclasses import replace

import numpy as np
import pytest

from jiggle_mj.estimator.force_sensor import ForceSensor
from jiggle_mj.force_scatter import MIN_OPEN
from jiggle_mj.observation import MeasuredForce, Observation
from tests.support.recordings import tool

OFFSET, SD = np.array([0.3, -0.1, -0.7]), 0.02


def observation(index: int, *, closed: bool, on_tool: np.ndarray, sd: float | None = None) -> Observation:
    force = MeasuredForce(on_tool=on_tool, sd=sd)
    return Observation(index=index, time=index, tool=replace(tool(), closed=closed), force=force)


def readings(count: int, sd: float | None = None):
    """Return what a sensor makes of a force (0, 0, -1) after some frames with open jaws."""
    sensor, rng = ForceSensor(), np.random.default_rng(0)
    for index in range(count):
        noisy = OFFSET + SD * rng.normal(size=3)
        assert sensor.look(observation(index, closed=False, on_tool=noisy, sd=sd)) is None
    return sensor.look(observation(count, closed=True, on_tool=OFFSET - np.array([0, 0, 1.0]), sd=sd))


def test_offset_and_noise_are_those_with_open_jaws():
    """Tolerances: three standard errors of a mean, and of a standard deviation, of 50 frames.

    The offset errs by the standard error of its mean.
    """
    force = readings(50)
    assert force is not None and int(force.index) == 50
    np.testing.assert_allclose(force.pull, [0, 0, 1], atol=3 * SD / 50**0.5)
    found = np.sqrt(np.diagonal(force.covariance))
    np.testing.assert_allclose(found, SD, rtol=3 / (2 * 150) ** 0.5)
    assert float(force.offset_sd) == pytest.approx(found[0] / 50**0.5)


def test_more_noise_with_open_jaws_than_is_stated_counts():
    """From 50 frames it is known to 6 %: three standard errors are 17 %."""
    force = readings(50, sd=SD / 1000)
    assert force is not None
    np.testing.assert_allclose(np.sqrt(np.diagonal(force.covariance)), SD, rtol=0.2)


def test_a_stated_noise_counts_and_too_few_frames_say_nothing():
    stated = readings(2, sd=0.5)
    assert stated is not None
    assert np.asarray(stated.covariance)[0, 0] == pytest.approx(0.25)
    assert float(stated.offset_sd) ** 2 == pytest.approx(0.25 / 2)
    unknown = readings(MIN_OPEN - 1)
    assert unknown is not None and np.isnan(np.asarray(unknown.covariance)).any()


def test_frames_of_one_grasp_share_an_offset_and_those_of_the_next_have_another():
    sensor, numbers = ForceSensor(), list[int]()
    for index, closed in enumerate([True, False, True, True, False, True]):
        force = sensor.look(observation(index, closed=closed, on_tool=OFFSET, sd=SD))
        numbers += [] if force is None else [int(force.offset_number)]
        assert force is None or (float(force.offset_sd) > 0) == (index > 0)
    assert numbers[1] == numbers[2] and len(set(numbers)) == 3
