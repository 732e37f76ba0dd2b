"""The truth of a recording, in a separate file under `/truth/` topics, which `refusals` keeps from the estimator.

The reference tissue or an importer writes it; only `jiggle_mj.eval` reads it.
"""

import json
import os
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from jaxtyping import Bool, Float, Int
from mcap.records import Attachment, Channel, Message, Metadata

from ..errors import RecordingError
from ..truth import Truth, TruthFrame
from .declaration import METADATA, file_metadata
from .mcap_files import McapOutput, iterate_records, read_arrays
from .schemas import WORLD, fill_pose, parse_points, point_cloud, timestamp

TRUTH_REST, TRUTH_POINTS, TRUTH_TOOL, TRUTH_FRAME = "/truth/rest", "/truth/points", "/truth/tool", "/truth/frame"
"""Topics."""
DETAILS, FACES = "truth", "truth_faces.npz"
"""Names of a metadata record and of an attachment."""
FRAME_SCHEMA: dict[str, object] = {
    "title": "jiggle_mj.TruthFrame",
    "type": "object",
    "properties": {"index": {"type": "integer", "description": "index of the observation"}},
    "required": ["index"],
}


class TruthWriter:
    """Write the truth to a file as it comes; what is written survives a crash.

    Args:
        path: the file to write.
        rest: rest positions on the visible surface [m].
        faces: vertex numbers of each triangle, from 0.
        attached: which vertices are attached at the start.
        scene: name of the scene or recording.
        identity: identity of the recording, as its metadata has it.
        details: further entries, JSON-serialisable.
        overwrite: replace an existing file.

    Raises:
        OutputError: the path exists, or cannot be written.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        rest: Float[np.ndarray, "n 3"],
        faces: Int[np.ndarray, "f 3"],
        attached: Bool[np.ndarray, " n"],
        scene: str,
        details: dict[str, object],
        identity: str = "",
        overwrite: bool = False,
    ) -> None:
        self._origin = {"scene": scene, "identity": identity}
        self._output = McapOutput(path, overwrite=overwrite)
        self._output.metadata(METADATA, file_metadata())
        self.conclude(details)
        self._output.arrays(FACES, {"faces": np.asarray(faces)})
        columns = dict(zip("xyz", np.asarray(rest, float).T, strict=True)) | {"attached": np.asarray(attached)}
        self._output.message(TRUTH_REST, 0, point_cloud(0, columns))
        self._output.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()

    def write(self, frame: TruthFrame) -> None:
        """Write one frame, and hand it to the operating system."""
        output, time = self._output, frame.time
        columns = dict(zip("xyz", np.asarray(frame.positions, float).T, strict=True))
        columns["stiffness"] = np.asarray(frame.stiffness, float)
        if frame.load is not None:
            columns["load"] = np.asarray(frame.load, float)
        output.message(TRUTH_POINTS, time, point_cloud(time, columns))
        tool = PoseInFrame(timestamp=timestamp(time), frame_id=WORLD)
        fill_pose(tool.pose, frame.tip)
        output.message(TRUTH_TOOL, time, tool)
        output.json(TRUTH_FRAME, time, {"index": int(frame.index)}, schema=FRAME_SCHEMA)
        output.flush()

    def conclude(self, details: dict[str, object]) -> None:
        """Write the details again, with what is known only at the end; a reader takes the last ones."""
        self._output.metadata(DETAILS, self._origin | {"details": json.dumps(details, sort_keys=True)})

    def close(self) -> None:
        """Write the index and close the file."""
        self._output.close()


def write_truth(path: str | os.PathLike[str], truth: Truth, *, overwrite: bool = False) -> None:
    """Write a complete truth.

    Raises:
        OutputError: the path exists, or cannot be written.
    """
    with TruthWriter(
        path,
        rest=truth.rest,
        faces=truth.faces,
        attached=truth.attached,
        scene=truth.scene,
        details=truth.details,
        identity=truth.identity,
        overwrite=overwrite,
    ) as writer:
        for frame in truth.frames:
            writer.write(frame)


def read_truth(path: str | os.PathLike[str], *, allow_truncated: bool = False) -> Truth:
    """Read a truth file and return its contents.

    Raises:
        RecordingError: missing, not an MCAP, truncated, damaged, or not a truth file.
    """
    path = Path(path)
    topics: dict[int, str] = {}
    messages: dict[str, list[Message]] = {TRUTH_REST: [], TRUTH_POINTS: [], TRUTH_TOOL: [], TRUTH_FRAME: []}
    faces, origin = None, {}
    for record in iterate_records(path, allow_truncated=allow_truncated):
        if isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Message) and topics[record.channel_id] in messages:
            messages[topics[record.channel_id]].append(record)
        elif isinstance(record, Attachment) and record.name == FACES:
            faces = read_arrays(record, path)["faces"]
        elif isinstance(record, Metadata) and record.name == DETAILS:
            origin = record.metadata
    if not messages[TRUTH_REST] or faces is None or not origin:
        names = ", ".join(sorted(set(topics.values()))) or "none"
        raise RecordingError(f"{path} is not a truth file: it needs {TRUTH_REST} and {FACES}; its topics are: {names}.")
    rest = parse_points(PointCloud.FromString(messages[TRUTH_REST][0].data), TRUTH_REST)
    frames = zip(messages[TRUTH_POINTS], messages[TRUTH_TOOL], messages[TRUTH_FRAME], strict=False)
    return Truth(
        rest=_positions(rest),
        faces=faces,
        attached=rest["attached"].astype(bool),
        frames=tuple(_parse_frame(*frame) for frame in frames),
        scene=origin["scene"],
        identity=origin.get("identity", ""),
        details=json.loads(origin["details"]),
    )


def _parse_frame(points: Message, tool: Message, frame: Message) -> TruthFrame:
    columns = parse_points(PointCloud.FromString(points.data), TRUTH_POINTS)
    tip = PoseInFrame.FromString(tool.data).pose.position
    return TruthFrame(
        index=json.loads(frame.data)["index"],
        time=points.log_time,
        positions=_positions(columns),
        stiffness=columns["stiffness"],
        tip=np.array([tip.x, tip.y, tip.z]),
        load=columns.get("load"),
    )


def _positions(columns: dict[str, np.ndarray]) -> Float[np.ndarray, "n 3"]:
    return np.column_stack([columns[name] for name in "xyz"])
