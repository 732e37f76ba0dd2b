"""What is wrong with the tool's frame, unit, clock or gripper, by its motion and that of the points that it holds.

docs/RECORDINGS.md has the names as a table.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from .held_motion import HeldMotion
from .problem import RecordingProblem, metres
from .tool_fits import APART, LEAST_FRAMES, ClockFit, FrameFit, clock_fit, frame_fit

NOISE_MULTIPLES = 3.0
"""Motion that is noise [standard deviations of a coordinate], and ratio of declared to measured noise that is
doubted."""
NEVER_FOLLOWS = 0.02
"""Held over reported motion below which a unit is wrong, as no slip or row would be so even."""
FOLLOWS, STANDS = 0.5, 0.2
"""Share of the tool's steps that points follow when it pulls them, and when it does not: grasped skin and cloth follow
by 0.4 to 1."""
MAX_TIP_ERROR_M = 0.01
"""Distance of the tip from the points that it holds below which nothing is doubted [m]: robots report their tip within
0.7 to 3 mm, and the frames of robot and camera, and trackers, are wrong by as much each."""
JUMP = 3.0
"""Distance of a report from the middle of its neighbours from which it is an outlier [the tool's usual step]: a tool
that turns back is one step from it. A tool that jumps and stays is half of its neighbours' distance from it."""
DOWN_SHARE = 0.5
"""Component along gravity of the held points' displacement, over its size, from which they go into the bed."""
TILTED_DEG = 45.0
"""Angle between the sheet and the declared bed from which one of them is wrong [degrees]: sheets lie on wedges too."""
FLAT = 0.2
"""Thickness of a sheet at rest over its width below which it has a plane."""


def why_apart(track: HeldMotion, *, noise_sd: float) -> RecordingProblem | None:
    """Return what explains that tool and held points move differently; None where nothing clearly does.

    Args:
        track: tool and held points; the tool's position is an independent measurement.
        noise_sd: noise of a coordinate [m].
    """
    noise = NOISE_MULTIPLES * noise_sd
    (closed, _), (opened, open_steps) = track.followed(closed=True), track.followed(closed=False)
    if opened > FOLLOWS and closed < STANDS and open_steps > noise:
        return RecordingProblem(
            name="gripper-inverted",
            refuses=True,
            text=f"the points follow the tool by {opened:.0%} while the jaws are open, and by {closed:.0%} while they "
            "are closed: is the gripper's signal inverted? Invert the rule for closed, or correct 'after' and the "
            "frames of [[grasp]].",
        )
    frame = frame_fit(track, noise=noise)
    if frame is not None:
        return _frame_problem(frame, several=len(np.unique(track.grasps)) > 1)
    clock = clock_fit(track, noise=noise_sd)
    return None if clock is None else _clock_problem(clock)


def _frame_problem(fit: FrameFit, *, several: bool) -> RecordingProblem:
    same_axes, same_unit = np.allclose(fit.axes, np.eye(3)), fit.factor == 1.0
    found = f"tool and held points differ by {metres(fit.before)}, and by {metres(fit.after)} if the tool's motion is"
    unit = "" if same_unit else f"{factor_named(fit.factor)} as large"
    if same_axes:
        return RecordingProblem(
            name="tool-unit",
            # Points beside the grip move by a tenth of its displacement too, never by a hundredth.
            refuses=several or fit.factor > 1 or fit.factor < NEVER_FOLLOWS,
            text=f"{found} {unit}; give both in one unit: correct unit or tool_unit, whichever is wrong (inches "
            "must be converted).",
        )
    return RecordingProblem(
        name="tool-axes",
        refuses=True,
        text=f"{found} {axes_named(fit.axes)}{' and ' if unit else ''}{unit}; transform the tool's positions and turns "
        "into the frame of the points.",
    )


def _clock_problem(fit: ClockFit) -> RecordingProblem:
    after = f"tool and held points differ by {metres(fit.before)}, and by {metres(fit.after)} if"
    if fit.drift:
        return RecordingProblem(
            name="tool-drift",
            refuses=False,
            text=f"{after} the tool's clock runs {abs(fit.drift):.1%} {'fast' if fit.drift > 0 else 'slow'}; give the "
            "frames their measured times instead of a nominal period, or correct tool_times.",
        )
    late = fit.late > 0
    return RecordingProblem(
        name="tool-clock",
        refuses=False,
        text=f"{after} its reports are taken {abs(fit.late):.2g} s {'earlier' if late else 'later'}; add "
        f"{-fit.late:.2g} to tool_clock_offset or to the tool's stamps, unless the points slip, or close-loop "
        f"shall estimate it as {'tool_latency' if late else 'image_latency'}.",
    )


def factor_named(factor: float) -> str:
    """Return a factor in words."""
    return f"{factor:.4g} times" if factor >= 1 else f"1/{1 / factor:.4g}"


def axes_named(axes: Float[np.ndarray, "3 3"]) -> str:
    """Return in words how the tool's axes become those of the points."""
    if not np.isin(axes, (-1.0, 0.0, 1.0)).all():
        turn = Rotation.from_matrix(axes).as_rotvec(degrees=True)
        angle = float(np.linalg.norm(turn))
        return f"rotated by {angle:.0f} degrees about {np.round(turn / angle, 2).tolist()}"
    names = [("-" if row.sum() < 0 else "") + "xyz"[int(np.argmax(np.abs(row)))] for row in axes]
    return f"taken as ({', '.join(names)})"


def outliers(track: HeldMotion, *, noise_sd: float) -> Iterator[RecordingProblem]:
    """Find reports in which the tool alone jumps away and comes back."""
    tool, held, grasps, noise = track.tool, track.held, track.grasps, NOISE_MULTIPLES * noise_sd
    if len(tool) < LEAST_FRAMES:
        return
    steps = np.linalg.norm(np.diff(tool, axis=0), axis=1)
    usual = float(np.median(steps[steps > noise])) if (steps > noise).any() else 0.0
    jump, followed = (np.linalg.norm(each[1:-1] - (each[2:] + each[:-2]) / 2, axis=1) for each in (tool, held))
    back = np.linalg.norm(tool[2:] - tool[:-2], axis=1)
    alone = (jump > JUMP * max(noise, usual)) & (jump > back) & (followed < APART * jump)
    alone &= (grasps[:-2] == grasps[1:-1]) & (grasps[2:] == grasps[1:-1])
    if alone.any():
        at = int(np.argmax(np.where(alone, jump, 0.0)))
        yield RecordingProblem(
            name="tool-outlier",
            refuses=False,
            text=f"at {track.times[at + 1]:.4g} s the tool jumps {metres(float(jump[at]))} away and back, and what it "
            f"holds does not ({int(alone.sum())} such report{'s' if alone.sum() > 1 else ''}); leave the report out.",
        )


def tip_offset(track: HeldMotion, *, spread: float, spacing: float) -> Iterator[RecordingProblem]:
    """Find a tip that is reported beside what it holds, always by the same vector.

    Args:
        track: tool and held points.
        spread: largest distance of a held point from their mean when the jaws close [m].
        spacing: distance of neighbouring points [m].
    """
    first = np.flatnonzero(np.diff(track.grasps, prepend=-1))
    if not len(first):
        return
    offset = np.mean(track.held[first] - track.tool[first], axis=0)
    if np.linalg.norm(offset) > max(spread + spacing, MAX_TIP_ERROR_M):
        yield RecordingProblem(
            name="tool-offset",
            refuses=False,
            text=f"what the tool holds is {metres(float(np.linalg.norm(offset)))} from its reported position, by "
            f"{np.round(1e3 * offset).astype(int).tolist()} mm on average; is it the flange, or another origin? Give "
            "the position of the tip, in the frame of the points.",
        )


def empty_grips(nearest: Sequence[float], *, reach: float) -> Iterator[RecordingProblem]:
    """Find jaws that close where no point is, though what they hold is decided by their radius.

    Args:
        nearest: distance of the nearest point from the tool when the jaws close, a grasp each [m].
        reach: radius of the grip and distance of neighbouring points [m].
    """
    empty = [distance for distance in nearest if distance > max(reach, MAX_TIP_ERROR_M)]
    if empty:
        yield RecordingProblem(
            name="grip-empty",
            refuses=False,
            text=f"in {len(empty)} of {len(nearest)} grasps the nearest point is {metres(max(empty))} from the tool "
            "when the jaws close, beyond the grip's radius; is its position that of the tip, in the unit and the frame "
            "of the points?",
        )


def vertical(
    track: HeldMotion, rest: Float[np.ndarray, "n 3"], gravity: Float[np.ndarray, " 3"], *, noise_sd: float
) -> Iterator[RecordingProblem]:
    """Find a bed that the sheet does not lie on: tilted against it, or on the side to which the tool pulls.

    Args:
        track: held points.
        rest: points at rest [m], NaN where unseen.
        gravity: as it is declared, with a bed [m/s^2].
        noise_sd: noise of a coordinate [m].
    """
    down = gravity / np.linalg.norm(gravity)
    seen = rest[np.isfinite(rest).all(axis=1)]
    if len(seen) >= 3:
        _, widths, directions = np.linalg.svd(seen - seen.mean(axis=0), full_matrices=False)
        tilt = float(np.degrees(np.arccos(min(1.0, abs(float(directions[2] @ down))))))
        if widths[2] < FLAT * widths[1] and tilt > TILTED_DEG:
            axis = "xyz"[int(np.argmax(np.abs(directions[2])))]
            yield RecordingProblem(
                name="bed-tilted",
                refuses=False,
                text=f"the sheet's plane and the bed, which is level, differ by {tilt:.0f} degrees; which direction is "
                f"down? Declare gravity along {axis}, with the sign that points to the bed, or bed = false.",
            )
            return
    if not len(track.grasps):
        return
    held, grasps = track.held, track.grasps
    moved = np.concatenate([held[grasps == grasp] - held[grasps == grasp][0] for grasp in np.unique(grasps)])
    far = moved[int(np.argmax(np.linalg.norm(moved, axis=1)))]
    depth = float(far @ down)
    if depth > max(NOISE_MULTIPLES * noise_sd, DOWN_SHARE * float(np.linalg.norm(far))):
        yield RecordingProblem(
            name="bed-above",
            refuses=False,
            text=f"held points go {metres(depth)} along gravity, into the bed; is the world's z down? Declare "
            f"gravity = {np.round(0.0 - gravity, 2).tolist()}, or bed = false.",
        )
