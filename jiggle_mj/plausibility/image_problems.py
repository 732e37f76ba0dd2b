"""What is wrong with the images of a recording, seen in a few stereo pairs: docs/RECORDINGS.md has it as a table."""

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from ..observation import StereoPair, ToolState
from ..recording.reader import Recording
from .problem import RecordingProblem
from .stereo_images import SIDES, StereoImages, compare_images

SPREAD_PAIRS, MOVING_PAIRS = 3, 5
"""Pairs of successive frames that are compared: some evenly over the recording, and those between which the closed jaws
move most."""
REFUSED_ROWS_PX, DOUBTED_ROWS_PX = 2.5, 1.0
"""Median size of the difference of matching rows [px]: refused from half of the block that `SemiGlobalMatching`
compares, doubted from twice the row error of a usual calibration."""


def image_problems(recording: Recording, tools: Sequence[tuple[int, ToolState]]) -> Iterator[RecordingProblem]:
    """Find what is wrong with the images of a recording, from a few of them.

    Args:
        recording: the open recording.
        tools: index of each usable frame, and the tool in it.
    """
    if recording.camera is None or not tools:
        return
    pairs = _chosen(tools)
    images: dict[int, StereoPair] = {}
    for observation in recording.with_images_of({index for pair in pairs for index in pair}):
        if observation.images is not None:
            images[observation.index] = observation.images
        if observation.index >= pairs[-1][1]:
            break
    seen = [(images[before], images[now]) for before, now in pairs if before in images and now in images]
    yield from _problems(compare_images(recording.camera, seen))


def _chosen(tools: Sequence[tuple[int, ToolState]]) -> list[tuple[int, int]]:
    """Return the indices of the pairs of frames to compare."""
    last = len(tools) - 1
    places = {*np.linspace(min(1, last), last, SPREAD_PAIRS).round().astype(int).tolist()}
    steps = [
        float(np.linalg.norm(now.position - before.position)) if before.closed else 0.0
        for (_, before), (_, now) in pairwise(tools)
    ]
    places |= {place + 1 for place in np.argsort(steps, kind="stable")[::-1][:MOVING_PAIRS].tolist()}
    return [(tools[max(place - 1, 0)][0], tools[place][0]) for place in sorted(places)]


def _problems(found: StereoImages) -> Iterator[RecordingProblem]:
    for side in SIDES:
        blank = np.isfinite(found.grey[side])
        if blank.any():
            yield RecordingProblem(
                name="images-blank",
                refuses=bool(blank.all()),
                text=f"{'all' if blank.all() else 'some'} {side} images that were looked at are of one colour (grey "
                f"level {np.nanmedian(found.grey[side]):.0f} of 255); is the lens covered, or the light off?",
            )
    if found.rows is None:
        return
    if found.swapped:
        disparity = float(np.median(found.shifts[:, 0]))
        yield RecordingProblem(
            name="images-swapped",
            refuses=True,
            text=f"the scene lies {-disparity:.3g} px further left in the left images than in the right ones; swap the "
            "topics of the two cameras, or rotate the images of cameras that are mounted upside down.",
        )
    if found.late is not None:
        yield RecordingProblem(
            name="images-late",
            refuses=True,
            text=f"the {found.late} images show an earlier moment than the other ones of their frames: what moves is "
            "where it was in the frame before. Trigger the cameras together, or correct the stamps of one.",
        )
    if found.rows > DOUBTED_ROWS_PX:
        yield RecordingProblem(
            name="image-rows",
            refuses=found.rows > REFUSED_ROWS_PX,
            text=f"what both cameras see lies in rows that are {found.rows:.3g} px apart (median) once the images are "
            "rectified; calibrate the pair again, give rectified images the calibration of rectified ones, or correct "
            "the stamps of a camera whose images come late.",
        )
