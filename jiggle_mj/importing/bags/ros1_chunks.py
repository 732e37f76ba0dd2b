"""Chunks of a ROS 1 bag, decompressed within a limit: rosbags itself takes whatever comes out.

Unlike those of MCAP, these chunks' stated sizes are not kept by rosbags, so only what comes out is bounded.
"""

from bz2 import BZ2Decompressor
from collections.abc import Callable
from functools import partial
from typing import Any

import lz4.frame

from ...errors import RecordingError
from ...recording.chunks import MAX_CHUNK_BYTES

BOUNDED: dict[str, Callable[[], Any]] = {"bz2": BZ2Decompressor, "lz4": lz4.frame.LZ4FrameDecompressor}
"""Decompressors that stop at a length, by rosbags' name for the compression."""


def bound_chunks(reader: Any) -> None:
    """Make an open `rosbags.rosbag1.Reader` refuse chunks of more than `MAX_CHUNK_BYTES` once they are decompressed."""
    from rosbags.rosbag1.reader import decompressors

    bounded = {decompressors[name]: partial(_decompressed, kind) for name, kind in BOUNDED.items()}
    for place, chunk in reader.chunks.items():
        reader.chunks[place] = chunk._replace(decompressor=bounded.get(chunk.decompressor, chunk.decompressor))


def _decompressed(kind: Callable[[], Any], data: bytes) -> bytes:
    found = kind().decompress(data, max_length=MAX_CHUNK_BYTES + 1)
    if len(found) > MAX_CHUNK_BYTES:
        raise RecordingError(
            f"a chunk of the bag has more than {MAX_CHUNK_BYTES} bytes once decompressed; record it again, or rewrite "
            "it with smaller chunks: rosbag filter BAG OUT True."
        )
    return found
