"""Numbers of any size and any bits are read or refused without a warning of NumPy's, which the tests turn to errors."""

import warnings
from collections.abc import Iterator

import numpy as np
import pytest

from jiggle_mj.camera import CameraCalibration
from jiggle_mj.errors import ObservationError, OptionError, RecordingError
from jiggle_mj.observation import Declaration
from jiggle_mj.recording.stored_arrays import StoredArrays

HUGE = 1e200
"""Its square overflows."""
SIGNALLING_NAN = np.array([0x7FA00000], np.uint32).view(np.float32)


@pytest.fixture(autouse=True)
def warnings_as_errors() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def test_a_signalling_nan_is_a_missing_coordinate():
    assert np.isnan(StoredArrays({"x": SIGNALLING_NAN}, "a file").positions("x", (1,)))


def test_a_coordinate_beyond_the_limit_is_refused_beside_a_missing_one():
    with pytest.raises(RecordingError, match="an array x of inf; it must be coordinates within"):
        StoredArrays({"x": np.array([np.nan, np.inf])}, "a file").positions("x", (2,))


def test_a_huge_gravity_is_refused():
    with pytest.raises(OptionError, match="gravity must be at most"):
        Declaration(gravity=(HUGE, 0.0, 0.0))


def test_a_matrix_of_the_largest_numbers_is_no_rotation():
    K = np.diag([500.0, 500.0, 1.0])
    largest = np.full((3, 3), np.finfo(float).max)
    with pytest.raises(ObservationError, match=r"must be a rotation matrix; got \[\[1\.798e\+308"):
        CameraCalibration(width=32, height=24, K=K, P=np.hstack([K, np.zeros((3, 1))]), R=largest)
