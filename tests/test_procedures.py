"""Where a procedure cuts and sews: tours by hand, and the free stretch of a sheet with one attached line."""

import numpy as np
from jiggle_mj.estimator.policies.procedures import free_stretch, tour
from small_sheet import sheet

LENGTH, WIDTH = 0.02, 7e-3


def test_a_tour_goes_from_neighbour_to_neighbour():
    points = np.array([[0.0, 0], [3, 0], [1, 0], [2, 0]])
    assert tour(points).tolist() == [[0, 0], [1, 0], [2, 0], [3, 0]]
    assert tour(points[:1]).tolist() == [[0, 0]]


def stretch(probability):
    return free_stretch(sheet().rest[:, :2], probability, sheet().border, length=LENGTH, width=WIDTH)


def test_the_surest_free_stretch_lies_where_nothing_is_attached():
    flat = sheet().rest[:, :2]
    probability = np.where(flat[:, 1] > -5e-3, 0.9, 0.01)
    path = stretch(probability)
    assert path is not None and path[:, 1].max() < -5e-3
    np.testing.assert_allclose(np.linalg.norm(path[1] - path[0]), LENGTH)


def test_where_nothing_is_known_to_be_free_there_is_none():
    assert stretch(np.full(sheet().n, 0.3)) is None
    assert stretch(np.full(sheet().n, 0.0)) is not None
