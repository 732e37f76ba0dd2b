"""What the tool says between frames: often, of its own clock, and as late as in the frames themselves."""

from itertools import pairwise

import numpy as np

from jiggle_mj.observation import Observation
from jiggle_mj.scenes import Reference, load_scene, programme
from jiggle_mj.scenes.disturbances.registry import disturbed
from jiggle_mj.scenes.sensing.observer import REPORTED

LATE = 0.2


def test_reports_come_as_often_as_is_said_and_late_where_the_tool_is():
    scene = load_scene("line")
    prompt, late = seen(scene), seen(disturbed(scene, [f"tool_latency={LATE}"]))
    for observations in (prompt, late):
        times = np.array([report.time for one in observations for report in one.reports])
        assert np.diff(times).min() >= REPORTED * 1e9 - 1
        for before, one in pairwise(observations):
            assert all(before.time < report.time < one.time for report in one.reports)
    was = {report.time: report.position for one in prompt for report in one.reports}
    was |= {one.time: one.tool.position for one in prompt}
    grasp = [one for one in late if one.tool.closed and one.tool.grasp == 1]
    compared = [
        (report.position, was[report.time - round(1e9 * LATE)])
        for one in grasp
        for report in one.reports
        if report.time - round(1e9 * LATE) in was and report.time - 1e9 * LATE > grasp[0].time
    ]
    told, then = (np.array(part) for part in zip(*compared, strict=True))
    assert len(told) > 3 and np.ptp(told[:, 2]) > 5e-3
    np.testing.assert_allclose(told, then, atol=1e-12)


def seen(scene) -> list[Observation]:
    with Reference(scene, seed=0, sensing="particles") as reference:
        return [reference.step(action) for action, _ in zip(programme(scene), range(30), strict=False)]
