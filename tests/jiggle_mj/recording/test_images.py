"""Images in every encoding that is read give the colours of the picture; too large ones are refused by their header."""

import struct
import tracemalloc
import zlib

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

from jiggle_mj.errors import RecordingError
from jiggle_mj.recording.images import decode_image

COLOUR = np.array([200, 100, 50], np.uint8)
"""Red, green and blue of a flat picture: three values that no mix-up of channels leaves alike."""
CHANNEL = {"r": 0, "g": 1, "b": 2}


def raw(encoding: str, pixels: np.ndarray) -> RawImage:
    height, width = pixels.shape[:2]
    return RawImage(width=width, height=height, encoding=encoding, step=pixels[0].nbytes, data=pixels.tobytes())


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_bayer_pattern_is_named_by_its_first_two_rows(pattern):
    """The mosaic of a flat picture: row 0 alternates the first two letters, row 1 the others."""
    mosaic = np.empty((12, 16), np.uint8)
    for place, letter in enumerate(pattern):
        mosaic[place // 2 :: 2, place % 2 :: 2] = COLOUR[CHANNEL[letter]]
    decoded = decode_image(raw(f"bayer_{pattern}8", mosaic))
    assert decoded.shape == (12, 16, 3) and (decoded == COLOUR).all()


@pytest.mark.parametrize(
    ("encoding", "order"), [("rgb8", "rgb"), ("bgr8", "bgr"), ("rgba8", "rgba"), ("bgra8", "bgra"), ("8UC4", "bgra")]
)
def test_channels_are_put_into_their_order(encoding, order):
    values = [255 if letter == "a" else COLOUR[CHANNEL[letter]] for letter in order]
    decoded = decode_image(raw(encoding, np.tile(np.array(values, np.uint8), (5, 7, 1))))
    assert decoded.shape == (5, 7, 3) and (decoded == COLOUR).all()


def test_the_upper_byte_of_16_bits_is_read():
    grey = (np.arange(20, dtype="<u2") * 3000).reshape(4, 5)
    np.testing.assert_array_equal(decode_image(raw("mono16", grey)), np.repeat((grey >> 8)[..., None], 3, axis=2))


@pytest.mark.parametrize("extension", [".png", ".jpg"])
def test_compressed_images_are_read_whatever_their_header_holds(extension):
    picture = np.full((24, 32, 3), COLOUR[::-1])
    message = CompressedImage(data=cv2.imencode(extension, picture)[1].tobytes(), format=extension[1:])
    decoded = decode_image(message).astype(int)
    assert decoded.shape == (24, 32, 3) and np.abs(decoded - COLOUR).max() <= 3, "jpeg rounds a flat colour"


@pytest.mark.parametrize(
    "data", [b"", b"\x89PNG\r\n\x1a\n", b"\xff\xd8", b"\xff\xd8\xff\xff\xff", b"GIF89a", b"BM" + b"\0" * 60]
)
def test_what_is_no_png_and_no_jpeg_is_refused(data):
    with pytest.raises(RecordingError, match="png and jpeg are read"):
        decode_image(CompressedImage(data=data, format="png"))


def test_a_huge_image_in_a_small_file_is_refused_before_it_is_decoded():
    """16000 x 16000 pixels, 768 MB decoded, in less than 200 kB."""
    row = zlib.compress(bytes(1 + 3 * 16_000) * 16, 9)
    header = b"IHDR" + struct.pack(">IIBBBBB", 16_000, 16_000, 8, 2, 0, 0, 0)
    png = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header)) + row
    tracemalloc.start()
    with pytest.raises(RecordingError, match="is 16000x16000; images from 1 to 50000000 pixels are read"):
        decode_image(CompressedImage(data=png, format="png"))
    assert tracemalloc.get_traced_memory()[1] < 1 << 20, "less than a megabyte"
    tracemalloc.stop()
    with pytest.raises(RecordingError, match="is 4294967295x4294967295"):
        decode_image(RawImage(width=2**32 - 1, height=2**32 - 1, encoding="rgb8", step=1, data=b"\0"))
