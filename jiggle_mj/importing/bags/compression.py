"""Compressed parts of a bag, decompressed within a limit: rosbags itself takes whatever comes out.

These are the chunks of a ROS 1 bag, and the single messages of a ROS 2 bag. Unlike those of MCAP, their stated sizes
are not kept by rosbags, so only what comes out is bounded.
"""

from bz2 import BZ2Decompressor
from collections.abc import Callable
from functools import partial
from typing import Any

import lz4.frame
import zstandard

from ...errors import RecordingError
from ...recording.chunks import MAX_CHUNK_BYTES

BOUNDED: dict[str, Callable[[], Any]] = {"bz2": BZ2Decompressor, "lz4": lz4.frame.LZ4FrameDecompressor}
"""Decompressors that stop at a length, by rosbags' name for the compression."""


def bound_chunks(reader: Any) -> None:
    """Make an open `rosbags.rosbag1.Reader` refuse chunks of more than `MAX_CHUNK_BYTES` once they are decompressed."""
    from rosbags.rosbag1.reader import decompressors

    bounded = {decompressors[name]: partial(_decompressed_chunk, kind) for name, kind in BOUNDED.items()}
    for place, chunk in reader.chunks.items():
        reader.chunks[place] = chunk._replace(decompressor=bounded.get(chunk.decompressor, chunk.decompressor))


def take_messages_compressed(reader: Any) -> bool:
    """Make an open `rosbags.rosbag2.Reader` yield compressed messages as they are; return whether it has any."""
    metadata = reader.storage.metadata
    if metadata.compression_mode != "message":
        return False
    reader.storage.metadata = metadata._replace(compression_mode=None)
    return True


def decompressed_message(data: bytes) -> bytes:
    """Return the content of a message that ROS 2 compressed by zstd.

    Raises:
        RecordingError: it is larger than `MAX_CHUNK_BYTES`.
    """
    with zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True) as source:
        return _bounded(source.read(MAX_CHUNK_BYTES + 1), "message", "with smaller images or clouds")


def _decompressed_chunk(kind: Callable[[], Any], data: bytes) -> bytes:
    found = kind().decompress(data, max_length=MAX_CHUNK_BYTES + 1)
    return _bounded(found, "chunk", "or rewrite it with smaller chunks: rosbag filter BAG OUT True")


def _bounded(found: bytes, part: str, cure: str) -> bytes:
    if len(found) > MAX_CHUNK_BYTES:
        raise RecordingError(
            f"a {part} of the bag has more than {MAX_CHUNK_BYTES} bytes once decompressed; record it again, {cure}."
        )
    return found
