"""Clouds without identities go along with the tool, or are doubted."""

import numpy as np
import pytest

from jiggle_mj.observation import IDENTITY_WXYZ, MeasuredPoints, Observation, ToolState
from jiggle_mj.plausibility.cloud_motion import CloudMotion

RADIUS = 5e-3
"""Radius of the grip [m]."""


def sheet(lift: float) -> np.ndarray:
    """Return a sheet of 60 mm whose middle is lifted [m]."""
    x, y = (each.ravel() for each in np.meshgrid(*2 * [np.linspace(-0.03, 0.03, 25)]))
    return np.column_stack([x, y, lift * np.exp(-(x**2 + y**2) / 2e-4)])


def names(clouds: list[np.ndarray], *, lift: float = 0.02, grasps: int = 2, track_id: np.ndarray | None = None):
    """Return the doubts about clouds while the tool lifts in steps, the same in each grasp."""
    motion = CloudMotion()
    for grasp in range(1, grasps + 1):
        for index, cloud in enumerate(clouds):
            at = np.array([0.0, 0.0, lift * index / max(len(clouds) - 1, 1)])
            tool = ToolState(position=at, quat_wxyz=IDENTITY_WXYZ, closed=True, grasp=grasp, radius=RADIUS)
            points = MeasuredPoints(positions=cloud, track_id=track_id)
            motion.add(Observation(index=index, time=index, tool=tool, points=points))
    return [problem.name for problem in motion.problems()]


LIFTS = np.linspace(0, 0.02, 5)


def hidden(cloud: np.ndarray) -> np.ndarray:
    """Return what a tool of 10 mm radius leaves to be seen."""
    return cloud[np.hypot(cloud[:, 0], cloud[:, 1]) > 0.01]


@pytest.mark.parametrize(
    ("clouds", "doubted"),
    [
        ([sheet(lift) for lift in LIFTS], False),
        ([hidden(sheet(lift)) for lift in LIFTS], False),
        ([sheet(0.0) for _ in LIFTS], True),
        ([sheet(0.0) * [1, 1, np.nan if k == 2 else 1] for k in range(5)], True),
        ([sheet(0.0)], False),
    ],
    ids=["follows", "hidden-at-the-tip", "bed", "bed-with-an-unseen-frame", "one-frame"],
)
def test_a_cloud_that_the_tool_leaves_is_doubted(clouds, doubted):
    assert names(clouds) == (["cloud-still"] if doubted else [])


def test_a_short_pull_and_points_with_identities_say_nothing():
    still = [sheet(0.0) for _ in LIFTS]
    assert names(still, lift=1.9 * RADIUS) == []
    assert names(still, track_id=np.arange(len(still[0]))) == []


def test_one_grasp_that_follows_is_enough():
    motion = CloudMotion()
    for grasp, rises in ((1, False), (2, True)):
        for lift in LIFTS:
            at = np.array([0, 0, lift])
            tool = ToolState(position=at, quat_wxyz=IDENTITY_WXYZ, closed=True, grasp=grasp, radius=RADIUS)
            points = MeasuredPoints(positions=sheet(lift if rises else 0.0))
            motion.add(Observation(index=0, time=0, tool=tool, points=points))
    assert list(motion.problems()) == []
