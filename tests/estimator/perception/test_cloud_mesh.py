"""The mesh over clouds at rest: its size and heights, without what lies alone, and what is no sheet."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from jiggle_mj.errors import PerceptionError
from jiggle_mj.estimator.perception.cloud_mesh import lay_mesh, thinned
from jiggle_mj.estimator.perception.config import CloudTrackerConfig
from jiggle_mj.estimator.physics.mesh import SheetMesh
from jiggle_mj.observation import MeasuredPoints
from tests.support.small_sheet import SPACING, cloud, sheet

SD = 2e-4
"""Noise of a point [m]."""


def measured(x: np.ndarray, seed: int) -> MeasuredPoints:
    return MeasuredPoints(positions=cloud(x, seed, SD), sd=SD)


def test_a_mesh_over_clouds_at_rest():
    """Neighbours are 0.75 to 1 spacings apart, heights a quarter of a point's noise off, the outline 7 % inside."""
    still = [measured(sheet().rest, seed) for seed in range(3)]
    laid = lay_mesh(still, spacing=SPACING)
    gaps = cdist(laid.rest, laid.rest) + np.eye(len(laid.rest))
    nearest_gap = gaps.min(axis=1).mean() / SPACING
    assert CloudTrackerConfig.min_gap < nearest_gap < 1
    assert np.abs(laid.rest[:, 2]).max() < 0.5 * SD
    assert 0.9 < SheetMesh(laid.rest, laid.faces).face_area.sum() / sheet().face_area.sum() < 1


def test_thinning_keeps_points_apart_and_leaves_no_hole():
    flat = np.random.default_rng(0).uniform(0, 1, (2000, 2))
    chosen = flat[thinned(flat, 0.1)]
    gaps = cdist(chosen, chosen) + np.eye(len(chosen))
    assert gaps.min() > 0.1 and cdist(flat, chosen).min(axis=1).max() <= 0.1


def test_too_few_points_are_refused():
    with pytest.raises(PerceptionError, match=r"a sheet needs 20 \(record more points, or choose a smaller"):
        lay_mesh([measured(sheet().rest, 0)], spacing=0.05)
    nothing = MeasuredPoints(positions=np.full((100, 3), np.nan), sd=SD)
    with pytest.raises(PerceptionError, match="have 0 points at most; a sheet needs 20"):
        lay_mesh([nothing], spacing=SPACING)
    rest = [nothing, measured(sheet().rest, 0)]
    np.testing.assert_array_equal(lay_mesh(rest, spacing=SPACING).rest, lay_mesh(rest[1:], spacing=SPACING).rest)


def test_points_beside_and_above_the_sheet_are_no_part_of_it():
    """One in ten of the points lies anywhere in a box three times as wide; those within 1.5 mm of the rim may stay."""
    rng = np.random.default_rng(0)
    clean = [measured(sheet().rest, seed) for seed in range(3)]
    box = 3 * np.ptp(sheet().rest, axis=0) + np.array([0, 0, 0.04])
    still = []
    for points in clean:
        alone = rng.uniform(-box / 2, box / 2, (len(points.positions) // 10, 3))
        still.append(MeasuredPoints(positions=np.concatenate([points.positions, alone]), sd=SD))
    laid, expected = lay_mesh(still, spacing=SPACING), lay_mesh(clean, spacing=SPACING)
    beyond = np.abs(laid.rest[:, :2]) - np.abs(sheet().rest[:, :2]).max(axis=0)
    assert beyond.max() < 1.5e-3 and np.abs(laid.rest[:, 2]).max() < SD
    area = [SheetMesh(mesh.rest, mesh.faces).face_area.sum() for mesh in (laid, expected)]
    assert area[0] == pytest.approx(area[1], rel=0.1)


def test_points_along_a_line_are_no_sheet():
    line = np.zeros((300, 3))
    line[:, 0] = np.linspace(-0.02, 0.02, 300)
    with pytest.raises(PerceptionError, match=r"at rest are about 40.2 by 0.0 mm; a sheet is wider than half"):
        lay_mesh([MeasuredPoints(positions=line, sd=SD)], spacing=SPACING)
