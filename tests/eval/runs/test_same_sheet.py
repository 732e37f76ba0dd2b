"""Whether rest shapes are those of one sheet: the distance by hand, other meshes, and what is refused."""

import numpy as np
import pytest

import jiggle_mj as jm
from jiggle_mj.eval.runs.same_sheet import largest_distance, refuse_other_shapes
from tests.support.small_sheet import equilateral, jittered

SIDE = 0.1
"""Side of a square sheet [m]."""


def square(n: int, side: float = SIDE) -> np.ndarray:
    """Return a grid of n by n points."""
    x, y = np.meshgrid(*[np.linspace(0, side, n)] * 2)
    return np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)


def turned(points: np.ndarray, degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def test_the_distance_is_that_of_the_corners_once_the_middles_are_on_each_other():
    """Two squares about one middle: it is half the difference of the diagonals."""
    larger = square(11, 1.2 * SIDE) + np.array([0.3, -0.2, 0.01])
    assert largest_distance(square(11), larger) == pytest.approx(0.1 * SIDE * 2**0.5)
    assert largest_distance(square(11), larger) == largest_distance(larger, square(11))


def test_other_meshes_and_places_of_one_sheet_are_taken():
    mesh = equilateral(12, 12)
    refuse_other_shapes({"a": mesh.rest, "b": jittered(mesh, 0.3, seed=1).rest + np.array([0.0, 0.2, 0.005])})
    refuse_other_shapes({"a": square(12), "b": square(15), "c": turned(square(12), 5)})


@pytest.mark.parametrize("other", [square(11, 1.15 * SIDE), turned(square(11), 14), square(11)[:60]])
def test_another_size_pose_or_part_is_refused_with_what_was_given_and_allowed(other):
    with pytest.raises(
        jm.OptionError, match=r"a and c do not show one sheet .* mm apart.* 9\.9 mm are allowed.*--joint"
    ):
        refuse_other_shapes({"a": square(11), "b": square(11), "c": other})
