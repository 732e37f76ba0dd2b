"""What is wrong with measured points that are no sheet's: lost ones, and mixed up rows.

docs/RECORDINGS.md has the names as a table.
"""

from collections.abc import Iterator

from .identity import ISOLATED, Place, PointIdentity
from .point_motion import PointMotion
from .problem import RecordingProblem, metres
from .repeated import LEAST_RUN, RepeatedPositions

MOST = 0.5
"""Share of a frame's points that change places from which rows are in another order; fewer are a tracker's mistakes."""


def point_problems(motion: PointMotion) -> Iterator[RecordingProblem]:
    """Find points that are lost, wild, mixed up, written again or new.

    Args:
        motion: of the points, frame by frame.
    """
    if motion.identity is not None:
        yield from identity_problems(motion.identity)
    if motion.repeated is not None:
        yield from _repeated(motion.repeated)
    if motion.restarts:
        yield RecordingProblem(
            name="new-tracks",
            refuses=False,
            text=f"in {motion.restarts} frames all points have numbers that no frame before has: did the tracker "
            "start anew? The same track_id must be the same point throughout; points that first come while the sheet "
            "is pulled are of no use.",
        )


def identity_problems(identity: PointIdentity) -> Iterator[RecordingProblem]:
    """Find marks of lost points, wild ones, and rows that are other points in other frames."""
    yield from _lost(identity)
    yield from _exchanged(identity)


def _lost(identity: PointIdentity) -> Iterator[RecordingProblem]:
    """Find places that stand for lost points."""
    cure = "give it as missing = [x, y, z] in recording.toml, in the unit of the file, or write NaN"
    if identity.shared_place is not None:
        place, count = identity.shared_place
        yield RecordingProblem(
            name="lost-mark",
            refuses=True,
            text=f"{count} points jump to exactly {_named(place)} m at some time, and their neighbours do not: that "
            f"place stands for a lost point; {cure}.",
        )
    elif identity.lost_coordinate is not None:
        axis, value, count = identity.lost_coordinate
        yield RecordingProblem(
            name="lost-mark",
            refuses=True,
            text=f"{count} points jump to {'xyz'[axis]} = {value:.6g} m at some time, and keep the other coordinates: "
            "that value stands for a lost one, as of a depth; write NaN for the point there.",
        )
    elif identity.wild:
        yield RecordingProblem(
            name="wild",
            refuses=False,
            text=f"{len(identity.wild)} points jump up to {metres(max(identity.wild.values()))} away from their "
            "neighbours at some time; leave them out there (write NaN, or name what rates the points as visibility).",
        )
    if len(identity.isolated):
        x, y, z = identity.isolated[0].tolist()
        yield RecordingProblem(
            name="isolated",
            refuses=False,
            text=f"{len(identity.isolated)} points lie more than {ISOLATED:g} spacings from any other at rest, the "
            f"first at {_named((x, y, z))} m: where that place stands for a lost point, {cure}; else leave it out.",
        )


def _repeated(repeated: RepeatedPositions) -> Iterator[RecordingProblem]:
    """Find points that look attached, as their last position is written while they are lost."""
    if repeated.farthest:
        yield RecordingProblem(
            name="repeated",
            refuses=False,
            text=f"{len(repeated.farthest)} points keep their position to the last digit for {LEAST_RUN} frames or "
            f"more while their neighbours go up to {metres(max(repeated.farthest.values()))}: if the tracker writes "
            "the last position of a lost point, write NaN there, or name what rates the points as visibility; they "
            "look attached.",
        )


def _exchanged(identity: PointIdentity) -> Iterator[RecordingProblem]:
    """Find rows that are other points in other frames."""
    share, count, frames = identity.largest_exchange, identity.n_exchanged, identity.exchange_frames
    if not count:
        return
    cause = (
        "are the rows sorted in each frame, or points found anew"
        if share > MOST
        else "does the tracker mix up points, or is an export sorted"
    )
    yield RecordingProblem(
        name="identities",
        refuses=share > MOST,
        text=f"{count} points take places of others, up to {share:.0%} of a frame's points, in {frames} frames; "
        f"{cause}? A row, or a track_id, must be the same point in every frame.",
    )


def _named(place: Place) -> str:
    return f"({', '.join(f'{value:.6g}' for value in place)})"
