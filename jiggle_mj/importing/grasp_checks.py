"""Checks that the points named as held are those that the tool holds, before a recording exists.

A tool far from its points has another unit, frame or clock; points that stand still while the tool moves belong to
another grasp.
"""

import numpy as np
from jaxtyping import Float

from ..errors import RecordingError
from ..plausibility.held_motion import leading_motion
from ..plausibility.increments import follow_in_sum, no_slip
from ..plausibility.problems import FARTHEST_EXTENTS
from .clock import FrameClock
from .grasps import GraspSpan
from .recording_toml import MeasuredRecording
from .reports import Reports
from .units import LENGTH_UNITS

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
NEAR_SHARE = 0.5
"""Distance of the tool from its points at which a unit is offered [extent of the sheet], and difference of their
motions [that of the points]: in a far too small unit the tool stays at the origin, and a late one does not follow."""
REFUSED_UNITS = {"inches": 0.0254, "decimetres": 0.1}
"""Metres in further units that a tool may report in; they must be converted."""


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
        RecordingError: a tool is farther from the nearest held point than three extents of the sheet, or half
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
    if distance <= FARTHEST_EXTENTS * extent:
        return
    tool, frame = given.grasp.tool, given.frame
    stated = given.unit if tool is None or tool.unit is None else tool.unit
    closed = range(grasp.closing, grasp.frames[1])
    raw = (np.stack([reports.at(clock.times[k])[0] for k in closed]) - frame.translation) / stated
    held = frames[grasp.closing : grasp.frames[1]][:, grasp.held]
    # Over the whole grasp: near the origin every small unit is near when the jaws close.
    away = {
        name: float(np.nanmax(np.linalg.norm(held - (raw * factor + frame.translation)[:, np.newaxis], axis=2)))
        for name, factor in (LENGTH_UNITS | REFUSED_UNITS).items()
    }
    likely = min(away, key=away.__getitem__)
    middle, tips = np.nanmean(held, axis=1), raw * (LENGTH_UNITS | REFUSED_UNITS)[likely]
    moved, apart = (float(np.nanmax(np.linalg.norm(each - each[0], axis=1))) for each in (middle, middle - tips))
    cure = (
        ""
        if away[likely] > NEAR_SHARE * extent or apart > NEAR_SHARE * moved
        else f"{_unit_cure(likely)}, and it stays within {away[likely]:.3g} m; or "
    )
    raise RecordingError(
        f"{grasp.what}: the tool is {distance:.4g} m from the nearest held point when the jaws close, and the sheet "
        f"is {extent:.3g} m large: {cure}transform the tool into the frame of the points."
    )


def _unit_cure(unit: str) -> str:
    """Return what to do about a tool that reports in a unit."""
    return f'give tool_unit = "{unit}"' if unit in LENGTH_UNITS else f"convert its positions from {unit} to m"


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
    leaders = {"the points that move most": leading_motion(moved)}
    if reports is not None:
        tips = np.stack([reports.at(clock.times[k])[0] for k in closed])
        leaders["the tool"] = tips - tips[0]
    leaders = {name: leading for name, leading in leaders.items() if np.linalg.norm(leading, axis=1).max() >= least}
    # Points that follow one of them are held: where the other differs, the tool's unit, frame or clock is wrong.
    shares = [_shares(moved[:, grasp.held], leading) for leading in leaders.values()]
    if not shares:
        return
    share = np.max(shares, axis=0)
    share = share[np.isfinite(share)]
    still = int((share < STILL_SHARE).sum())
    if not len(share) or still < STILL_REFUSED * len(share):
        return
    leader, leading = list(leaders.items())[-1]
    far = float(np.linalg.norm(leading, axis=1).max())
    throughout = moved[:, grasp.held[np.isfinite(moved[:, grasp.held]).all(axis=(0, 2))]]
    summed = bool(throughout.shape[1]) and follow_in_sum(throughout.mean(axis=1), leading)
    if summed and no_slip(throughout.mean(axis=1), leading):
        raise RecordingError(
            f"{grasp.what}: the held points do not follow {leader}, and the sum of their displacements over the frames "
            "does: give displacements from the rest frame, not from the frame before."
        )
    cure = (
        "give each pull its own [[grasp]] with its rows, or at and radius, and run, begin and end, or frames"
        if len(set(clock.runs)) > 1 or several
        else "check rows or radius, after and the tool's clock; of several pulls, give each its own [[grasp]]"
    )
    raise RecordingError(
        f"{grasp.what}: {still} of {len(share)} held points stand still while {leader} went "
        f"{far * 1e3:.3g} mm, so they are not what it holds: {cure}{_INCREMENTS if summed else ''}."
    )


_INCREMENTS = "; or, where these are displacements, give those from the rest frame, not from the frame before"


def _shares(moved: Float[np.ndarray, "t h 3"], leading: Float[np.ndarray, "t 3"]) -> Float[np.ndarray, " h"]:
    """Return which share of the leading displacement each point has, where that is largest."""
    far = np.linalg.norm(leading, axis=1)
    at = int(np.argmax(far))
    return moved[at] @ leading[at] / far[at] ** 2
