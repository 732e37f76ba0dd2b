"""Wrong types, shapes and numbers are refused by name, without the shape checks that the tests alone have."""

import json
import subprocess
import sys

import numpy as np
import pytest

from jiggle_mj.argument_checks import as_array, as_integer, as_number, quoted
from jiggle_mj.errors import MAX_SHOWN, ObservationError, OptionError
from jiggle_mj.likely_name import did_you_mean
from jiggle_mj.observation import MeasuredPoints
from tests.support.sources import ROOT

LEAST = 300
"""Number of wrong uses that `tests.support.wrong_uses` tries at least, so that an empty list is no success."""


@pytest.fixture(scope="module")
def outcomes() -> list[list[str]]:
    """Name, outcome and message of each wrong use, as users meet them: in an interpreter of its own."""
    command = [sys.executable, "-m", "tests.support.wrong_uses"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_every_wrong_use_is_refused_by_an_error_of_the_project(outcomes: list[list[str]]):
    assert len(outcomes) >= LEAST
    assert [entry for entry in outcomes if entry[1] != "refused"] == []


def test_every_refusal_is_one_short_line(outcomes: list[list[str]]):
    """Twice the longest quote leaves room for what is allowed; a list of all scenes or disturbances takes more."""
    for name, _, message in outcomes:
        assert message and "\n" not in message, name
        assert len(message) <= 2 * MAX_SHOWN or "There are" in message or "Shipped scenes" in message, (
            name,
            message,
        )


def test_lists_and_whole_numbers_stand_for_arrays_of_numbers():
    positions = as_array([[0, 0, 1], [1, 2, 3]], "positions", (None, 3))
    assert positions.dtype == float and as_array([], "ids", (0,), kind="whole numbers").dtype == np.int64
    np.testing.assert_array_equal(positions, [[0.0, 0.0, 1.0], [1.0, 2.0, 3.0]])


def test_unsigned_whole_numbers_become_signed():
    """A difference of unsigned numbers is never below 0."""
    assert as_array(np.array([1, 2], np.uint8), "ids", (2,), kind="whole numbers").dtype == np.int64


def test_an_array_that_is_right_is_not_copied():
    right = np.zeros((5, 3), np.float32)
    assert as_array(right, "x", (None, 3)) is right


def test_a_point_that_is_not_used_may_stand_several_times_and_a_named_one_once():
    MeasuredPoints(positions=np.zeros((3, 3)), track_id=np.array([-1, 4, -1]))
    with pytest.raises(ObservationError, match="names point 4 twice"):
        MeasuredPoints(positions=np.zeros((3, 3)), track_id=np.array([4, 1, 4]))


def test_numbers_of_numpy_are_numbers_and_booleans_are_none():
    assert as_integer(np.int32(3), "seed") == 3 and as_number(np.float32(0.5), "radius") == 0.5
    for check in (as_integer, as_number):
        with pytest.raises(OptionError, match=r"x.* must be"):
            check(True, "x")


def test_a_long_value_is_quoted_in_part():
    assert len(quoted("a" * 10_000)) == MAX_SHOWN
    assert quoted(np.zeros((480, 640))) == "an array of float64 (480, 640)"


@pytest.mark.parametrize(
    ("name", "hint"), [("ark", "; did you mean 'arc'?"), ("ARC", "; did you mean 'arc'?"), ("xyz", "."), (3, ".")]
)
def test_the_likely_name_is_proposed(name: object, hint: str):
    assert did_you_mean(name, ("arc", "line", "free")) == hint
