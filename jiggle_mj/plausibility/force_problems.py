"""Doubts about the force on the tool that need no model of the sheet: its frame, its size, and the sign of its work.

What a tool does to tissue at rest costs work. Where the force that the tool exerts works against its own motion over
whole grasps, the sign is that of the other body. Which axes it has, the estimator finds by the shape of the sheet.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from ..force_scatter import ForceScatter
from ..observation import MeasuredForce, ToolState
from ..recording.reader import Recording
from .problem import RecordingProblem, warning
from .tool_problems import NOISE_MULTIPLES

DOUBTED_FORCE_N = 50.0
"""Largest change of the force on the tool that is no doubt [N]: tissue tears at less, and mN called N are beyond it."""
MIN_FRAMES = 5
"""Frames with a force from which a direction in which it never changes is doubted: three numbers of noise change."""
SAME = 1e-9
"""Share of the largest change of a force below which it does not change along a direction [1]: rounding."""
GAINED_SHARE = 0.5
"""Share of the work, counted without its sign, that the tool may gain from the tissue [1]; noise gains 0 on average."""


def force_problems(
    recording: Recording, frames: Sequence[tuple[ToolState, MeasuredForce | None]]
) -> Iterator[RecordingProblem]:
    """Find a force in an unknown frame, of an unlikely size, of the opposite sign, of other noise, or that lacks axes.

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
    yield from _not_finite(*recording.lost_forces)
    yield from _noise(frames)
    yield from _missing_axes([force.on_tool for _, force in frames if force is not None])
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


def _missing_axes(forces: Sequence[Float[np.ndarray, " 3"]]) -> Iterator[RecordingProblem]:
    """Find a force that never changes along one direction or more, as that of a sensor of one axis, or of one off."""
    if len(forces) < MIN_FRAMES:
        return
    changes = np.linalg.svd(np.array(forces) - np.mean(forces, axis=0), compute_uv=False)
    n_seen = int(np.sum(changes > SAME * max(changes[0], float(np.abs(forces).max()))))
    if n_seen == 0:
        yield warning("force-axes", "the force on the tool is the same in all frames; is the sensor on?")
    elif n_seen < 3:
        yield warning(
            "force-axes",
            f"the force on the tool changes along {n_seen} of three axes only, and counts as measured in all: record "
            "all components, or leave the force out.",
        )


def _not_finite(n_lost: int, n_forces: int) -> Iterator[RecordingProblem]:
    """Find forces that are no numbers: some are lost readings, and all are no measurement."""
    if not n_lost:
        return
    if n_lost == n_forces:
        yield RecordingProblem(
            name="force-missing",
            refuses=True,
            text=f"none of the {n_forces} forces on the tool is three finite numbers; record what the sensor measures, "
            "or leave /tool/force out.",
        )
        return
    yield warning(
        "force-missing",
        f"{n_lost} of {n_forces} forces on the tool are not three finite numbers; they count as not measured.",
    )


def _noise(frames: Sequence[tuple[ToolState, MeasuredForce | None]]) -> Iterator[RecordingProblem]:
    """Find a stated noise that the scatter with open jaws contradicts."""
    scatter, stated = ForceScatter(), list[float]()
    for tool, force in frames:
        if tool.closed:
            scatter.close()
        elif force is not None:
            scatter.add(force.on_tool)
        if force is not None and force.sd is not None:
            stated.append(force.sd)
    scatter.close()
    measured, sd = scatter.sd, float(np.median(stated)) if stated else None
    if measured is None or sd is None:
        return
    shown = f"the noise of the force is stated as {sd:.2g} N, and with open jaws it is {measured:.2g} N"
    if scatter.exceeds(sd):
        yield warning(
            "force-noise", f"{shown}; the larger one counts. Is sd in N, and does the tool hang still while it is open?"
        )
    elif sd > NOISE_MULTIPLES * measured:
        yield warning("force-noise", f"{shown}; unless it is larger while the jaws are closed, a smaller sd says more.")
