"""Times of frames: units, exactness and plausibility."""

import numpy as np
import pytest

from jiggle_mj.errors import RecordingError
from jiggle_mj.importing.clock import frame_clock

EPOCH = 1_732_800_000_000_000_003
"""Nanoseconds since 1970, beyond what 64-bit floats distinguish."""
PERIODS = np.cumsum([0, 33_333_333, 33_333_334, 33_333_333])
"""Times of a 30 Hz camera [ns]."""


def clock(times: np.ndarray, unit: int | None):
    return frame_clock(count=len(times), period=None, times=times, unit=unit, runs=None)


@pytest.mark.parametrize("dtype", [np.int64, np.uint64])
def test_nanoseconds_since_1970_lose_nothing(dtype):
    found = clock((EPOCH + PERIODS).astype(dtype), 1)
    assert found.times == PERIODS.tolist() and found.origin == EPOCH


@pytest.mark.parametrize(("unit", "factor"), [(1_000_000, 1e-6), (1_000, 1e-3), (1, 1.0)])
def test_ms_us_and_ns_called_seconds_are_refused_and_read_where_stated(unit, factor):
    times = 20.0 * factor * PERIODS / 33_333_333 * 33_333_333  # 0.67 s a frame
    with pytest.raises(RecordingError, match=r"times in s give a frame every .*give time_unit = "):
        clock(times, None)
    np.testing.assert_allclose(clock(times, unit).times, 20 * PERIODS, atol=1)  # rounding to 1 ns


def test_slow_frames_are_read_where_seconds_are_stated():
    assert clock(np.array([0.0, 24.5, 49.0]), 1_000_000_000).times == [0, 24_500_000_000, 49_000_000_000]
    with pytest.raises(RecordingError, match='give time_unit = "ms" or time_unit = "s" if it is right'):
        clock(np.array([0.0, 24.5, 49.0]), None)


@pytest.mark.parametrize(
    ("times", "message"),
    [
        (np.array([0.0, 1.7328e9, 1.7328e9 + 0.1, 1.7328e9 + 0.2, 1.7328e9 + 0.3]), "from frame 0 to frame 1"),
        (np.array([0.0, np.nan, 1.0]), "must be finite"),
        (np.array([0.0, 2.0, 1.0]), "must increase; entry 2 is 1.0 after 2.0"),
        (1.7328e9 + 0.1 * np.arange(5, dtype=np.float32), "must increase|float32 is too short"),
        ((1.7328e9 + 0.1 * np.arange(5)).astype(np.float32), "float32 is too short for such times"),
        (1e300 * np.arange(3), "a frame every 1e.300 s"),
        (np.zeros((2, 2)), "it has shape"),
    ],
)
def test_impossible_times_are_refused(times, message):
    with pytest.raises(RecordingError, match=message):
        clock(times, None)


def test_the_longest_gap_is_said():
    (note,) = clock(np.array([0.0, 0.1, 0.2, 3.2, 3.3]), None).notes
    assert note.startswith("1 gap in the frames: the longest, 3 s, comes after frame 2")
