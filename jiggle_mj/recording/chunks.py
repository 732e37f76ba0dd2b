"""The records of an MCAP chunk, decompressed within a limit: a small file must not fill the memory.

A chunk states its own decompressed size, which is held against the limit before and against what comes out after.
"""

import io
import zlib
from collections.abc import Iterator

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Schema

from ..errors import RecordingError

MAX_CHUNK_BYTES = 1 << 28
"""Largest decompressed chunk [byte]: 256 MiB, 60 times a usual one, and more than any image within the limits."""


def chunk_records(chunk: Chunk) -> Iterator[Schema | Channel | Message]:
    """Yield the records of a chunk in their order, its checksum verified.

    Raises:
        RecordingError: the chunk is larger than `MAX_CHUNK_BYTES` or of another size than it states, its checksum is
            wrong, or its compression is unknown.
    """
    stream = ReadDataStream(io.BytesIO(_decompressed(chunk)))
    while stream.count < chunk.uncompressed_size:
        opcode, length = stream.read1(), stream.read8()
        end = stream.count + length
        if end > chunk.uncompressed_size:
            raise RecordingError(f"a record of {length} bytes reaches beyond its chunk")
        if opcode == Opcode.MESSAGE:
            yield Message.read(stream, length)
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(stream)
        elif opcode == Opcode.CHANNEL:
            yield Channel.read(stream)
        else:
            stream.read(length)
        if stream.count > end:
            raise RecordingError(f"a record of {length} bytes is shorter than its content")
        stream.read(end - stream.count)


def _decompressed(chunk: Chunk) -> bytes:
    stated = chunk.uncompressed_size
    if stated > MAX_CHUNK_BYTES:
        raise RecordingError(
            f"a chunk of {stated} bytes exceeds the limit of {MAX_CHUNK_BYTES}; write it with smaller chunks"
        )
    if chunk.compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(chunk.data, read_across_frames=True) as source:
            data = source.read(stated + 1)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=stated + 1)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise RecordingError(f"a chunk is compressed by {chunk.compression[:40]!r}; zstd, lz4 and none are read")
    if len(data) != stated:
        more = "more than " if len(data) > stated else ""
        raise RecordingError(f"a chunk holds {more}{min(len(data), stated)} bytes and states {stated}")
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise RecordingError("the checksum of a chunk is wrong")
    return data
