"""Import of a folder of measured, tracked points: its recording.toml tells how it becomes a recording.

`tool` gives the position of the tool. The jaws are closed from the rest frame on, or in each run after the frames that
show the sheet at rest, so that the tip's motion counts from there. Known attachments go into the truth file alone.
Reads no images; does not smooth, fill or filter the points.
"""

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from ..argument_checks import as_path
from ..errors import OutputError, RecordingError
from ..mesh_checks import check_mesh
from ..observation import DeclaredMesh, MeasuredPoints, Observation
from ..recording.declaration import identity
from ..recording.mcap_files import truth_path
from ..recording.schemas import NS_PER_S
from ..recording.truth import write_truth
from ..recording.writer import RecordingWriter
from ..sheet_triangulation import SheetPlane, extend, triangulate
from ..truth import Truth
from .data_folder import DataFolder
from .declaration import Extension, MeasuredRecording, Rows, read_recording_toml
from .faces import read_faces
from .point_files import read_frames, read_rows
from .points.archives import read_array
from .points.measured import PointFrames
from .tool import Tool

MAX_EDGE_SPACINGS = 2.5
"""Longest edge of a triangle that is not declared [spacings]: it bridges one missing row of points, but not two."""
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
    frames, names, steps = _frames_in_world(found, given)
    rest = frames[0]
    mesh = _declared_mesh(data, given, rest, found.notes)
    clock = _clock(data, given, len(frames))
    tool = Tool.read(data, given, rest, name=names[0], origin=clock.origin)
    name = identity(given.name, frames)
    truth = _truth(data, given, rest, mesh, name)
    truth_file = truth_path(out)
    for path in (out, truth_file):
        if path.exists() and not overwrite:
            raise OutputError(f"{path} exists; choose another path, or allow the file to be replaced (--overwrite).")
    skipped: list[tuple[str, str]] = []
    n_frames, n_unseen, previous_time = 0, 0, 0
    with RecordingWriter(
        out,
        camera=None,
        declaration=replace(given.declaration, mesh=mesh),
        metadata={"name": given.name, "source": given.source, "identity": name},
        overwrite=overwrite,
    ) as writer:
        for number, (positions, file) in enumerate(zip(frames, names, strict=True)):
            unseen = ~np.isfinite(positions).all(axis=1)
            if unseen.all() or tool.is_unknown(positions):
                skipped.append((file, "no finite point" if unseen.all() else "no grasped point seen"))
                continue
            time, run, began = clock.times[number], clock.runs[number], clock.began[number]
            writer.write(
                Observation(
                    index=n_frames,
                    time=time,
                    tool=tool.state(step=steps[number], time=time, run=run, began=began, positions=positions),
                    reports=tool.reports.between(previous_time, time) if tool.reports is not None else (),
                    points=MeasuredPoints(positions=positions, track_id=np.arange(len(rest)), sd=given.noise_sd),
                )
            )
            n_frames, n_unseen, previous_time = n_frames + 1, n_unseen + int(unseen.sum()), time
    if truth is not None:
        write_truth(truth_file, truth, overwrite=overwrite)
    n_held = int(mesh.held.sum()) if mesh is not None and mesh.held is not None else len(tool.held)
    return ImportSummary(
        recording=out,
        truth=None if truth is None else truth_file,
        n_frames=n_frames,
        n_points=len(rest),
        n_unseen=n_unseen,
        n_vertices=None if mesh is None else len(mesh.vertices),
        n_held=n_held,
        n_attached=None if truth is None else int(truth.attached.sum()),
        skipped=tuple(skipped),
        notes=tuple(found.notes),
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
    return frames, names, [number - given.points.rest for number in order]


@dataclass(frozen=True, kw_only=True)
class _Clock:
    """Times and runs of the frames."""

    times: list[int]
    """Time of each frame [ns]."""
    runs: list[int]
    """Number of each frame's run, from 1."""
    began: list[int]
    """Time at which each frame's run began [ns]."""
    origin: float
    """Time of the first frame on the clock of the data [s]; 0 where the data have no times."""


def _clock(folder: DataFolder, given: MeasuredRecording, count: int) -> _Clock:
    points, seconds, numbers = given.points, np.arange(float(count)), np.zeros(count)
    if points.times is not None:
        seconds = read_array(folder / points.files[0], points.times)
    if points.runs is not None:
        numbers = read_array(folder / points.files[0], points.runs)
    if seconds.shape != (count,) or numbers.shape != (count,) or not (np.diff(seconds) > 0).all():
        raise RecordingError(
            f"[points] times must increase and have one entry for each of the {count} frames, and so must runs; "
            f"they have shapes {seconds.shape} and {numbers.shape}."
        )
    scale = float(NS_PER_S) if given.period is None else given.period
    times = [round((each - seconds[0]) * scale) for each in seconds]
    first = np.append(True, np.diff(numbers) != 0)
    started = np.maximum.accumulate(np.where(first, np.arange(count), 0))
    return _Clock(
        times=times,
        runs=np.cumsum(first).tolist(),
        began=[times[number] for number in started],
        origin=float(seconds[0]),
    )


def _declared_mesh(
    folder: DataFolder, given: MeasuredRecording, rest: Float[np.ndarray, "n 3"], notes: list[str]
) -> DeclaredMesh | None:
    if given.faces is None and given.extension is None:
        return None
    rows, faces = np.flatnonzero(np.isfinite(rest).all(axis=1)), None
    if given.faces is not None:
        rows, faces = _seen_faces(rest, read_faces(folder, given, rest, notes))
    if given.extension is not None:
        return _extended(rest, rows, faces, given.extension)
    assert faces is not None
    check_mesh(rest[rows], faces)
    return DeclaredMesh(vertices=rest[rows], faces=faces, track_id=rows)


def _seen_faces(
    rest: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, "g 3"]]:
    """Return the rows with triangles, and the triangles renumbered to them; those with an unseen corner are dropped."""
    if faces.size == 0 or faces.min() < 0 or faces.max() >= len(rest):
        check_mesh(rest, faces)
    faces = faces[np.isfinite(rest[faces]).all(axis=(1, 2))]
    rows, renumbered = np.unique(faces, return_inverse=True)
    return rows, renumbered.reshape(faces.shape)


def _extended(
    rest: Float[np.ndarray, "n 3"],
    rows: Int[np.ndarray, " m"],
    faces: Int[np.ndarray, "f 3"] | None,
    extension: Extension,
) -> DeclaredMesh:
    """Return the measured points and their continuation, triangulated anew in the orientation of the measured faces."""
    if faces is not None:
        check_mesh(rest[rows], faces)
    plane = SheetPlane.through(rest[rows], extension.axis)
    flat = plane.flatten(rest[rows])
    begin, end = sorted((plane.along(extension.begin), plane.along(extension.end)))
    added = extend(flat, begin=begin, end=end, spacing=extension.spacing)
    vertices = np.concatenate([rest[rows], plane.raise_up(added)])
    spacing = max(extension.spacing, _spacing(flat))
    new_faces = triangulate(np.concatenate([flat, added]), MAX_EDGE_SPACINGS * spacing)
    if faces is not None and _upward(plane, rest[rows], faces) < 0:
        new_faces = new_faces[:, ::-1].copy()
    held = None
    if extension.held_beyond is not None:
        held = plane.beyond(vertices, extension.held_beyond)
        if not held.any():
            raise RecordingError(
                f"[mesh.extend] held_beyond = {extension.held_beyond} lies outside the sheet, which reaches from "
                f"{extension.begin} to {extension.end}."
            )
    check_mesh(vertices, new_faces)
    track = np.concatenate([rows, np.full(len(added), -1)])
    return DeclaredMesh(vertices=vertices, faces=new_faces, track_id=track, held=held)


def _truth(
    folder: DataFolder, given: MeasuredRecording, rest: Float[np.ndarray, "n 3"], mesh: DeclaredMesh | None, name: str
) -> Truth | None:
    """Return the presence of attachments; true positions are unknown, so the truth has no frames."""
    if given.attached is None:
        return None
    if isinstance(given.attached, Rows):
        nothing = given.attached.file is None and not given.attached.rows
        rows = () if nothing else read_rows(folder, given.attached, len(rest), "[truth]")
        known = np.isin(np.arange(len(rest)), rows)
        vertices, faces, attached = _truth_sheet(rest, known, mesh)
    else:
        assert mesh is not None and given.extension is not None
        plane = SheetPlane.through(mesh.vertices[mesh.track_id >= 0], given.extension.axis)
        vertices, faces, attached = mesh.vertices, mesh.faces, plane.beyond(mesh.vertices, given.attached)
    return Truth(
        rest=vertices,
        faces=faces,
        attached=attached,
        frames=(),
        scene=given.name,
        identity=name,
        details=given.truth_details,
    )


def _truth_sheet(
    rest: Float[np.ndarray, "n 3"], known: Bool[np.ndarray, " n"], mesh: DeclaredMesh | None
) -> tuple[Float[np.ndarray, "m 3"], Int[np.ndarray, "f 3"], Bool[np.ndarray, " m"]]:
    """Return vertices, triangles and attachments of the declared mesh, or of the seen rows, triangulated here."""
    if mesh is not None:
        return mesh.vertices, mesh.faces, np.where(mesh.track_id >= 0, known[mesh.track_id], False)
    rows = np.flatnonzero(np.isfinite(rest).all(axis=1))
    flat = SheetPlane.through(rest[rows]).flatten(rest[rows])
    used, renumbered = np.unique(triangulate(flat, MAX_EDGE_SPACINGS * _spacing(flat)), return_inverse=True)
    rows = rows[used]
    return rest[rows], renumbered.reshape(-1, 3), known[rows]


def _spacing(flat: Float[np.ndarray, "m 2"]) -> float:
    """Return the median distance between nearest neighbours [m]."""
    return float(np.median(KDTree(flat).query(flat, k=2)[0][:, 1]))


def _upward(plane: SheetPlane, vertices: Float[np.ndarray, "m 3"], faces: Int[np.ndarray, "f 3"]) -> float:
    """Return twice the triangles' signed area, positive where they face along the plane's upward axis [m^2]."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return float((np.cross(b - a, c - a) @ plane.axes[2]).sum())
