"""The truth of a recording, in a file of its own under `/truth/` topics, which every reader of observations refuses.

Written by whoever makes the tissue, frame by frame; read by `jiggle_mj.eval` only.
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

REST, POINTS, TOOL, FRAME = "/truth/rest", "/truth/points", "/truth/tool", "/truth/frame"
DETAILS, FACES = "truth", "truth_faces.npz"
FRAME_SCHEMA: dict[str, object] = {
    "title": "jiggle_mj.TruthFrame",
    "type": "object",
    "properties": {"index": {"type": "integer", "description": "index of the observation"}},
    "required": ["index"],
}


class TruthWriter:
    """Writes the truth as it comes; what is written survives a crash.

    Args:
        path: the file to write.
        rest: rest positions on the visible surface [m].
        faces: triangles.
        attached: which vertices are attached at the start.
        scene: name of the scene or recording.
        identity: of the recording, as its metadata has it.
        details: anything else, JSON-serialisable.
        overwrite: replace a file that is there.

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
        self._said = {"scene": scene, "identity": identity}
        self._output = McapOutput(path, overwrite=overwrite)
        self._output.metadata(METADATA, file_metadata())
        self.conclude(details)
        self._output.arrays(FACES, {"faces": np.asarray(faces)})
        columns = dict(zip("xyz", np.asarray(rest, float).T, strict=True)) | {"attached": np.asarray(attached)}
        self._output.message(REST, 0, point_cloud(0, columns))
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
        output.message(POINTS, time, point_cloud(time, columns))
        tool = PoseInFrame(timestamp=timestamp(time), frame_id=WORLD)
        fill_pose(tool.pose, frame.tip)
        output.message(TOOL, time, tool)
        output.json(FRAME, time, {"index": int(frame.index)}, schema=FRAME_SCHEMA)
        output.flush()

    def conclude(self, details: dict[str, object]) -> None:
        """Write the details, once more with what only the end could know; a reader takes the last."""
        self._output.metadata(DETAILS, self._said | {"details": json.dumps(details, sort_keys=True)})

    def close(self) -> None:
        """Write the index and close the file."""
        self._output.close()


def write_truth(path: str | os.PathLike[str], truth: Truth, *, overwrite: bool = False) -> None:
    """Write a whole truth.

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
    """Read a truth file.

    Raises:
        RecordingError: missing, not an MCAP, truncated, damaged, or not a truth file.
    """
    path = Path(path)
    topics: dict[int, str] = {}
    messages: dict[str, list[Message]] = {REST: [], POINTS: [], TOOL: [], FRAME: []}
    faces, said = None, {}
    for record in iterate_records(path, allow_truncated=allow_truncated):
        if isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Message) and topics[record.channel_id] in messages:
            messages[topics[record.channel_id]].append(record)
        elif isinstance(record, Attachment) and record.name == FACES:
            faces = read_arrays(record, path)["faces"]
        elif isinstance(record, Metadata) and record.name == DETAILS:
            said = record.metadata
    if not messages[REST] or faces is None or not said:
        found = ", ".join(sorted(set(topics.values()))) or "none"
        raise RecordingError(f"{path} is not a truth file: it needs {REST} and {FACES}; its topics are: {found}.")
    rest = parse_points(PointCloud.FromString(messages[REST][0].data), REST)
    frames = zip(messages[POINTS], messages[TOOL], messages[FRAME], strict=False)
    return Truth(
        rest=_positions(rest),
        faces=faces,
        attached=rest["attached"].astype(bool),
        frames=tuple(_parse_frame(*frame) for frame in frames),
        scene=said["scene"],
        identity=said.get("identity", ""),
        details=json.loads(said["details"]),
    )


def _parse_frame(points: Message, tool: Message, frame: Message) -> TruthFrame:
    columns = parse_points(PointCloud.FromString(points.data), POINTS)
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
