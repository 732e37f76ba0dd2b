"""Doubts about the force on the tool that need no model of the sheet: its frame, its size, and the sign of its work.

What a tool does to tissue at rest costs work. Where the force that the tool exerts works against its own motion over
whole grasps, the sign is that of the other body. Which axes it has, the estimator finds by the shape of the sheet.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from ..observation import MeasuredForce, ToolState
from ..recording.reader import Recording
from .problem import RecordingProblem, warning

DOUBTED_FORCE_N = 50.0
"""Largest change of the force on the tool that is no doubt [N]: tissue tears at less, and mN called N are beyond it."""
GAINED_SHARE = 0.5
"""Share of the work, counted without its sign, that the tool may gain from the tissue [1]; noise gains 0 on average."""


def force_problems(
    recording: Recording, frames: Sequence[tuple[ToolState, MeasuredForce | None]]
) -> Iterator[RecordingProblem]:
    """Find a force in an unknown frame, of an unlikely size, or of the opposite sign.

    Args:
        recording: an open recording.
        frames: the tool in each frame, with the force on it where there is one, in order.
    """
    if recording.why_no_force is not None:
        yield warning(
            "force-frame",
            f"the force on the tool is not used: {recording.why_no_force} Give it in the world, in a frame that /tf "
            "joins to it, or in the frame '/tool/pose', the axes of the tool.",
        )
    offset, start, grasp = np.zeros(3), np.zeros(3), None
    work, unsigned, largest = 0.0, 0.0, 0.0
    for tool, force in frames:
        if tool.closed and tool.grasp != grasp:
            start, grasp = tool.position, tool.grasp
        if force is None:
            continue
        if not tool.closed:
            offset = force.on_tool
            continue
        pull = offset - force.on_tool
        largest, done = max(largest, float(np.abs(pull).max())), float(pull @ (tool.position - start))
        work, unsigned = work + done, unsigned + abs(done)
    if largest > DOUBTED_FORCE_N:
        yield warning("force-size", f"the force on the tool changes by up to {largest:.3g} N; is it in N, not in mN?")
    elif work < -GAINED_SHARE * unsigned:
        yield warning(
            "force-sign",
            "the force pulls the tool the way in which it moves; is it the force of the tissue on the tool, not that "
            "of the tool on the tissue?",
        )
