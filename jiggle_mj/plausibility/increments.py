"""Displacements from frame to frame that were taken for displacements from rest: only their sum follows the tool."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from .held_motion import HeldMotion, rms
from .problem import RecordingProblem

MIN_FRAMES = 5
"""Frames of a grasp from which sums are compared: with fewer, a point that slips does the same."""
FOLLOWS, STRAYS = 0.25, 0.5
"""Largest difference from the tool's displacement, over the tool's largest: below the first the sums follow it, above
the second the displacements do not. Points beside the jaws lag by a fifth."""
EXPLAINED = 0.5
"""Share of what a slip leaves that the tool's steps may leave: as with a clock, by chance below 1e-6 for 8 frames."""


def increments(track: HeldMotion) -> Iterator[RecordingProblem]:
    """Find displacements from frame to frame; they are doubted only where points that slip explain them as well.

    Args:
        track: tool and held points; the tool's position is an independent measurement.
    """
    grasps = [
        (held - held[0], tool - tool[0])
        for grasp in np.unique(track.grasps)
        for held, tool in [(track.held[track.grasps == grasp], track.tool[track.grasps == grasp])]
    ]
    summed = [(held, tool) for held, tool in grasps if follow_in_sum(held, tool)]
    if summed:
        sure = any(no_slip(held, tool) for held, tool in summed)
        yield RecordingProblem(
            name="increments",
            refuses=sure,
            text="the held points do not follow the tool, and the sum of their displacements over the frames does: "
            f"{'' if sure else 'unless they slip, '}displacements must be those from the rest frame, not from the "
            "frame before; sum them up, or export them relative to the reference.",
        )


def follow_in_sum(held: Float[np.ndarray, "t 3"], tool: Float[np.ndarray, "t 3"]) -> bool:
    """Return whether the sums of displacements follow the tool, and the displacements do not.

    Args:
        held: mean displacement of the held points in each frame of a grasp, from when the jaws close [m].
        tool: displacement of the tool [m].
    """
    farthest = float(np.linalg.norm(tool, axis=1).max(initial=0.0))
    if len(tool) < MIN_FRAMES or not np.isfinite(held).all() or not farthest:
        return False
    sums, turned = np.cumsum(held, axis=0), tool - _steady(tool)
    if np.linalg.norm(turned, axis=1).max() > FOLLOWS * farthest:
        # The displacement when the jaws closed was taken off, which is an increment and adds up in every frame.
        sums = sums + _steady(tool - sums)
    alone, summed = (float(np.linalg.norm(each - tool, axis=1).max()) for each in (held, sums))
    return alone > STRAYS * farthest and summed < FOLLOWS * farthest


def _steady(places: Float[np.ndarray, "t 3"]) -> Float[np.ndarray, "t 3"]:
    """Return the motion at a constant speed from 0 that is nearest to places."""
    frames = np.arange(len(places))[:, np.newaxis]
    return frames * (frames * places).sum(axis=0) / (frames**2).sum()


def no_slip(held: Float[np.ndarray, "t 3"], tool: Float[np.ndarray, "t 3"]) -> bool:
    """Return whether the tool's steps explain displacements that follow in sum, and points that slip do not.

    Those that slip follow by a share, stay where friction leaves them, or are dragged along by it: the share of the
    tool's displacement, the place, and the drag against the direction of its steps are fitted. At a constant speed of
    the tool they explain steps too.

    Args:
        held: as `follow_in_sum` takes it [m].
        tool: displacement of the tool [m].
    """
    steps = np.diff(tool, axis=0, prepend=tool[:1])
    size = np.linalg.norm(steps, axis=1, keepdims=True)
    direction = np.divide(steps, size, out=np.zeros_like(steps), where=size > 0)
    columns = [tool, direction, *(np.tile(axis, (len(tool), 1)) for axis in np.eye(3))]
    design = np.stack([column.ravel() for column in columns], axis=1)
    slipped = held.ravel() - design @ np.linalg.lstsq(design, held.ravel(), rcond=None)[0]
    stepped = held - steps
    return rms(stepped - stepped.mean(axis=0)) < EXPLAINED * rms(slipped.reshape(-1, 3))
