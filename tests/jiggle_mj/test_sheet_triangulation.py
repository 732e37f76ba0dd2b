"""Stations along a sheet, and its continuation beyond the measured points."""

import numpy as np
import pytest

from jiggle_mj.errors import MeshError
from jiggle_mj.sheet_triangulation import SheetPlane, extend, triangulate
from tests.support.measured_folder import GRID_FACES, grid

ORTHONORMAL = 1e-14
"""Absolute tolerance of R R^T = 1: roundings of numbers near 1."""
ASIDE = 1e-9
"""Distance from the limit at which points are tested, far above its rounding."""


def test_stations_are_world_coordinates_on_the_centre_line():
    """On p = c + s a the station is p_k for the largest |a_k|, so along(p_k) = s."""
    axis = np.array([-0.3, 0.9, 0.1]) / np.linalg.norm([-0.3, 0.9, 0.1])
    points = np.random.default_rng(0).normal(size=(30, 3)) * [1, 4, 0.1]
    plane = SheetPlane.through(points, axis)
    on_line = plane.centre + 0.7 * axis
    assert plane.along(on_line[1]) == pytest.approx(0.7)
    np.testing.assert_allclose(plane.axes @ plane.axes.T, np.eye(3), atol=ORTHONORMAL)
    assert plane.beyond(on_line[None] + ASIDE * axis, on_line[1]).all()
    assert not plane.beyond(on_line[None] - ASIDE * axis, on_line[1]).any()


def test_extension_on_one_side_leaves_the_other_alone():
    flat = grid()[:, :2]
    added = extend(flat, begin=-6.0, end=3.0, spacing=2.0)
    assert added[:, 0].max() < 0 and added[:, 0].min() == -6
    assert len(triangulate(np.concatenate([flat, added]), 5.0)) > len(GRID_FACES)


@pytest.mark.parametrize("spacing", [1e-5, 1e-300])
def test_an_extension_of_too_many_vertices_is_refused_before_it_is_made(spacing):
    with pytest.raises(MeshError, match="at most 20000 are allowed: give a larger spacing"):
        extend(grid()[:, :2], begin=-6.0, end=3.0, spacing=spacing)


@pytest.mark.parametrize("flat", [np.zeros((2, 2)), np.arange(10.0)[:, None] * [1.0, 2.0], np.zeros((5, 2))])
def test_points_on_a_line_make_no_sheet(flat):
    with pytest.raises(MeshError, match="make no sheet"):
        triangulate(flat, 1.0)
