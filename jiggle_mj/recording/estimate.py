"""The estimate as a file: the sheet, one estimate per frame, and the final belief and detection.

Foxglove and Rerun draw `/estimate/points`; Foxglove also draws `/estimate/mesh`. Wall times are not written: the same
estimate gives the same bytes.
"""

import json
import math
import os
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from jaxtyping import Float
from mcap.records import Message

from ..errors import RecordingError
from ..estimate import Belief, Detection, Estimate, KeptFrames, Sheet
from ..toml_kinds import count, flag, number, text
from .declaration import METADATA, file_metadata
from .json_values import entry, optional, parse_list, parse_object
from .kept_frames import KEPT_FRAMES, MAX_KEPT_BYTES, frames_from_arrays, frames_to_arrays
from .mcap_files import McapOutput, read_arrays
from .messages import checked_stamp, parse_message, read_messages, refuse_disorder
from .schemas import WORLD, fill_pose, parse_points, point_cloud, timestamp
from .stored_arrays import StoredArrays

ESTIMATE_POINTS, ESTIMATE_MESH, DIAGNOSTICS = "/estimate/points", "/estimate/mesh", "/diagnostics/filter"
"""Topics."""
SHEET, BELIEF, DETECTION = "sheet.npz", "belief.npz", "detection.npz"
"""Attachments."""
ESTIMATE_AGAIN = "Estimate the recording again; read_estimate(path, allow_truncated=True) reads the frames that remain."
"""What to do about an estimate that was cut off."""
RESULT_RECORD = "jiggle_mj.result"
"""Metadata record with the detection's rule and the skipped frames."""
DIAGNOSTICS_SCHEMA: dict[str, object] = {
    "title": "jiggle_mj.FilterDiagnostics",
    "type": "object",
    "properties": {
        "index": {"type": "integer", "description": "index of the observation"},
        "entropy": {"type": ["number", "null"], "description": "differential entropy of the belief [nat]"},
        "nis": {"type": ["number", "null"], "description": "normalised innovation squared per degree of freedom"},
        "boundary_energy": {"type": ["number", "null"], "description": "mean energy in the attachments [J]"},
        "skipped": {"type": "integer", "description": "observations skipped so far"},
        "converged": {"type": "boolean", "description": "whether the search for the positions came to an end"},
    },
    "required": ["index", "entropy", "nis", "boundary_energy", "skipped"],
}
COLOURS = np.array(
    [[0.267, 0.005, 0.329], [0.229, 0.322, 0.546], [0.128, 0.567, 0.551], [0.369, 0.789, 0.383], [0.993, 0.906, 0.144]]
)
"""Colours from free to attached, RGB in 0..1: five of matplotlib's viridis (CC0), whose brightness rises."""
HALF_COLOUR = 1.0
"""Stiffness of the middle colour [N/m]: b is drawn as b / (b + this), which is 1 for a weld."""


class EstimateWriter:
    """Write estimates to a file as they come; what is written survives a crash.

    Args:
        path: the file to write.
        sheet: the particles, the same for all frames.
        metadata: entries of the caller, such as the recording's name and the settings.
        overwrite: replace an existing file.

    Raises:
        OutputError: the path exists, or cannot be written.
    """

    def __init__(
        self, path: str | os.PathLike[str], sheet: Sheet, metadata: dict[str, str], *, overwrite: bool = False
    ) -> None:
        self._sheet = sheet
        self._output = McapOutput(path, overwrite=overwrite)
        self._output.metadata(METADATA, file_metadata() | metadata)
        self._output.arrays(SHEET, {"rest": np.asarray(sheet.rest), "faces": np.asarray(sheet.faces)})
        self._output.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()

    def write(self, estimate: Estimate, *, n_skipped: int = 0) -> None:
        """Write one frame, and hand it to the operating system.

        Args:
            estimate: the belief after an observation.
            n_skipped: observations skipped so far.
        """
        output, time = self._output, estimate.time
        columns = dict(zip("xyz", np.asarray(estimate.positions, float).T, strict=True))
        for prefix, positions in (("observed", estimate.observed), ("rest", self._sheet.rest)):
            columns |= {f"{prefix}_{axis}": np.asarray(positions, float)[:, i] for i, axis in enumerate("xyz")}
        columns |= {"b_mean": np.asarray(estimate.mean, float), "b_sd": np.asarray(estimate.sd, float)}
        columns["p_attached"] = np.asarray(estimate.probability, float)
        output.message(ESTIMATE_POINTS, time, point_cloud(time, columns | {"held": np.asarray(estimate.held, bool)}))
        output.message(ESTIMATE_MESH, time, _mesh_message(estimate, self._sheet))
        numbers = {name: _json_number(getattr(estimate, name)) for name in ("entropy", "nis", "boundary_energy")}
        output.json(
            DIAGNOSTICS,
            time,
            {"index": int(estimate.index), "skipped": n_skipped, "converged": estimate.converged, **numbers},
            schema=DIAGNOSTICS_SCHEMA,
        )
        output.flush()

    def finish(
        self,
        belief: Belief,
        detection: Detection,
        *,
        skipped: Sequence[tuple[int, str]] = (),
        frames: KeptFrames | None = None,
    ) -> None:
        """Write the final belief and detection, and close the file.

        Args:
            belief: the belief after the last frame.
            detection: the particles called attached by that belief.
            skipped: index and reason of each observation that was not used.
            frames: what `identify` needs to use the estimate again; left out above `MAX_KEPT_BYTES`.
        """
        output = self._output
        if frames is not None and frames.nbytes <= MAX_KEPT_BYTES:
            output.arrays(KEPT_FRAMES, frames_to_arrays(frames))
        for name, result, excluded in ((BELIEF, belief, ()), (DETECTION, detection, ("rule",))):
            values = {field.name: getattr(result, field.name) for field in fields(result) if field.name not in excluded}
            output.arrays(name, {key: np.asarray(value) for key, value in values.items() if value is not None})
        reasons = json.dumps([[int(index), why] for index, why in skipped])
        output.metadata(RESULT_RECORD, {"rule": detection.rule, "skipped": reasons})
        self.close()

    def close(self) -> None:
        """Write the index and close the file; without `finish` the file has no belief."""
        self._output.close()


@dataclass(frozen=True, kw_only=True)
class EstimateRecording:
    """An estimate read from a file."""

    sheet: Sheet
    """Particles of the estimator."""
    estimates: tuple[Estimate, ...]
    """The estimate after each frame; wall times are 0, as the file has none."""
    belief: Belief | None
    """Final belief; None where the run did not finish."""
    detection: Detection | None
    """Final detection; None where the run did not finish."""
    skipped: tuple[tuple[int, str], ...]
    """Index and reason of each observation that was not used."""
    metadata: dict[str, str]
    """Versions, units and the settings of the estimator."""
    frames: KeptFrames | None = None
    """What the filter kept of its frames; None where it is not stored."""


def read_estimate(path: str | os.PathLike[str], *, allow_truncated: bool = False) -> EstimateRecording:
    """Read an estimate and return it.

    Raises:
        RecordingError: missing, not an MCAP, truncated, damaged, not an estimate, or written by another version.
    """
    path = Path(path)
    content = read_messages(path, (ESTIMATE_POINTS, DIAGNOSTICS), allow_truncated=allow_truncated, cure=ESTIMATE_AGAIN)
    if SHEET not in content.attachments:
        raise RecordingError(f"{path} is not an estimate: it lacks {SHEET}; its topics are: {content.topics}.")
    arrays = {
        name: StoredArrays(read_arrays(content.attachments[name], path), f"{path}: {name}")
        for name in (SHEET, BELIEF, DETECTION, KEPT_FRAMES)
        if name in content.attachments
    }
    rest = arrays[SHEET].positions("rest", (None, 3), finite=True)
    n = len(rest)
    if n == 0:
        raise RecordingError(f"{path} is damaged: {SHEET} has no particles.")
    result = content.metadata.get(RESULT_RECORD)
    finished = result is not None and BELIEF in arrays and DETECTION in arrays
    frames = tuple(
        _parse(points, diagnostics, n, path)
        for points, diagnostics in content.frames(ESTIMATE_POINTS, DIAGNOSTICS, complete=not allow_truncated)
    )
    refuse_disorder(frames, path)
    return EstimateRecording(
        sheet=Sheet(rest=rest, faces=arrays[SHEET].indices("faces", (None, 3), below=n)),
        estimates=frames,
        belief=_belief(arrays[BELIEF], n, path) if finished else None,
        detection=_detection(arrays[DETECTION], result, n, path) if finished and result else None,
        skipped=_skipped(result, path) if result else (),
        metadata=content.metadata.get(METADATA, {}),
        frames=frames_from_arrays(arrays[KEPT_FRAMES], n, str(path)) if KEPT_FRAMES in arrays else None,
    )


def _parse(points: Message, diagnostics: Message, n: int, path: Path) -> Estimate:
    where = f"{path}: {ESTIMATE_POINTS}"
    columns = StoredArrays(parse_points(parse_message(PointCloud, points.data, where), where), where)
    values, named = parse_object(diagnostics.data, DIAGNOSTICS), f"{path}: {DIAGNOSTICS}"

    def number_or_nan(name: str) -> float:
        value = entry(values, name, optional(number), named)
        return math.nan if value is None else value

    return Estimate(
        index=entry(values, "index", count, named),
        time=checked_stamp(points.log_time, where),
        positions=np.column_stack([columns.positions(axis, (n,)) for axis in "xyz"]),
        observed=np.column_stack([columns.positions(f"observed_{axis}", (n,)) for axis in "xyz"]),
        mean=columns.numbers("b_mean", (n,)),
        sd=columns.numbers("b_sd", (n,)),
        probability=columns.numbers("p_attached", (n,)),
        held=columns.flags("held", (n,)),
        update_s=0.0,
        perception_s=0.0,
        converged=entry(values, "converged", flag, named, True),
        entropy=number_or_nan("entropy"),
        nis=number_or_nan("nis"),
        boundary_energy=number_or_nan("boundary_energy"),
    )


def _belief(arrays: StoredArrays, n: int, path: Path) -> Belief:
    _refuse_other_version(Belief, arrays, set(), path)
    return Belief(
        mean=arrays.numbers("mean", (n,)),
        covariance=arrays.numbers("covariance", (n, n)),
        reference=_scalar(arrays, "reference"),
        lower=arrays.numbers("lower", (n,)) if "lower" in arrays else None,
        upper=arrays.numbers("upper", (n,)) if "upper" in arrays else None,
    )


def _detection(arrays: StoredArrays, result: dict[str, str], n: int, path: Path) -> Detection:
    _refuse_other_version(Detection, arrays, {"rule"}, path)
    return Detection(
        attached=arrays.flags("attached", (n,)),
        score=arrays.numbers("score", (n,)),
        stiffness=arrays.numbers("stiffness", (n,)),
        stiffness_sd=arrays.numbers("stiffness_sd", (n,)),
        probabilistic=bool(arrays.flags("probabilistic", ())) if "probabilistic" in arrays else False,
        converged=bool(arrays.flags("converged", ())) if "converged" in arrays else True,
        force_sd_ratio=_scalar(arrays, "force_sd_ratio"),
        position_sd_ratio=_scalar(arrays, "position_sd_ratio"),
        rule=entry(result, "rule", text, f"{path}: {RESULT_RECORD}"),
    )


def _scalar(arrays: StoredArrays, name: str) -> float | None:
    return arrays.scalar(name) if name in arrays else None


def _skipped(result: dict[str, str], path: Path) -> tuple[tuple[int, str], ...]:
    where = f"{path}: {RESULT_RECORD} skipped"

    def reason(value: Any) -> tuple[int, str]:
        if not isinstance(value, list) or len(value) != 2:
            raise TypeError("a list [index, reason]")
        return count(value[0]), text(value[1])

    return tuple(parse_list(entry(result, "skipped", text, where), reason, where))


def _refuse_other_version(
    kind: type[Belief | Detection], arrays: StoredArrays, elsewhere: set[str], path: Path
) -> None:
    """Refuse arrays that lack a field of the dataclass which has no default."""
    needed = [field.name for field in fields(kind) if field.default is MISSING and field.name not in elsewhere]
    missing = [name for name in needed if name not in arrays]
    if missing:
        raise RecordingError(
            f"{path} was written by another version of jiggle-mj: its {kind.__name__} lacks {', '.join(missing)}. "
            "Estimate again from the recording."
        )


def _json_number(value: float) -> float | None:
    """Return the number, or None where it is not finite: JSON has no NaN."""
    return float(value) if math.isfinite(value) else None


def _mesh_message(estimate: Estimate, sheet: Sheet) -> SceneUpdate:
    message = SceneUpdate()
    entity = message.entities.add(timestamp=timestamp(estimate.time), frame_id=WORLD, id="sheet")
    triangles = entity.triangles.add()
    fill_pose(triangles.pose, np.zeros(3))
    triangles.points.extend(Point3(x=x, y=y, z=z) for x, y, z in np.asarray(estimate.positions, float).tolist())
    colours = stiffness_colours(np.asarray(estimate.mean, float)).tolist()
    triangles.colors.extend(Color(r=r, g=g, b=b, a=1.0) for r, g, b in colours)
    triangles.indices.extend(np.asarray(sheet.faces).ravel().tolist())
    return message


def stiffness_colours(mean: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
    """Return the colour of each attachment stiffness [N/m] as red, green, blue in 0..1."""
    bounded = np.clip(1 - HALF_COLOUR / (np.maximum(mean, 0) + HALF_COLOUR), 0, 1)
    stops = np.linspace(0, 1, len(COLOURS))
    return np.column_stack([np.interp(bounded, stops, channel) for channel in COLOURS.T])
