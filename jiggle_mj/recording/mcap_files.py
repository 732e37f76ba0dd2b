"""MCAP files whose bytes depend on their content alone, and reading them record by record.

A writer flushes the file after each frame, so that a crash loses at most the frame in progress; the reader finds where
the complete records end. A checksum over everything up to the index, MCAP's own, covers metadata and attachments too.
Format: https://mcap.dev/spec. Knows nothing of topics: see `schemas`. Reads front to back without the index, as every
reader wants the whole file.
"""

import io
import json
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self, cast

import numpy as np
import zstandard
from google.protobuf.message import Message as ProtobufMessage
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata, Schema
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import MCAP0_MAGIC, Writer
from mcap_protobuf.schema import register_schema

from ..errors import MAX_SHOWN, OutputError, RecordingError
from .chunks import chunk_records
from .npz_arrays import read_npz
from .output_files import PartialFile, partial_path

NPZ_MEDIA_TYPE = "application/x-npz"
RECORD_HEADER = struct.Struct("<BQ")
"""Opcode and length that precede every MCAP record."""
DAMAGE = (McapError, ValueError, struct.error, zstandard.ZstdError, RuntimeError, OverflowError, MemoryError)
"""Exceptions that a damaged record raises: mcap's errors, wrong checksums, wrong lengths, broken compression."""
MAX_RECORD_BYTES = 1 << 30
"""Largest record [byte]: 1 GiB, four times the largest chunk; attachments may be that large."""
MAX_TIME_NS = (1 << 63) - 1
"""Latest time of a message [ns]: signed 64 bits, as numpy and protobuf hold it; the year 2262."""
RECORD_AGAIN = "Record it again, or read its complete records with allow_truncated=True (--allow-truncated)."
"""What to do about a recording, or its truth, that was cut off."""


def truth_path(recording: Path) -> Path:
    """Return the path of a recording's truth: run.truth.mcap for run.mcap."""
    return recording.with_suffix(".truth.mcap")


class McapOutput:
    """Write messages, metadata and arrays with the caller's times only: the wall clock never enters the file.

    The file gets its name when it is closed; until then it is NAME.part, which no second writer can open.

    Raises:
        OutputError: the path exists and `overwrite` is false, another process writes it, or it cannot be written; any
            method may raise it.
    """

    def __init__(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        self.path = Path(path)
        self._output = PartialFile(self.path, overwrite=overwrite)
        self._file = self._output.file
        self._writer = Writer(self._file, enable_data_crcs=True)
        with self._writing():
            self._writer.start(profile="")
        self._channels: dict[str, int] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()

    def message(self, topic: str, time: int, message: ProtobufMessage) -> None:
        """Write a protobuf message at a time [ns] under the schema of its own class.

        Raises:
            ValueError: the time is below 0 or beyond `MAX_TIME_NS`, as in `json`.
        """
        if topic not in self._channels:
            schema = register_schema(self._writer, type(message))
            self._channels[topic] = self._writer.register_channel(topic, MessageEncoding.Protobuf, schema)
        self._add(topic, time, message.SerializeToString(deterministic=True))

    def json(self, topic: str, time: int, value: dict[str, object], *, schema: dict[str, object]) -> None:
        """Write a JSON object at a time [ns]; the JSON schema's `title` names it."""
        if topic not in self._channels:
            text = json.dumps(schema, sort_keys=True).encode()
            schema_id = self._writer.register_schema(str(schema["title"]), SchemaEncoding.JSONSchema, text)
            self._channels[topic] = self._writer.register_channel(topic, MessageEncoding.JSON, schema_id)
        self._add(topic, time, json.dumps(value, sort_keys=True, allow_nan=False).encode())

    def metadata(self, name: str, values: dict[str, str]) -> None:
        """Write a metadata record with sorted keys."""
        with self._writing():
            self._writer.add_metadata(name, dict(sorted(values.items())))

    def arrays(self, name: str, arrays: dict[str, np.ndarray]) -> None:
        """Write arrays as an npz attachment; numpy dates its members 1980, so the bytes depend on the arrays alone."""
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, **arrays)
        with self._writing():
            self._writer.add_attachment(
                create_time=0, log_time=0, name=name, media_type=NPZ_MEDIA_TYPE, data=buffer.getvalue()
            )

    def flush(self) -> None:
        """Hand every record so far to the operating system."""
        with self._writing():
            self._writer.flush()

    def close(self) -> None:
        """Write the index, close the file and give it its name; a second call does nothing."""
        if not self._file.closed:
            with self._writing():
                self._writer.finish()
                self._output.complete()

    def _add(self, topic: str, time: int, data: bytes) -> None:
        if not 0 <= time <= MAX_TIME_NS:
            raise ValueError(f"a message on {topic} has the time {time} ns; times must be from 0 to {MAX_TIME_NS} ns.")
        with self._writing():
            self._writer.add_message(self._channels[topic], log_time=int(time), publish_time=int(time), data=data)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as failure:
            with suppress(OSError):
                self._file.close()
            raise OutputError(f"{self.path} cannot be written: {failure.strerror}.") from failure


def read_arrays(attachment: Attachment, path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of an npz attachment.

    Raises:
        RecordingError: it is not an npz of plain arrays.
    """
    try:
        return read_npz(attachment.data)
    except RecordingError as failure:
        raise RecordingError(f"{path}: attachment {attachment.name[:40]} {failure}.") from failure


def iterate_records(
    path: str | os.PathLike[str], *, allow_truncated: bool = False, cure: str = RECORD_AGAIN
) -> Iterator[Schema | Channel | McapMessage | Metadata | Attachment]:
    """Yield records in file order, checksums verified.

    Args:
        path: an MCAP file.
        allow_truncated: read the complete records of a file that was cut off, instead of refusing it.
        cure: what to do about one that was cut off.

    Raises:
        RecordingError: missing, not an MCAP, truncated, damaged.
    """
    path = Path(path)
    try:
        file = open(path, "rb")
    except (OSError, ValueError) as failure:
        raise RecordingError(_unreadable(path, failure)) from failure
    with file:
        if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise RecordingError(
                f"{path} is not an MCAP file (it does not begin with the magic bytes of MCAP); measured points become "
                "a recording by 'jiggle-mj import FOLDER --out run.mcap'."
            )
        end, complete = _end_of_records(file)
        if not complete and not allow_truncated:
            raise RecordingError(
                f"{path} is truncated: complete records end at byte {end} and the MCAP footer is missing (was it cut "
                f"off?). {cure}"
            )
        file.seek(0)
        source = _FirstBytes(file, end)
        reader = StreamReader(
            cast(BinaryIO, source), emit_chunks=True, validate_crcs=True, record_size_limit=MAX_RECORD_BYTES
        )
        try:
            for record in reader.records:
                if isinstance(record, Chunk):
                    yield from chunk_records(record)
                elif isinstance(record, Schema | Channel | McapMessage | Metadata | Attachment):
                    yield record
        except (*DAMAGE, RecordingError) as failure:
            if complete or source.remaining or not isinstance(failure, EndOfFile):
                reason = (str(failure) or type(failure).__name__)[:MAX_SHOWN]
                raise RecordingError(f"{path} is damaged before byte {end - source.remaining}: {reason}.") from failure


def _unreadable(path: Path, failure: OSError | ValueError) -> str:
    """Return why a file cannot be opened, and where an interrupted run left its part."""
    reason = (failure.strerror if isinstance(failure, OSError) else None) or str(failure)
    if isinstance(failure, FileNotFoundError) and partial_path(path).exists():
        return (
            f"{path} is not complete: its run was interrupted, or still goes on. Read what there is with "
            f"--allow-truncated from {partial_path(path)}."
        )
    if isinstance(failure, IsADirectoryError):
        return f"{path} is a folder; 'jiggle-mj import {path} --out run.mcap' makes a recording of measured points."
    return f"{path} cannot be read: {reason}."


def _end_of_records(file: BinaryIO) -> tuple[int, bool]:
    """Return where the last complete record ends [byte], and whether the file ends there as MCAP demands.

    Reads the headers that precede the records, not the records.
    """
    size = file.seek(0, os.SEEK_END)
    offset = len(MCAP0_MAGIC)
    while offset + RECORD_HEADER.size <= size:
        file.seek(offset)
        opcode, length = RECORD_HEADER.unpack(file.read(RECORD_HEADER.size))
        end = offset + RECORD_HEADER.size + length
        if end > size:
            break
        if opcode == Opcode.FOOTER:
            end += len(MCAP0_MAGIC)
            file.seek(end - len(MCAP0_MAGIC))
            return (end, True) if file.read(len(MCAP0_MAGIC)) == MCAP0_MAGIC else (offset, False)
        offset = end
    return offset, False


class _FirstBytes:
    """The first bytes of a file as a stream, with the one method that mcap's reader calls."""

    def __init__(self, file: BinaryIO, length: int) -> None:
        self._file, self.remaining = file, length

    def read(self, length: int) -> bytes:
        """Return the next bytes, none past the end."""
        data = self._file.read(min(length, self.remaining))
        self.remaining -= len(data)
        return data
