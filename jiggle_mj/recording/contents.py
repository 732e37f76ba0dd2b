"""The contents of a recording's file: its topics, its small messages, and the place of its images and points.

Reads the topics of `topics.SCHEMAS` and the JSON ones, and counts the messages of others; `refusals` says what is no
recording. Images and points are handed out later, still encoded: `pairing` groups them into frames, `reader` turns
them into observations.
"""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration as CalibrationMessage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from mcap.records import Attachment, Channel, Message, Metadata, Schema

from ..actions import Cut, Suture
from ..errors import MAX_SHOWN, RecordingError
from ..observation import Declaration
from .bag_refusal import refuse_bag
from .declaration import DECLARATION, DECLARED_MESH, METADATA, parse_declaration, with_mesh
from .events import parse_event
from .force import ToolForce, parse_force
from .frames import FrameTree
from .mcap_files import iterate_records
from .messages import checked_stamp, parse_message
from .pairing import Stamped
from .refusals import refuse_incomplete, refuse_truth
from .schemas import parse_grasp, stamp_of
from .topics import EVENT, FORCE, GRASP, JSON_TOPICS, LEFT, POINTS, POSE, RIGHT, SCHEMAS

MAX_MESSAGES = 1_000_000
"""Most messages of the topics that are read: a report of the tool each ms for a quarter of an hour, 1 GB in memory."""


class RecordingContents:
    """The messages of one file, which the constructor reads from end to end.

    Raises:
        RecordingError: missing, not an MCAP, truncated, damaged, foreign, holding truth, uncalibrated.
    """

    def __init__(self, path: Path, *, allow_truncated: bool) -> None:
        refuse_bag(path)
        self.path, self._allow_truncated = path, allow_truncated
        self.metadata: dict[str, str] = {}
        self.declaration, self.declared = Declaration(), False
        self.frames = FrameTree()
        self.calibrations: dict[str, CalibrationMessage] = {}
        self.poses: dict[int, PoseInFrame] = {}
        self.grasps: dict[int, dict[str, Any]] = {}
        self.stamped: dict[str, list[Stamped]] = {topic: [] for topic in (LEFT, RIGHT, POINTS, POSE, GRASP)}
        self.events: list[tuple[int, Cut | Suture]] = []
        """Cuts and sutures, each with its stamp [ns], by stamp."""
        self.forces: list[ToolForce] = []
        """Forces on the tool by time."""
        self._classes: dict[int, Any] = {}
        self._json: set[int] = set()
        self._declared_mesh: Attachment | None = None
        ignored: Counter[str] = Counter()
        n_read = 0
        for ordinal, topic, message in self._messages():
            n_read += topic in JSON_TOPICS or topic in SCHEMAS
            if n_read > MAX_MESSAGES:
                raise RecordingError(
                    f"{path} has more than {MAX_MESSAGES} messages; cut it into shorter recordings, or thin "
                    f"the reports on {POSE}."
                )
            if topic == EVENT:
                self.events.append((checked_stamp(message.log_time, topic), parse_event(message.data)))
            elif topic == FORCE and message.channel_id in self._json:
                self.forces.append(parse_force(message.data, checked_stamp(message.log_time, topic)))
            elif topic == GRASP or topic in SCHEMAS:
                self._store(ordinal, topic, message)
            else:
                ignored[topic] += 1
        if self._declared_mesh is not None:
            self.declaration = with_mesh(self.declaration, self._declared_mesh, path)
        self.events.sort(key=lambda event: event[0])
        self.forces.sort(key=lambda force: force.time)
        self.ignored = dict(sorted(ignored.items()))
        present = {topic for topic, messages in self.stamped.items() if messages} | set(self.calibrations)
        refuse_incomplete(path, present, self.ignored)

    @property
    def has_images(self) -> bool:
        """Return whether the file holds an image."""
        return bool(self.stamped[LEFT] or self.stamped[RIGHT])

    def encoded(self, wanted: dict[int, str]) -> Iterator[tuple[int, Any]]:
        """Yield messages with their ordinals in file order; images are parsed and not yet decoded.

        Args:
            wanted: topic of each wanted message by its ordinal.
        """
        for ordinal, topic, message in self._messages():
            if ordinal in wanted:
                yield ordinal, self._parse(topic, message)

    def _store(self, ordinal: int, topic: str, message: Message) -> None:
        stamp = message.log_time
        if topic == GRASP:
            self.grasps[ordinal] = parse_grasp(message.data)
        else:
            parsed = self._parse(topic, message)
            if isinstance(parsed, CalibrationMessage):
                self.calibrations.setdefault(topic, parsed)
                return
            if isinstance(parsed, FrameTransforms | FrameTransform):
                self.frames.add(parsed.transforms if isinstance(parsed, FrameTransforms) else (parsed,))
                return
            if isinstance(parsed, PoseInFrame):
                self.poses[ordinal] = parsed
            if parsed.HasField("timestamp"):
                stamp = stamp_of(parsed)
        self.stamped[topic].append(Stamped(stamp=checked_stamp(stamp, topic), ordinal=ordinal))

    def _messages(self) -> Iterator[tuple[int, str, Message]]:
        """Yield each message with its ordinal and topic; store metadata and declaration as they come."""
        schemas: dict[int, Schema] = {}
        topics: dict[int, str] = {}
        ordinal = 0
        for record in iterate_records(self.path, allow_truncated=self._allow_truncated):
            if isinstance(record, Message):
                if record.channel_id not in topics:
                    raise RecordingError(
                        f"{self.path} is damaged: a message has the unknown channel {record.channel_id}."
                    )
                yield ordinal, topics[record.channel_id], record
                ordinal += 1
            elif isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                refuse_truth(self.path, record.topic)
                refuse_bag(self.path, record.message_encoding)
                topics[record.id] = record.topic
                self._choose_class(record, schemas.get(record.schema_id))
            elif isinstance(record, Metadata):
                if record.name == METADATA:
                    self.metadata = dict(record.metadata)
                elif record.name == DECLARATION:
                    self.declaration = parse_declaration(record.metadata.get("json", ""))
                    self.declared = True
            elif record.name == DECLARED_MESH:
                self._declared_mesh = record

    def _parse(self, topic: str, message: Message) -> Any:
        return parse_message(self._classes[message.channel_id], message.data, f"{self.path}: a message on {topic}")

    def _choose_class(self, channel: Channel, schema: Schema | None) -> None:
        name = (schema.name if schema else "without a schema")[:MAX_SHOWN]
        encoding = channel.message_encoding[:MAX_SHOWN]
        if encoding == "json":
            self._json.add(channel.id)
        if channel.topic in JSON_TOPICS and encoding != "json":
            raise RecordingError(f"{self.path}: {channel.topic} is {name} ({encoding}); it must be JSON.")
        if channel.topic not in SCHEMAS:
            return
        allowed = {each.DESCRIPTOR.full_name: each for each in SCHEMAS[channel.topic]}
        if encoding != "protobuf" or name not in allowed:
            raise RecordingError(
                f"{self.path}: {channel.topic} is {name} ({encoding}); it must be {' or '.join(allowed)} (protobuf)."
            )
        self._classes[channel.id] = allowed[name]
