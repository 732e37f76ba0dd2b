"""The tool's reports between frames: periodic, with times of their own, and as late as the pose in the frames."""

from itertools import pairwise

import numpy as np

from jiggle_mj.observation import Observation
from jiggle_mj.scenes import Reference, load_scene, programme
from jiggle_mj.scenes.disturbances.registry import disturbed
from jiggle_mj.scenes.sensing.observer import REPORT_PERIOD

LATENCY = 0.2
"""Delay of the late tool [s]."""


def test_reports_are_periodic_and_as_late_as_the_tool():
    """A late report holds the position of a latency before; it is compared where that lies within the first grasp."""
    scene = load_scene("line")
    prompt, late = observed(scene), observed(disturbed(scene, [f"tool_latency={LATENCY}"]))
    for observations in (prompt, late):
        times = np.array([report.time for observation in observations for report in observation.reports])
        assert np.diff(times).min() >= REPORT_PERIOD * 1e9 - 1
        for previous, current in pairwise(observations):
            assert all(previous.time < report.time < current.time for report in current.reports)
    true = {report.time: report.position for observation in prompt for report in observation.reports}
    true |= {observation.time: observation.tool.position for observation in prompt}
    grasp = [observation for observation in late if observation.tool.closed and observation.tool.grasp == 1]
    compared = [
        (report.position, true[report.time - round(1e9 * LATENCY)])
        for observation in grasp
        for report in observation.reports
        if report.time - round(1e9 * LATENCY) in true and report.time - 1e9 * LATENCY > grasp[0].time
    ]
    reported, expected = (np.array(column) for column in zip(*compared, strict=True))
    assert len(reported) > 3 and np.ptp(reported[:, 2]) > 5e-3  # over a part of the lift of 42 mm
    np.testing.assert_allclose(reported, expected, atol=1e-12)  # rounding


def observed(scene) -> list[Observation]:
    with Reference(scene, seed=0, sensing="particles") as reference:
        return [reference.step(action) for action, _ in zip(programme(scene), range(30), strict=False)]
