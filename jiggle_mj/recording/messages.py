"""Messages, time stamps and frames of files of unknown origin: parsed, or refused with their topic."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol, TypeVar, runtime_checkable

from google.protobuf.message import DecodeError
from mcap.records import Attachment, Channel, Message, Metadata

from ..errors import MAX_SHOWN, RecordingError
from .mcap_files import MAX_TIME_NS, RECORD_AGAIN, iterate_records

Parsed = TypeVar("Parsed")


@runtime_checkable
class IndexedFrame(Protocol):
    """A frame of an estimate or a truth."""

    @property
    def index(self) -> int:
        """Index of the observation."""
        ...

    @property
    def time(self) -> int:
        """Time of the observation [ns]."""
        ...


@dataclass(frozen=True, kw_only=True)
class FileContent:
    """All messages, attachments and metadata of a small file: an estimate or a truth, not a recording."""

    path: Path
    """The file."""
    messages: dict[str, list[Message]]
    """The messages of each wanted topic, in file order."""
    attachments: dict[str, Attachment]
    """The last attachment of each name."""
    metadata: dict[str, dict[str, str]]
    """The last metadata record of each name."""
    topics: str
    """All topics, for messages."""

    def frames(self, *topics: str, complete: bool) -> list[tuple[Message, ...]]:
        """Return the messages of several topics that belong to one frame each.

        Args:
            topics: each has one message a frame, at one time.
            complete: refuse a frame that lacks a message; else the last frame may lack some.

        Raises:
            RecordingError: messages are missing, or of different times.
        """
        columns = [self.messages[topic] for topic in topics]
        counts = [len(column) for column in columns]
        if complete and len(set(counts)) > 1:
            raise RecordingError(f"{self.path} is damaged: {', '.join(topics)} have {counts} messages.")
        frames = list(zip(*columns, strict=False))
        for frame in frames:
            if len({message.log_time for message in frame}) > 1:
                raise RecordingError(f"{self.path} is damaged: messages of one frame have different times.")
        return frames


def read_messages(path: Path, wanted: Sequence[str], *, allow_truncated: bool, cure: str = RECORD_AGAIN) -> FileContent:
    """Return the content of a small file.

    Args:
        path: an MCAP file.
        wanted: topics whose messages are kept.
        allow_truncated: read the complete records of a file that was cut off.
        cure: what to do about one that was cut off.

    Raises:
        RecordingError: missing, not an MCAP, truncated, damaged.
    """
    topics: dict[int, str] = {}
    messages: dict[str, list[Message]] = {topic: [] for topic in wanted}
    attachments: dict[str, Attachment] = {}
    metadata: dict[str, dict[str, str]] = {}
    for record in iterate_records(path, allow_truncated=allow_truncated, cure=cure):
        if isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Message):
            if record.channel_id not in topics:
                raise RecordingError(f"{path} is damaged: a message has the unknown channel {record.channel_id}.")
            if topics[record.channel_id] in messages:
                messages[topics[record.channel_id]].append(record)
        elif isinstance(record, Attachment):
            attachments[record.name] = record
        elif isinstance(record, Metadata):
            metadata[record.name] = dict(record.metadata)
    names = ", ".join(sorted(set(topics.values())))[:MAX_SHOWN] or "none"
    return FileContent(path=path, messages=messages, attachments=attachments, metadata=metadata, topics=names)


def refuse_disorder(frames: Sequence[IndexedFrame], path: Path) -> None:
    """Refuse frames whose indices or times do not rise.

    Raises:
        RecordingError: they do not.
    """
    for before, after in pairwise(frames):
        if after.index <= before.index or after.time < before.time:
            raise RecordingError(
                f"{path} is damaged: frame {after.index} at {after.time} ns follows frame {before.index} at "
                f"{before.time} ns."
            )


def parse_message(message_class: type[Parsed], data: bytes, where: str) -> Parsed:
    """Return the protobuf message in some bytes.

    Args:
        message_class: class of the message.
        data: its bytes.
        where: what it is, for messages.

    Raises:
        RecordingError: the bytes are no such message.
    """
    generated: Any = message_class
    try:
        return generated.FromString(data)
    except DecodeError as failure:
        reason = str(failure)[:MAX_SHOWN]
        raise RecordingError(f"{where} is not a {message_class.__name__}: {reason}.") from failure


def checked_stamp(stamp: int, topic: str) -> int:
    """Return a time stamp [ns].

    Raises:
        RecordingError: it is before 1970, or after 2262.
    """
    if not 0 <= stamp <= MAX_TIME_NS:
        raise RecordingError(
            f"{topic} has a message with the time {stamp} ns; times must be from 0 to {MAX_TIME_NS} ns (2262)."
        )
    return stamp
