"""The frames of the reported part that are shown: which ones, and that their positions give the reported errors."""

import numpy as np
import pytest

from jiggle_mj.estimator.attribution.reported_part import RESOLUTION, median_and_worst


def test_the_median_and_the_worst_frame_are_those_of_ranked_errors():
    by_size = [np.array([[size, 0.0, 0.0]]) for size in (3.0, 1.0, 4.0, 2.0, 5.0)]
    assert median_and_worst(by_size) == [0, 4]
    assert median_and_worst(by_size[:4]) == [3, 2]
    assert median_and_worst([*by_size[:2], np.zeros((0, 3))]) == [1, 0]
    assert median_and_worst(by_size[:1]) == [0] and median_and_worst([np.zeros((0, 3))]) == []


def test_the_positions_of_shown_frames_give_the_errors_that_are_reported(light):
    """Each frame's error is the root mean square distance of its observed and its predicted positions."""
    _, found, dataset = light
    reported = {frame["index"]: frame for frame in found["held_out"]["frames"]}
    shown = found["held_out"]["shown"]
    errors = sorted(frame["after_rms_m"] for frame in reported.values())
    assert [reported[one["index"]]["after_rms_m"] for one in shown] == [errors[(len(errors) - 1) // 2], errors[-1]]
    for one in shown:
        frame = next(timed for timed in dataset.frames if timed.index == one["index"])
        counted = np.asarray(frame.frame.counted)
        assert [k for k, x in enumerate(one["observed_m"]) if x is not None] == np.flatnonzero(counted).tolist()
        observed = np.array([one["observed_m"][k] for k in np.flatnonzero(counted)])
        assert one["time_s"] == frame.time == reported[one["index"]]["time_s"]
        np.testing.assert_allclose(observed, np.asarray(frame.frame.y)[counted], atol=10.0**-RESOLUTION)
        for when in ("before", "after", "with_remainder"):
            apart = observed - np.array([one[f"{when}_m"][k] for k in np.flatnonzero(counted)])
            error = np.sqrt(np.mean(np.sum(apart**2, axis=1)))
            assert error == pytest.approx(reported[one["index"]][f"{when}_rms_m"], abs=2 * 10.0**-RESOLUTION)
