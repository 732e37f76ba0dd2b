"""Import of a folder of measured, tracked points: its recording.toml tells how it becomes a recording.

`tool` gives the position of the tool. The jaws are closed from the rest frame on, or in each run after the frames that
show the sheet at rest, so that the tip's motion counts from there. Known attachments go into the truth file alone.
Reads no images; does not smooth, fill or filter the points.
"""

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..argument_checks import as_path
from ..errors import RecordingError
from ..observation import MeasuredPoints, Observation
from ..plausibility.identity import PointIdentity
from ..plausibility.point_motion import spacing
from ..plausibility.point_problems import identity_problems
from ..recording.declaration import identity
from ..recording.mcap_files import truth_path
from ..recording.truth import write_truth
from ..recording.writer import RecordingWriter
from .clock import FrameClock, frame_clock
from .complete_files import complete_files
from .data_folder import DataFolder
from .declared_mesh import declared_mesh
from .known_attachments import measured_truth
from .length_checks import refuse_large_lengths
from .point_files import read_frames
from .points.archives import read_array
from .points.headings import PIXELS
from .points.measured import PointFrames, is_planar
from .recording_toml import MeasuredRecording, read_recording_toml
from .tool import Tool
from .tool_force import read_force
from .units import LENGTH_UNITS, LIKELY_EXTENT, PIXELS_ARE_NO_LENGTH, likely_unit

MIN_EXTENT, MAX_EXTENT = 2e-3, 2.0
"""Smallest and largest extent of a sheet [m]: outside it the unit is wrong, or this is no tissue or cloth."""
MAX_NOISE_SHARE = 0.25
"""Largest noise, as a share of the sheet's extent: with more, points do not show the sheet's shape."""
MAX_GROWTH = 10.0
"""Largest spread of the points in any frame, over that at rest: no sheet stretches so far, and displacements begin at
nothing."""
SPREAD = (5, 95)
"""Percentiles over the points between which they spread: single wild points do not count."""
MIN_REST_POINTS = 3
"""Finite points that a rest frame needs: three span a plane."""


@dataclass(frozen=True, kw_only=True)
class ImportSummary:
    """Files and figures of an import."""

    recording: Path
    """The recording."""
    truth: Path | None
    """The truth file; None where recording.toml gives no attachments."""
    n_frames: int
    """Number of frames of the recording."""
    n_points: int
    """Number of points in each frame."""
    n_unseen: int
    """Number of points not seen, summed over the frames."""
    n_vertices: int | None
    """Number of vertices of the declared mesh; None without one."""
    n_held: int
    """Number of points or vertices that are declared held."""
    n_attached: int | None
    """Number of attached vertices in the truth; None without truth."""
    skipped: tuple[tuple[str, str], ...]
    """Name and reason of each frame that was left out."""
    notes: tuple[str, ...] = ()
    """What the readers assumed or found, a line each."""


def import_folder(
    folder: str | os.PathLike[str],
    recording_toml: str | os.PathLike[str] | None,
    out: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    allow_outside: bool = False,
) -> ImportSummary:
    """Convert a folder of measured data to a recording, and a truth file where the TOML gives attachments.

    Args:
        folder: folder of the data files.
        recording_toml: their description; None for `recording.toml` in the folder.
        out: the recording to write; the truth goes beside it, as `truth_path` says.
        overwrite: replace existing files.
        allow_outside: read data files outside the folder where the TOML names them.

    Raises:
        RecordingError: the TOML or a data file is missing or malformed, or the two contradict each other.
        MeshError: the declared triangles are not one sheet.
        OutputError: an output exists, or cannot be written.
    """
    folder, out = as_path(folder, "the folder"), as_path(out, "the recording's path")
    data = DataFolder(path=folder, allow_outside=allow_outside)
    given = read_recording_toml(folder / "recording.toml" if recording_toml is None else Path(recording_toml))
    found = read_frames(data, given.points)
    _refuse_unit(found, given)
    frames, names, steps = _frames_in_world(found, given)
    rest = frames[0]
    refuse_large_lengths(given, rest, steps)
    _refuse_mixed_rows(frames)
    clock = _clock(data, given, found)
    mesh = declared_mesh(data, given, rest, found.notes)
    vertices = None if mesh is None else mesh.vertices
    tool = Tool.read(data, given, frames, names=names, steps=steps, clock=clock, vertices=vertices)
    order = [step + given.points.rest for step in steps]
    forces = read_force(
        data,
        given.force,
        given.points.files[0],
        decimal=given.points.decimal,
        rotation=given.frame.rotation,
        order=order,
    )
    name = identity(given.name, frames)
    truth = measured_truth(data, given, rest, mesh, name)
    skipped: list[tuple[str, str]] = []
    n_frames, n_unseen, previous_time = 0, 0, 0
    with complete_files(out, overwrite=overwrite) as (part, truth_part):
        with RecordingWriter(
            part,
            camera=None,
            declaration=replace(given.declaration, mesh=mesh),
            metadata={"name": given.name, "source": given.source, "identity": name},
        ) as writer:
            for number, (positions, file) in enumerate(zip(frames, names, strict=True)):
                unseen = ~np.isfinite(positions).all(axis=1)
                reason = "no finite point" if unseen.all() else tool.why_unknown(number, positions)
                if reason is not None:
                    skipped.append((file, reason))
                    continue
                time = clock.times[number]
                writer.write(
                    Observation(
                        index=n_frames,
                        time=time,
                        tool=tool.state(number, positions),
                        reports=tool.reported(previous_time, time),
                        force=forces[number],
                        points=MeasuredPoints(
                            positions=positions,
                            track_id=np.arange(len(rest)),
                            sd=given.noise_sd,
                            smooth_sd=given.smooth_sd,
                            smooth_length=given.smooth_length,
                        ),
                    )
                )
                n_frames, n_unseen, previous_time = n_frames + 1, n_unseen + int(unseen.sum()), time
        if truth is not None:
            write_truth(truth_part, truth)
    n_held = int(mesh.held.sum()) if mesh is not None and mesh.held is not None else tool.n_held
    return ImportSummary(
        recording=out,
        truth=None if truth is None else truth_path(out),
        n_frames=n_frames,
        n_points=len(rest),
        n_unseen=n_unseen,
        n_vertices=None if mesh is None else len(mesh.vertices),
        n_held=n_held,
        n_attached=None if truth is None else int(truth.attached.sum()),
        skipped=tuple(skipped),
        notes=(*found.notes, *clock.notes, *tool.notes),
    )


def _frames_in_world(
    found: PointFrames, given: MeasuredRecording
) -> tuple[Float[np.ndarray, "t n 3"], list[str], list[int]]:
    """Return the frames in the world [m], the rest frame first; their names; their number of frames after rest."""
    frames, names = found.positions, found.names
    if given.points.rest >= len(frames):
        raise RecordingError(f"[points] rest is {given.points.rest}; there are {len(frames)} frames, counted from 0.")
    order = [given.points.rest, *(number for number in range(len(frames)) if number != given.points.rest)]
    frames = frames[order] * given.unit @ given.frame.rotation.T + given.frame.translation
    frames[~np.isfinite(frames).all(axis=2)] = np.nan
    names = [names[number] for number in order]
    if np.isfinite(frames[0]).all(axis=1).sum() < MIN_REST_POINTS:
        raise RecordingError(f"the rest frame {names[0]} has fewer than three finite points; choose another rest.")
    _refuse_growth(frames)
    _refuse_extent(frames[0], given, planar=is_planar(found.positions))
    return frames, names, [number - given.points.rest for number in order]


def _refuse_growth(frames: Float[np.ndarray, "t n 3"]) -> None:
    seen = frames[:, np.isfinite(frames[0]).all(axis=1)]
    low, high = np.nanpercentile(seen[np.isfinite(seen).any(axis=(1, 2))], SPREAD, axis=1)
    spread = (high - low).max(axis=1)
    if spread.max() > MAX_GROWTH * spread[0]:
        raise RecordingError(
            f"the points spread over {spread[0]:.3g} m at rest and over {spread.max():.3g} m later: are these "
            "displacements? Give the reference coordinates as points, and these as displacements in [points]."
        )


def _refuse_extent(rest: Float[np.ndarray, "n 3"], given: MeasuredRecording, *, planar: bool) -> None:
    extent = float(np.ptp(rest[np.isfinite(rest).all(axis=1)], axis=0).max())
    if MIN_EXTENT <= extent <= MAX_EXTENT:
        if given.noise_sd > MAX_NOISE_SHARE * extent:
            raise RecordingError(
                f"noise_sd is {given.noise_sd:.3g} m, and the sheet is {extent:.3g} m large: it is in metres, not in "
                f"unit; at most {MAX_NOISE_SHARE:.0%} of the sheet is allowed."
            )
        return
    likely = likely_unit(extent / given.unit, LENGTH_UNITS, *LIKELY_EXTENT)
    cure = "check unit and columns" if likely is None else f'is it unit = "{likely}"?'
    raise RecordingError(
        f'the sheet is {extent:.3g} m large in unit = "{given.unit_name}"; {MIN_EXTENT:g} to {MAX_EXTENT:g} m is '
        f"expected: {cure}{f'; {PIXELS_ARE_NO_LENGTH}.' if planar else ''}"
    )


def _refuse_mixed_rows(frames: Float[np.ndarray, "t n 3"]) -> None:
    """Refuse rows that are other points in other frames, before their motion is taken for that of points."""
    identity_of_rows = PointIdentity(frames[0], spacing(frames[0]))
    for frame in frames:
        identity_of_rows.add(frame)
    for problem in identity_problems(identity_of_rows):
        if problem.name == "identities" and problem.refuses:
            raise RecordingError(problem.text)


def _clock(folder: DataFolder, given: MeasuredRecording, found: PointFrames) -> FrameClock:
    points = given.points
    return frame_clock(
        count=len(found.positions),
        period=given.period,
        times=found.times,
        unit=given.time_unit,
        runs=None if points.runs is None else read_array(folder / points.files[0], points.runs),
    )


def _refuse_unit(found: PointFrames, given: MeasuredRecording) -> None:
    """Refuse a unit that contradicts that of headings or of the arrays' names."""
    other = next(iter(sorted(found.units - {given.unit_name})), None)
    if other == PIXELS:
        raise RecordingError(f"headings or names of arrays say that the points are in pixels; {PIXELS_ARE_NO_LENGTH}.")
    if other is not None:
        cure = (
            f'give unit = "{other}"' if other in LENGTH_UNITS else f"convert them to one of {', '.join(LENGTH_UNITS)}"
        )
        raise RecordingError(
            f'unit = "{given.unit_name}", but headings or names of arrays say that the points are in {other}: {cure}, '
            "or correct the names."
        )
