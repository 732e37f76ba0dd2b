"""The truth in a file of its own: read back exactly, in the same bytes, and kept apart from observations."""

import json
from dataclasses import fields

import numpy as np
import pytest

from jiggle_mj.errors import RecordingError
from jiggle_mj.recording.truth import TruthWriter, read_truth, write_truth
from jiggle_mj.truth import TruthFrame
from tests.support.recordings import observations, truth, write


def test_truth_is_read_back_exactly_and_in_the_same_bytes(tmp_path):
    given = truth()
    for name in ("a.mcap", "b.mcap"):
        write_truth(tmp_path / name, given)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    read = read_truth(tmp_path / "a.mcap")
    for name in ("rest", "faces", "attached"):
        np.testing.assert_array_equal(getattr(read, name), getattr(given, name))
        assert getattr(read, name).dtype == getattr(given, name).dtype
    assert read.scene == "arc" and read.details == json.loads(json.dumps(given.details))
    for actual, expected in zip(read.frames, given.frames, strict=True):
        for f in fields(TruthFrame):
            np.testing.assert_array_equal(getattr(actual, f.name), getattr(expected, f.name))


def test_a_crash_leaves_the_truth_so_far(tmp_path):
    given, crashed = truth(), tmp_path / "crashed.mcap"
    named = {name: getattr(given, name) for name in ("rest", "faces", "attached", "scene", "details")}
    with TruthWriter(tmp_path / "run.truth.mcap", **named) as writer:
        writer.write(given.frames[0])
        crashed.write_bytes((tmp_path / "run.truth.mcap.part").read_bytes())
    with pytest.raises(RecordingError, match="truncated"):
        read_truth(crashed)
    assert len(read_truth(crashed, allow_truncated=True).frames) == 1


def test_observations_are_no_truth(tmp_path):
    path = write(tmp_path / "run.mcap", observations(1))
    with pytest.raises(RecordingError, match="is not a truth file"):
        read_truth(path)
