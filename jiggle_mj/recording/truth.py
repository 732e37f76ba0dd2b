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
from mcap.records import Message

from ..errors import RecordingError
from ..toml_kinds import count, text
from ..truth import Truth, TruthFrame
from .declaration import METADATA, file_metadata
from .json_values import entry, parse_object
from .mcap_files import McapOutput, read_arrays
from .messages import checked_stamp, parse_message, read_messages, refuse_disorder
from .schemas import WORLD, fill_pose, parse_points, point_cloud, timestamp
from .stored_arrays import StoredArrays

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
        salt: random text that went into the identity of a secret scene; empty for others.
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
        salt: str = "",
        overwrite: bool = False,
    ) -> None:
        self._origin = {"scene": scene, "identity": identity} | ({"salt": salt} if salt else {})
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
    content = read_messages(path, (TRUTH_REST, TRUTH_POINTS, TRUTH_TOOL, TRUTH_FRAME), allow_truncated=allow_truncated)
    origin = content.metadata.get(DETAILS, {})
    if not content.messages[TRUTH_REST] or FACES not in content.attachments or not origin:
        raise RecordingError(
            f"{path} is not a truth file: it needs {TRUTH_REST} and {FACES}; its topics are: {content.topics}."
        )
    rest = _columns(content.messages[TRUTH_REST][0], TRUTH_REST, path)
    positions = _positions(rest, None, finite=True)
    n = len(positions)
    if n == 0:
        raise RecordingError(f"{path} is damaged: {TRUTH_REST} has no vertices.")
    frames = tuple(
        _parse_frame(points, tool, frame, n, path)
        for points, tool, frame in content.frames(TRUTH_POINTS, TRUTH_TOOL, TRUTH_FRAME, complete=not allow_truncated)
    )
    refuse_disorder(frames, path)
    where = f"{path}: {DETAILS}"
    return Truth(
        rest=positions,
        faces=StoredArrays(read_arrays(content.attachments[FACES], path), f"{path}: {FACES}").indices(
            "faces", (None, 3), below=n
        ),
        attached=rest.flags("attached", (n,)),
        frames=frames,
        scene=entry(origin, "scene", text, where),
        identity=origin.get("identity", ""),
        details=parse_object(entry(origin, "details", text, where), where),
    )


def salt(path: Path) -> str:
    """Return the salt of the identity that a truth file states; empty where it states none.

    Raises:
        RecordingError: missing, not an MCAP, truncated, damaged.
    """
    return read_messages(path, (), allow_truncated=True).metadata.get(DETAILS, {}).get("salt", "")


def _parse_frame(points: Message, tool: Message, frame: Message, n: int, path: Path) -> TruthFrame:
    columns = _columns(points, TRUTH_POINTS, path)
    tip = parse_message(PoseInFrame, tool.data, f"{path}: {TRUTH_TOOL}").pose.position
    where = f"{path}: {TRUTH_FRAME}"
    stiffness = columns.numbers("stiffness", (n,))
    if (stiffness < 0).any():
        raise RecordingError(f"{path}: {TRUTH_POINTS} has a stiffness below 0: {np.nanmin(stiffness):.3g} N/m.")
    return TruthFrame(
        index=entry(parse_object(frame.data, where), "index", count, where),
        time=checked_stamp(points.log_time, TRUTH_POINTS),
        positions=_positions(columns, n),
        stiffness=stiffness,
        tip=np.array([tip.x, tip.y, tip.z]),
        load=columns.numbers("load", (n,)) if "load" in columns else None,
    )


def _columns(message: Message, topic: str, path: Path) -> StoredArrays:
    where = f"{path}: {topic}"
    return StoredArrays(parse_points(parse_message(PointCloud, message.data, where), where), where)


def _positions(columns: StoredArrays, n: int | None, *, finite: bool = False) -> Float[np.ndarray, "n 3"]:
    return np.column_stack([columns.positions(name, (n,), finite=finite) for name in "xyz"])
