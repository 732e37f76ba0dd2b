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
from typing import Any, Self, TypeVar, cast

import numpy as np
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.Point3_pb2 import Point3
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from jaxtyping import Float
from mcap.records import Attachment, Channel, Message, Metadata

from ..errors import RecordingError
from ..estimate import Belief, Detection, Estimate, Sheet
from .declaration import METADATA, file_metadata
from .mcap_files import McapOutput, iterate_records, read_arrays
from .schemas import WORLD, fill_pose, parse_points, point_cloud, timestamp

ESTIMATE_POINTS, ESTIMATE_MESH, DIAGNOSTICS = "/estimate/points", "/estimate/mesh", "/diagnostics/filter"
"""Topics."""
SHEET, BELIEF, DETECTION = "sheet.npz", "belief.npz", "detection.npz"
"""Attachments."""
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
Stored = TypeVar("Stored")
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

    def finish(self, belief: Belief, detection: Detection, *, skipped: Sequence[tuple[int, str]] = ()) -> None:
        """Write the final belief and detection, and close the file.

        Args:
            belief: the belief after the last frame.
            detection: the particles called attached by that belief.
            skipped: index and reason of each observation that was not used.
        """
        output = self._output
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


def read_estimate(path: str | os.PathLike[str], *, allow_truncated: bool = False) -> EstimateRecording:
    """Read an estimate and return it.

    Raises:
        RecordingError: missing, not an MCAP, truncated, damaged, not an estimate, or written by another version.
    """
    path = Path(path)
    topics: dict[int, str] = {}
    messages: dict[str, list[Message]] = {ESTIMATE_POINTS: [], DIAGNOSTICS: []}
    arrays: dict[str, dict[str, np.ndarray]] = {}
    metadata: dict[str, dict[str, str]] = {}
    for record in iterate_records(path, allow_truncated=allow_truncated):
        if isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Message) and topics[record.channel_id] in messages:
            messages[topics[record.channel_id]].append(record)
        elif isinstance(record, Attachment) and record.name in (SHEET, BELIEF, DETECTION):
            arrays[record.name] = read_arrays(record, path)
        elif isinstance(record, Metadata):
            metadata[record.name] = dict(record.metadata)
    if SHEET not in arrays:
        names = ", ".join(sorted(set(topics.values()))) or "none"
        raise RecordingError(f"{path} is not an estimate: it lacks {SHEET}; its topics are: {names}.")
    result = metadata.get(RESULT_RECORD)
    return EstimateRecording(
        sheet=_stored(Sheet, arrays[SHEET], path),
        estimates=tuple(_parse(*pair) for pair in zip(messages[ESTIMATE_POINTS], messages[DIAGNOSTICS], strict=False)),
        belief=_stored(Belief, arrays[BELIEF], path) if result else None,
        detection=_stored(Detection, arrays[DETECTION] | {"rule": result["rule"]}, path) if result else None,
        skipped=tuple((index, why) for index, why in json.loads(result["skipped"])) if result else (),
        metadata=metadata.get(METADATA, {}),
    )


def _parse(points: Message, diagnostics: Message) -> Estimate:
    columns = parse_points(PointCloud.FromString(points.data), ESTIMATE_POINTS)
    diagnosed = json.loads(diagnostics.data)
    numbers = {
        name: math.nan if diagnosed[name] is None else float(diagnosed[name])
        for name in ("entropy", "nis", "boundary_energy")
    }
    return Estimate(
        index=diagnosed["index"],
        time=points.log_time,
        positions=np.column_stack([columns[axis] for axis in "xyz"]),
        observed=np.column_stack([columns[f"observed_{axis}"] for axis in "xyz"]),
        mean=columns["b_mean"],
        sd=columns["b_sd"],
        probability=columns["p_attached"],
        held=columns["held"].astype(bool),
        update_s=0.0,
        perception_s=0.0,
        converged=diagnosed.get("converged", True),
        **numbers,
    )


def _stored(kind: type[Stored], values: dict[str, Any], path: Path) -> Stored:
    """Return a dataclass from its stored arrays; arrays without a dimension become numbers."""
    known = fields(cast(Any, kind))
    missing = [field.name for field in known if field.default is MISSING and field.name not in values]
    if missing:
        raise RecordingError(
            f"{path} was written by another version of jiggle-mj: its {kind.__name__} lacks {', '.join(missing)}. "
            "Estimate again from the recording."
        )
    numbers = {name: value.item() if getattr(value, "ndim", 1) == 0 else value for name, value in values.items()}
    return kind(**{field.name: numbers[field.name] for field in known if field.name in numbers})


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
