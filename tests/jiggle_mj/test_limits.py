"""Limits: refused where no pull would be possible, and the same in a scene as in the vocabulary."""

import pytest

from jiggle_mj.limits import Limits
from jiggle_mj.scenes import Scene


def test_a_scenes_limits_are_the_vocabularys():
    assert Scene(name="any").limits.limits() == Limits()


@pytest.mark.parametrize("name", ["energy", "force", "chance", "unknown", "ceiling", "beside"])
def test_a_limit_of_zero_is_refused(name):
    with pytest.raises(ValueError, match=rf"Limits.{name} must be above 0.*got 0.0"):
        Limits(**{name: 0.0})


def test_a_chance_of_a_half_is_no_limit():
    with pytest.raises(ValueError, match=r"below 0\.5"):
        Limits(chance=0.5)
