"""An MCAP file taken apart into its records, and put together again with whatever they were changed to.

Checksums are left out (0), as files of other programs may do, so that a change reaches the reader.
"""

import struct
from dataclasses import dataclass, field
from io import BytesIO

import zstandard
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC


@dataclass(frozen=True, kw_only=True)
class Record:
    """One record; fields that its kind does not have are empty."""

    kind: str
    """schema, channel, message, metadata or attachment."""
    number: int = 0
    """Number of the schema or channel; of a message, that of its channel."""
    schema_number: int = 0
    """Number of a channel's schema."""
    name: str = ""
    """Name of a schema, metadata or attachment; topic of a channel."""
    encoding: str = ""
    """Encoding of a schema or channel."""
    time: int = 0
    """Time of a message [ns]."""
    data: bytes = b""
    """Content of a schema, message or attachment."""
    entries: dict[str, str] = field(default_factory=dict)
    """Entries of metadata."""
    schema: str = ""
    """Name of a message's schema."""


Records = list[Record]


def records_of(data: bytes) -> Records:
    """Return the records of a valid file."""
    found: Records = []
    schemas: dict[int, str] = {0: ""}
    of_channel: dict[int, str] = {}
    for record in StreamReader(BytesIO(data)).records:
        if isinstance(record, Schema) and record.id not in schemas:
            schemas[record.id] = record.name
            found.append(
                Record(kind="schema", number=record.id, name=record.name, encoding=record.encoding, data=record.data)
            )
        elif isinstance(record, Channel) and record.id not in of_channel:
            of_channel[record.id] = schemas[record.schema_id]
            found.append(
                Record(
                    kind="channel",
                    number=record.id,
                    schema_number=record.schema_id,
                    name=record.topic,
                    encoding=record.message_encoding,
                )
            )
        elif isinstance(record, Message):
            found.append(
                Record(
                    kind="message",
                    number=record.channel_id,
                    time=record.log_time,
                    data=record.data,
                    schema=of_channel[record.channel_id],
                )
            )
        elif isinstance(record, Metadata):
            found.append(Record(kind="metadata", name=record.name, entries=dict(record.metadata)))
        elif isinstance(record, Attachment):
            found.append(Record(kind="attachment", name=record.name, data=record.data))
    return found


def assembled(records: Records, *, chunked: bool = False) -> bytes:
    """Return a file of the records, its messages in one compressed chunk where `chunked`."""
    inside = ("schema", "channel", "message")
    head = _record(Opcode.HEADER, _text("") + _text(""))
    if chunked:
        inner = b"".join(_encoded(record) for record in records if record.kind in inside)
        head += b"".join(_encoded(record) for record in records if record.kind not in inside)
        body = head + chunk(zstandard.compress(inner), len(inner))
    else:
        body = head + b"".join(map(_encoded, records))
    return framed(body)


def framed(body: bytes) -> bytes:
    """Return a file of encoded records, without checksums."""
    tail = _record(Opcode.DATA_END, bytes(4)) + _record(Opcode.FOOTER, bytes(20))
    return MCAP0_MAGIC + body + tail + MCAP0_MAGIC


def chunk(compressed: bytes, size: int, compression: str = "zstd") -> bytes:
    """Return a chunk record that states a size, true or not, and no checksum."""
    head = struct.pack("<QQQI", 0, 0, size, 0) + _text(compression)
    return _record(Opcode.CHUNK, head + struct.pack("<Q", len(compressed)) + compressed)


def _encoded(record: Record) -> bytes:
    number, time = record.number & 0xFFFF, record.time & (2**64 - 1)
    if record.kind == "schema":
        head = struct.pack("<H", number) + _text(record.name) + _text(record.encoding)
        return _record(Opcode.SCHEMA, head + struct.pack("<I", len(record.data)) + record.data)
    if record.kind == "channel":
        head = struct.pack("<HH", number, record.schema_number & 0xFFFF) + _text(record.name) + _text(record.encoding)
        return _record(Opcode.CHANNEL, head + bytes(4))
    if record.kind == "message":
        return _record(Opcode.MESSAGE, struct.pack("<HIQQ", number, 0, time, time) + record.data)
    if record.kind == "metadata":
        pairs = b"".join(_text(key) + _text(value) for key, value in record.entries.items())
        return _record(Opcode.METADATA, _text(record.name) + struct.pack("<I", len(pairs)) + pairs)
    head = bytes(16) + _text(record.name) + _text("application/x-npz")
    return _record(Opcode.ATTACHMENT, head + struct.pack("<Q", len(record.data)) + record.data + bytes(4))


def _record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def _text(text: str) -> bytes:
    data = text.encode("utf-8", "surrogatepass")
    return struct.pack("<I", len(data)) + data
