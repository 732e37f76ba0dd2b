"""A good mesh passes the checks, and each fault is named."""

import numpy as np
import pytest

from jiggle_mj.errors import MeshError
from jiggle_mj.mesh_checks import check_mesh
from tests.support.measured_folder import GRID_FACES, grid


def test_a_good_mesh_passes_and_each_fault_is_named():
    good = grid() * 1e-3
    check_mesh(good, np.array(GRID_FACES))
    cases = [
        (good, np.empty((0, 3), int), "no triangles"),
        (good, np.array([[0, 1]]), r"shape \(f, 3\)"),
        (good, np.array([[0.0, 1, 4]]), "integers"),
        (good[:, :2], np.array([[0, 1, 4]]), r"shape \(n, 3\)"),
        (np.where(np.arange(12)[:, None] == 3, np.nan, good), np.array(GRID_FACES), "vertex 3 is not finite"),
        (good, np.array([*GRID_FACES, [1, 4, 10]]), "belongs to 3 triangles"),
        (good[:6], np.array([[0, 1, 4]]), "vertex 2 belongs to no triangle"),
        (good, np.array([[0, 1, -1]]), "must lie in"),
    ]
    for vertices, faces, message in cases:
        with pytest.raises(MeshError, match=message):
            check_mesh(vertices, faces)
