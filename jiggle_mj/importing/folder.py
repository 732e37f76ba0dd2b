"""A folder of measured, tracked points becomes a recording, as its recording.toml says.

Where the tool is, is in `import_tool`. The jaws are closed from the rest frame on, or in each run after the frames that
show the sheet at rest, so that the tip's motion counts from there. What is known of the attachments goes into the truth
file alone. No images; does not smooth, fill or filter the points.
"""

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from ..errors import OutputError, RecordingError
from ..mesh_checks import check_mesh
from ..observation import DeclaredMesh, MeasuredPoints, Observation
from ..recording.declaration import identity
from ..recording.mcap_files import truth_path
from ..recording.reader import RecordingWriter
from ..recording.truth import write_truth
from ..sheet_triangulation import SheetPlane, extend, triangulate
from ..truth import Truth
from .declaration import Extension, MeasuredRecording, Rows, read_recording_toml
from .point_files import read_faces, read_frames, read_npz, read_rows
from .tool import Tool

LONGEST_EDGE = 2.5
"""Spacings that an edge may span where nobody declared triangles: a missing row of points is bridged, two are not."""


@dataclass(frozen=True, kw_only=True)
class ImportSummary:
    """What an import wrote."""

    recording: Path
    truth: Path | None
    """None where recording.toml knows nothing of the attachments."""
    n_frames: int
    n_points: int
    n_unseen: int
    """Points not seen, over all frames."""
    n_vertices: int | None
    """Of the declared mesh; None without one."""
    n_held: int
    """Points or vertices declared to be in the grip."""
    n_attached: int | None
    """Attached vertices of the truth."""
    skipped: tuple[tuple[str, str], ...]
    """Name and reason of each frame that was left out."""


def import_folder(
    folder: str | os.PathLike[str],
    recording_toml: str | os.PathLike[str] | None,
    out: str | os.PathLike[str],
    *,
    overwrite: bool = False,
) -> ImportSummary:
    """Turn a folder of measured data into a recording, and a truth file where the toml knows of attachments.

    Args:
        folder: where the data files are.
        recording_toml: what they are; None for `recording.toml` in the folder.
        out: the recording to write; the truth goes beside it, as `truth_path` says.
        overwrite: replace files that are there.

    Raises:
        RecordingError: the toml or a data file is missing or malformed, or the two disagree.
        MeshError: the declared triangles are no sheet.
        OutputError: an output exists, or cannot be written.
    """
    folder, out = Path(folder), Path(out)
    said = read_recording_toml(folder / "recording.toml" if recording_toml is None else Path(recording_toml))
    frames, names, steps = _frames_in_world(folder, said)
    rest = frames[0]
    mesh = _declared_mesh(folder, said, rest)
    clock = _clock(folder, said, len(frames))
    tool = Tool.read(folder, said, rest, name=names[0], origin=clock.origin)
    name = identity(said.name, frames)
    truth = _truth(folder, said, rest, mesh, name)
    beside = truth_path(out)
    for path in (out, beside):
        if path.exists() and not overwrite:
            raise OutputError(f"{path} exists; choose another path, or allow it to be replaced (--overwrite).")
    skipped: list[tuple[str, str]] = []
    n_frames, n_unseen, before = 0, 0, 0
    with RecordingWriter(
        out,
        camera=None,
        declaration=replace(said.declaration, mesh=mesh),
        metadata={"name": said.name, "source": said.source, "identity": name},
        overwrite=overwrite,
    ) as writer:
        for number, (positions, file) in enumerate(zip(frames, names, strict=True)):
            unseen = ~np.isfinite(positions).all(axis=1)
            if unseen.all() or tool.unknown(positions):
                skipped.append((file, "no finite point" if unseen.all() else "no grasped point seen"))
                continue
            time, run, began = clock.times[number], clock.runs[number], clock.began[number]
            writer.write(
                Observation(
                    index=n_frames,
                    time=time,
                    tool=tool.state(step=steps[number], time=time, run=run, began=began, positions=positions),
                    reports=tool.reports.between(before, time) if tool.reports is not None else (),
                    points=MeasuredPoints(positions=positions, track_id=np.arange(len(rest)), sd=said.noise_sd),
                )
            )
            n_frames, n_unseen, before = n_frames + 1, n_unseen + int(unseen.sum()), time
    if truth is not None:
        write_truth(beside, truth, overwrite=overwrite)
    n_held = int(mesh.held.sum()) if mesh is not None and mesh.held is not None else len(tool.held)
    return ImportSummary(
        recording=out,
        truth=None if truth is None else beside,
        n_frames=n_frames,
        n_points=len(rest),
        n_unseen=n_unseen,
        n_vertices=None if mesh is None else len(mesh.vertices),
        n_held=n_held,
        n_attached=None if truth is None else int(truth.attached.sum()),
        skipped=tuple(skipped),
    )


def _frames_in_world(folder: Path, said: MeasuredRecording) -> tuple[Float[np.ndarray, "t n 3"], list[str], list[int]]:
    """Frames in the world [m], the rest frame first and usable; their names; how many frames after rest they lie."""
    frames, names = read_frames(folder, said.points)
    if said.points.rest >= len(frames):
        raise RecordingError(f"[points] rest is {said.points.rest}; there are {len(frames)} frames, counted from 0.")
    order = [said.points.rest, *(number for number in range(len(frames)) if number != said.points.rest)]
    frames = frames[order] * said.unit @ said.frame.rotation.T + said.frame.translation
    frames[~np.isfinite(frames).all(axis=2)] = np.nan
    names = [names[number] for number in order]
    if np.isfinite(frames[0]).all(axis=1).sum() < 3:
        raise RecordingError(f"the rest frame {names[0]} has fewer than three finite points; choose another rest.")
    return frames, names, [number - said.points.rest for number in order]


@dataclass(frozen=True, kw_only=True)
class _Clock:
    """Of each frame."""

    times: list[int]
    """[ns]."""
    runs: list[int]
    """From 1."""
    began: list[int]
    """When its run began [ns]."""
    origin: float
    """Time of the first frame where the data have times [s]."""


def _clock(folder: Path, said: MeasuredRecording, count: int) -> _Clock:
    points, seconds, numbers = said.points, np.arange(float(count)), np.zeros(count)
    if points.times is not None:
        seconds = read_npz(folder / points.files[0], points.times)
    if points.runs is not None:
        numbers = read_npz(folder / points.files[0], points.runs)
    if seconds.shape != (count,) or numbers.shape != (count,) or not (np.diff(seconds) > 0).all():
        raise RecordingError(
            f"[points] times must rise and have one entry for each of the {count} frames, and so must runs; they have "
            f"shapes {seconds.shape} and {numbers.shape}."
        )
    scale = 1e9 if said.period is None else said.period
    times = [round((one - seconds[0]) * scale) for one in seconds]
    first = np.append(True, np.diff(numbers) != 0)
    started = np.maximum.accumulate(np.where(first, np.arange(count), 0))
    return _Clock(
        times=times,
        runs=np.cumsum(first).tolist(),
        began=[times[number] for number in started],
        origin=float(seconds[0]),
    )


def _declared_mesh(folder: Path, said: MeasuredRecording, rest: Float[np.ndarray, "n 3"]) -> DeclaredMesh | None:
    if said.faces is None and said.extension is None:
        return None
    rows, faces = np.flatnonzero(np.isfinite(rest).all(axis=1)), None
    if said.faces is not None:
        npz = folder / said.points.files[0] if said.points.key is not None else None
        rows, faces = _seen_faces(rest, read_faces(folder, said.faces, npz=npz, first_vertex=said.first_vertex))
    if said.extension is not None:
        return _extended(rest, rows, faces, said.extension)
    assert faces is not None
    check_mesh(rest[rows], faces)
    return DeclaredMesh(vertices=rest[rows], faces=faces, track_id=rows)


def _seen_faces(
    rest: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "f 3"]
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, "g 3"]]:
    """The rows that carry triangles, and the triangles renumbered to them; those with an unseen corner are left out."""
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
    """The measured points and their continuation, triangulated anew, turned as the measured triangles are."""
    if faces is not None:
        check_mesh(rest[rows], faces)
    plane = SheetPlane.through(rest[rows], extension.axis)
    flat = plane.flatten(rest[rows])
    begin, end = sorted((plane.along(extension.begin), plane.along(extension.end)))
    added = extend(flat, begin=begin, end=end, spacing=extension.spacing)
    vertices = np.concatenate([rest[rows], plane.raise_up(added)])
    spacing = max(extension.spacing, _spacing(flat))
    new_faces = triangulate(np.concatenate([flat, added]), LONGEST_EDGE * spacing)
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
    folder: Path, said: MeasuredRecording, rest: Float[np.ndarray, "n 3"], mesh: DeclaredMesh | None, name: str
) -> Truth | None:
    """Presence of attachments only; nothing is known of true positions, so there are no frames."""
    if said.attached is None:
        return None
    if isinstance(said.attached, Rows):
        nothing = said.attached.file is None and not said.attached.rows
        rows = () if nothing else read_rows(folder, said.attached, len(rest), "[truth]")
        known = np.isin(np.arange(len(rest)), rows)
        vertices, faces, attached = _truth_sheet(rest, known, mesh)
    else:
        assert mesh is not None and said.extension is not None
        plane = SheetPlane.through(mesh.vertices[mesh.track_id >= 0], said.extension.axis)
        vertices, faces, attached = mesh.vertices, mesh.faces, plane.beyond(mesh.vertices, said.attached)
    return Truth(
        rest=vertices,
        faces=faces,
        attached=attached,
        frames=(),
        scene=said.name,
        identity=name,
        details=said.truth_details,
    )


def _truth_sheet(
    rest: Float[np.ndarray, "n 3"], known: Bool[np.ndarray, " n"], mesh: DeclaredMesh | None
) -> tuple[Float[np.ndarray, "m 3"], Int[np.ndarray, "f 3"], Bool[np.ndarray, " m"]]:
    """Vertices, triangles and attachments: of the declared mesh, or of the seen rows, triangulated in their plane."""
    if mesh is not None:
        return mesh.vertices, mesh.faces, np.where(mesh.track_id >= 0, known[mesh.track_id], False)
    rows = np.flatnonzero(np.isfinite(rest).all(axis=1))
    flat = SheetPlane.through(rest[rows]).flatten(rest[rows])
    used, renumbered = np.unique(triangulate(flat, LONGEST_EDGE * _spacing(flat)), return_inverse=True)
    rows = rows[used]
    return rest[rows], renumbered.reshape(-1, 3), known[rows]


def _spacing(flat: Float[np.ndarray, "m 2"]) -> float:
    """Typical distance between neighbours [m]."""
    return float(np.median(KDTree(flat).query(flat, k=2)[0][:, 1]))


def _upward(plane: SheetPlane, vertices: Float[np.ndarray, "m 3"], faces: Int[np.ndarray, "f 3"]) -> float:
    """Sum of the triangles' normals along the plane's upward axis [m^2]."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return float((np.cross(b - a, c - a) @ plane.axes[2]).sum())
