"""Checks that the lengths in recording.toml fit the sheet: they are in metres, whatever the unit of the data.

One in mm is a thousand times too large for the sheet, and one in cm a hundred times.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from ..errors import RecordingError
from .grasp_table import DEFAULT_GRASP_RADIUS, NearPlace
from .recording_toml import Extension, Margin, MeasuredRecording, Region

MAX_SIZE = 1.0
"""Largest grip, and largest spacing of vertices, over the extent of the seen points: a larger grip holds them all."""
MAX_REACH = 8.0
"""Largest margin, outline, or distance from the seen points, over their extent: a view that shows an eighth of the
sheet is within it, a length in cm is not."""

Length = tuple[str, float, float]
"""Name of a key, its length [m], and the largest one over the sheet's extent."""


def refuse_large_lengths(given: MeasuredRecording, rest: Float[np.ndarray, "n 3"], steps: list[int]) -> None:
    """Refuse lengths and places that no sheet of this size can have.

    Args:
        given: contents of the recording.toml.
        rest: points at rest in the world [m], NaN where unseen.
        steps: number of each frame, counted from the rest frame.

    Raises:
        RecordingError: a length is too large, or a place too far from the points; names the key.
    """
    seen = rest[np.isfinite(rest).all(axis=1)]
    extent = float(np.ptp(seen, axis=0).max())
    for name, length, allowed in _lengths(given, seen, steps):
        if length > allowed * extent:
            raise RecordingError(
                f"{name} {length:.4g} m, and the sheet is {extent:.3g} m large: lengths and places in recording.toml "
                "are in metres, whatever the unit of the data."
            )


def _lengths(given: MeasuredRecording, seen: Float[np.ndarray, "m 3"], steps: list[int]) -> Iterator[Length]:
    grasp, path = given.grasp, given.grasp.path
    for each in grasp.grasps:
        yield _radius(each.where, each.radius)
        if isinstance(each.held, NearPlace) and each.held.at is not None:
            yield _place(f"{each.where} at", each.held.at, seen)
    if path is not None:
        yield _radius("[grasp]", grasp.path_radius)
        yield _place("[grasp] start", path.start, seen)
        yield "[grasp] step makes", abs(path.step) * max(map(abs, steps)), MAX_REACH
    if given.smooth_length is not None:
        yield "smooth_length is", given.smooth_length, MAX_REACH
    if given.margin is not None:
        yield from _of_margin(given.margin)
    if given.extension is not None:
        yield from _of_extension(given.extension, seen)
    if isinstance(given.attached, Region):
        yield _place("[truth] attached_at", given.attached.at, seen)
        yield "[truth] attached_within is", given.attached.radius, MAX_REACH


def _radius(where: str, radius: float) -> Length:
    default = ", which is the default: give a smaller one; it" if radius == DEFAULT_GRASP_RADIUS else ""
    return f"{where} radius{default} is", radius, MAX_SIZE


def _of_margin(margin: Margin) -> Iterator[Length]:
    if margin.spacing is not None:
        yield "[mesh] spacing is", margin.spacing, MAX_SIZE
    if margin.width is not None:
        yield "[mesh] margin is", margin.width, MAX_REACH
    if margin.outline is not None:
        yield "[mesh] outline is", float(np.ptp(margin.outline[:, :2], axis=0).max()), MAX_REACH


def _of_extension(extension: Extension, seen: Float[np.ndarray, "m 3"]) -> Iterator[Length]:
    along = seen[:, int(np.abs(extension.axis).argmax())]
    yield "[mesh.extend] spacing is", extension.spacing, MAX_SIZE
    for name in ("begin", "end", "held_beyond"):
        station = getattr(extension, name)
        if station is not None:
            beyond = max(float(along.min()) - station, station - float(along.max()))
            yield f"[mesh.extend] {name} is beyond the points by", beyond, MAX_REACH


def _place(name: str, place: Float[np.ndarray, " 3"], seen: Float[np.ndarray, "m 3"]) -> Length:
    """Return how far a place is from the nearest seen point."""
    return f"{name} is away from the points by", float(np.linalg.norm(seen - place, axis=1).min()), MAX_REACH
