"""Checks that the points named as held are those that the tool holds, before a recording exists.

A tool far from its points has another unit, frame or clock; points that stand still while the tool moves belong to
another grasp.
"""

import numpy as np
from jaxtyping import Float

from ..errors import RecordingError
from ..plausibility.increments import follow_in_sum
from .clock import FrameClock
from .grasps import GraspSpan
from .recording_toml import MeasuredRecording
from .reports import Reports
from .units import LENGTH_UNITS, PREFERRED_UNITS

MIN_MOTION = 5e-3
"""Displacement of the tool from which its points must follow [m]: well above the noise and drift of trackers (1 to 4
mm in measured data)."""
MOTION_NOISE = 20
"""The same as a multiple of the declared noise."""
STILL_SHARE = 0.2
"""Share of the leading displacement below which a point stands still: grasped skin and cloth follow by 0.4 to 1."""
STILL_REFUSED = 0.5
"""Share of the held points that stand still from which they are refused: with fewer, some slip or are lost; half are
those of another corner."""
N_LEADERS = 4
"""Points that must move alike to lead: fewer are a tracker's jumps."""


def refuse_wrong_grasps(
    given: MeasuredRecording,
    frames: Float[np.ndarray, "t n 3"],
    grasps: tuple[GraspSpan, ...],
    reports: Reports | None,
    clock: FrameClock,
) -> None:
    """Refuse a tool that is far from its points, and held points that stand still.

    Args:
        given: contents of the recording.toml.
        frames: positions of the points in the world [m], the rest frame first.
        grasps: the grasps.
        reports: reports of the instrument; None without one.
        clock: times of the frames.

    Raises:
        RecordingError: a tool is farther from the nearest held point than the sheet is large, or half
            of the held points stand still while the tool, or the rest of them, moves by centimetres.
    """
    for grasp in grasps:
        if not len(grasp.held) or grasp.closing is None:
            continue
        if reports is not None:
            _refuse_far(given, frames, grasp, reports, clock)
        _refuse_still(given, frames, grasp, reports, clock, len(grasps) > 1)


def _refuse_far(
    given: MeasuredRecording,
    frames: Float[np.ndarray, "t n 3"],
    grasp: GraspSpan,
    reports: Reports,
    clock: FrameClock,
) -> None:
    assert grasp.closing is not None
    places = frames[grasp.closing][grasp.held]
    places = places[np.isfinite(places).all(axis=1)]
    extent = float(np.ptp(frames[0][np.isfinite(frames[0]).all(axis=1)], axis=0).max())
    if not len(places):
        return
    tip = reports.at(clock.times[grasp.closing])[0]
    distance = float(np.linalg.norm(places - tip, axis=1).min())
    if distance <= extent:
        return
    tool, frame = given.grasp.tool, given.frame
    stated = given.unit if tool is None or tool.unit is None else tool.unit
    raw = (tip - frame.translation) / stated
    likely = next(
        (
            name
            for name in PREFERRED_UNITS
            if np.linalg.norm(places - (raw * LENGTH_UNITS[name] + frame.translation), axis=1).min() <= extent
        ),
        None,
    )
    cure = "" if likely is None else f'give tool_unit = "{likely}", or '
    raise RecordingError(
        f"{grasp.what}: the tool is {distance:.4g} m from the nearest held point when the jaws close, and the sheet "
        f"is {extent:.3g} m large: {cure}transform the tool into the frame of the points."
    )


def _refuse_still(
    given: MeasuredRecording,
    frames: Float[np.ndarray, "t n 3"],
    grasp: GraspSpan,
    reports: Reports | None,
    clock: FrameClock,
    several: bool,
) -> None:
    assert grasp.closing is not None
    closed = range(grasp.closing, grasp.frames[1])
    moved = frames[grasp.closing : grasp.frames[1]] - frames[grasp.closing]
    least = max(MIN_MOTION, MOTION_NOISE * given.noise_sd)
    if reports is not None:
        tips = np.stack([reports.at(clock.times[k])[0] for k in closed])
        leading, leader = tips - tips[0], "the tool"
    else:
        leading, leader = _leading(moved), "the points that move most"
    far = np.linalg.norm(leading, axis=1)
    at = int(np.argmax(far))
    if far[at] < least:
        return
    share = moved[at][grasp.held] @ leading[at] / far[at] ** 2
    share = share[np.isfinite(share)]
    still = int((share < STILL_SHARE).sum())
    if not len(share) or still < STILL_REFUSED * len(share):
        return
    if follow_in_sum(moved[:, grasp.held].mean(axis=1), leading):
        raise RecordingError(
            f"{grasp.what}: the held points do not follow {leader}, and the sum of their displacements over the frames "
            "does: give displacements from the rest frame, not from the frame before."
        )
    cure = (
        "give each pull its own [[grasp]] with its rows, or at and radius, and run, begin and end, or frames"
        if len(set(clock.runs)) > 1 or several
        else "check rows, after and the tool's clock; where there are several pulls, give each its own [[grasp]]"
    )
    raise RecordingError(
        f"{grasp.what}: {still} of {len(share)} held points stand still while {leader} moves "
        f"{far[at] * 1e3:.3g} mm, so they are not what it holds: {cure}."
    )


def _leading(moved: Float[np.ndarray, "t n 3"]) -> Float[np.ndarray, "t 3"]:
    """Return the mean displacement of the points that move most in each frame [m]."""
    length = np.nan_to_num(np.linalg.norm(moved, axis=2))
    most = np.argsort(length, axis=1)[:, -N_LEADERS:]
    return np.nan_to_num(np.take_along_axis(moved, most[:, :, np.newaxis], axis=1)).mean(axis=1)
