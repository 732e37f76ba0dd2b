"""Opening ROS bags: which topics a bag has, and its messages, decoded.

Reads ROS 1 `.bag` files, ROS 2 folders, and single `.mcap` and `.db3` files, through the library rosbags. An MCAP file
is read here front to back, because rosbags reads no ROS 1 messages in MCAP. A message type is parsed only when a topic
of it is read, so a definition that nobody needs cannot stop an import.
"""

import re
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from mcap.records import Channel, Message, Schema

from ...errors import RecordingError
from ...recording.mcap_files import iterate_records
from .bag_paths import bag_files, refuse_cut_database, refusing
from .compression import bound_chunks, decompressed_message, take_messages_compressed

ROS_ENCODINGS = ("cdr", "ros1")
"""Encodings of the messages of ROS 2 and ROS 1."""
MAX_NAME = 255
"""Characters of a topic's name, the most that ROS 2 allows."""


@dataclass(frozen=True, kw_only=True)
class BagTopic:
    """One topic of a bag."""

    name: str
    """Name of the topic."""
    type: str
    """Type of its messages in ROS 2's form, such as sensor_msgs/msg/Image."""
    count: int
    """Number of its messages."""
    encoding: str
    """Encoding of its messages: one of `ROS_ENCODINGS`, or a foreign one, which is not decoded."""
    definition: str = ""
    """Definition of the type as the bag holds it; empty where it holds none."""
    definition_format: str = "msg"
    """Language of the definition: `msg` or `idl`."""


@dataclass(frozen=True, kw_only=True)
class BagMessage:
    """One decoded message of a bag."""

    topic: str
    """Name of its topic."""
    number: int
    """Number of the message within its topic, from 0, in the order of the bag."""
    received: int
    """Time at which the recorder received it [ns]."""
    content: Any
    """The message, with the fields of its definition."""


class Bag:
    """A ROS bag that is open for reading.

    Args:
        path: a `.bag`, `.mcap` or `.db3` file, or the folder of a ROS 2 bag.
        allow_truncated: read the complete records of an MCAP file that was cut off.

    Raises:
        RecordingError: the library rosbags is missing, or the bag is missing, damaged or of an unknown kind.
    """

    def __init__(self, path: Path, *, allow_truncated: bool = False) -> None:
        self.path, self._allow_truncated = path, allow_truncated
        self._stack = ExitStack()
        with refusing(path):
            files = bag_files(path)
            for file in files:
                refuse_cut_database(file)
            self._sources = [self._open(file) for file in files]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._stack.close()

    @cached_property
    def topics(self) -> dict[str, BagTopic]:
        """Return the topics by name; one with messages of several types is refused where it is read."""
        merged: dict[str, BagTopic] = {}
        with refusing(self.path):
            for source in self._sources:
                for topic in source.topics():
                    if len(topic.name) > MAX_NAME:
                        raise RecordingError(
                            f"{self.path}: the name of topic '{topic.name[:40]}...' is {len(topic.name)} characters "
                            f"long; at most {MAX_NAME} are read."
                        )
                    known = merged.get(topic.name)
                    merged[topic.name] = topic if known is None else replace(known, count=known.count + topic.count)
        return dict(sorted(merged.items()))

    def messages(self, names: Collection[str]) -> Iterator[BagMessage]:
        """Yield the decoded messages of some topics in the order of the bag.

        Raises:
            RecordingError: the bag is damaged, or a message cannot be decoded by its definition.
        """
        decoders = {name: _Decoder(self.path, self.topics[name]) for name in names}
        numbers: Counter[str] = Counter()
        for name, received, data in self.raw(names):
            content = decoders[name].decode(data)
            yield BagMessage(topic=name, number=numbers[name], received=received, content=content)
            numbers[name] += 1
        for name in names:
            if numbers[name] != self.topics[name].count:
                raise RecordingError(
                    f"{self.path}: {name} has {numbers[name]} of the {self.topics[name].count} messages that the bag "
                    "lists; was it cut off? (Without its metadata.yaml the files are read as they are.)"
                )

    def raw(self, names: Collection[str]) -> Iterator[tuple[str, int, bytes]]:
        """Yield topic, time of receipt [ns] and data of the messages of some topics, in the order of the bag.

        Raises:
            RecordingError: the bag is damaged.
        """
        for source in self._sources if names else []:
            messages = source.messages(set(names))
            while True:
                with refusing(self.path):
                    item = next(messages, None)
                if item is None:
                    break
                yield item

    def _open(self, file: Path) -> "_McapFile | _RosbagsFile":
        if file.suffix == ".mcap":
            return _McapFile(file, allow_truncated=self._allow_truncated)
        from rosbags import rosbag1, rosbag2

        if file.suffix != ".bag":
            reader = self._stack.enter_context(rosbag2.Reader(file))
            return _RosbagsFile(reader, "cdr", compressed=take_messages_compressed(reader))
        reader = self._stack.enter_context(rosbag1.Reader(file))
        bound_chunks(reader)
        return _RosbagsFile(reader, "ros1")


class _RosbagsFile:
    """A bag that rosbags reads: a ROS 1 file, or a ROS 2 folder or sqlite3 file."""

    def __init__(self, reader: Any, encoding: str, *, compressed: bool = False) -> None:
        self._reader, self._encoding, self._compressed = reader, encoding, compressed

    def topics(self) -> Iterator[BagTopic]:
        """Yield the topics; one that several publishers share comes once for each."""
        for connection in self._reader.connections:
            yield BagTopic(
                name=connection.topic,
                type=connection.msgtype,
                count=connection.msgcount,
                encoding=self._encoding,
                definition=connection.msgdef.data,
                definition_format="idl" if connection.msgdef.format.name == "IDL" else "msg",
            )

    def messages(self, names: set[str]) -> Iterator[tuple[str, int, bytes]]:
        """Yield topic, time of receipt [ns] and data of each message."""
        wanted = [connection for connection in self._reader.connections if connection.topic in names]
        if wanted:
            for connection, received, data in self._reader.messages(connections=wanted):
                yield connection.topic, received, decompressed_message(data) if self._compressed else data


class _McapFile:
    """A single MCAP file, with messages of ROS 2 or ROS 1."""

    def __init__(self, path: Path, *, allow_truncated: bool) -> None:
        self._path, self._allow_truncated = path, allow_truncated
        self._topics: dict[str, BagTopic] | None = None

    def topics(self) -> Iterator[BagTopic]:
        """Yield the topics with their counts, which takes a pass over the file."""
        if self._topics is None:
            counts: Counter[str] = Counter()
            for channel, _ in self._records():
                counts[channel.topic] += 1
            self._topics = {name: replace(topic, count=counts[name]) for name, topic in self._seen.items()}
        yield from self._topics.values()

    def messages(self, names: set[str]) -> Iterator[tuple[str, int, bytes]]:
        """Yield topic, time of receipt [ns] and data of each message."""
        for channel, message in self._records():
            if channel.topic in names:
                yield channel.topic, message.log_time, message.data

    def _records(self) -> Iterator[tuple[Channel, Message]]:
        schemas: dict[int, Schema] = {}
        channels: dict[int, Channel] = {}
        self._seen: dict[str, BagTopic] = {}
        for record in iterate_records(self._path, allow_truncated=self._allow_truncated):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
                self._seen.setdefault(record.topic, _mcap_topic(record, schemas.get(record.schema_id)))
            elif isinstance(record, Message) and record.channel_id in channels:
                yield channels[record.channel_id], record


class _Decoder:
    """Decoder of the messages of one topic, by the definition in the bag, or else by ROS's own."""

    def __init__(self, path: Path, topic: BagTopic) -> None:
        self._path, self._topic = path, topic
        if topic.encoding not in ROS_ENCODINGS:
            raise RecordingError(
                f"{path}: {topic.name} is {topic.type} encoded as '{topic.encoding}'; messages of ROS 1 and ROS 2 are "
                "read."
            )
        with refusing(path, f"the definition of {topic.type}"):
            self._store = _typestore(topic.type, topic.definition.strip(), topic.definition_format, topic.encoding)
        if topic.type not in self._store.fielddefs:
            raise RecordingError(
                f"{path}: {topic.name} has the type {topic.type}, which the bag does not define; leave the topic out, "
                "or record it again as MCAP, which keeps definitions."
            )

    def decode(self, data: bytes) -> Any:
        with refusing(self._path, f"a message on {self._topic.name} ({self._topic.type})"):
            if self._topic.encoding == "ros1":
                return self._store.deserialize_ros1(data, self._topic.type)
            return self._store.deserialize_cdr(data, self._topic.type)


@lru_cache(maxsize=64)
def _typestore(kind: str, definition: str, language: str, encoding: str) -> Any:
    """Return rosbags' store of one type and those inside it; a type that a bag does not define is ROS's own."""
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    if not definition:
        return get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    store = get_typestore(Stores.EMPTY)
    if language == "msg":
        store.register(get_types_from_msg(definition, kind))
        return store
    for part in re.split(r"=+\nIDL: .*\n", definition):
        if part.strip():
            store.register(get_types_from_idl(part))
    return store


def _mcap_topic(channel: Channel, schema: Schema | None) -> BagTopic:
    encoding, name, text = channel.message_encoding, "unknown", ""
    if schema is not None:
        name, text = schema.name, schema.data.decode(errors="replace")
    if encoding in ROS_ENCODINGS and name.count("/") == 1:
        name = name.replace("/", "/msg/")
    return BagTopic(
        name=channel.topic,
        type=name,
        count=0,
        encoding=encoding,
        definition=text if encoding in ROS_ENCODINGS else "",
        definition_format="idl" if schema is not None and schema.encoding in ("ros2idl", "omgidl") else "msg",
    )
