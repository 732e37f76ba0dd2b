"""Decoding the images of a recording, their sizes checked in the header before memory is taken for the pixels."""

import struct

import cv2
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from jaxtyping import Shaped, UInt8

from ..camera import CameraCalibration
from ..errors import MAX_SHOWN, RecordingError

MAX_PIXELS = 50_000_000
"""Most pixels of an image: more than any camera's that a stereo estimate can use, and 150 MB decoded."""
RAW_TYPES = {
    "rgb8": ("u1", 3),
    "bgr8": ("u1", 3),
    "8UC3": ("u1", 3),
    "rgba8": ("u1", 4),
    "bgra8": ("u1", 4),
    "8UC4": ("u1", 4),
    "mono8": ("u1", 1),
    "8UC1": ("u1", 1),
    "mono16": ("<u2", 1),
    "bayer_rggb8": ("u1", 1),
    "bayer_bggr8": ("u1", 1),
    "bayer_gbrg8": ("u1", 1),
    "bayer_grbg8": ("u1", 1),
}
"""Encodings of RawImage that are read: type and number of the values of a pixel. 8UC3 is BGR, as Foxglove reads it."""
TO_RGB = {
    "bgr8": cv2.COLOR_BGR2RGB,
    "8UC3": cv2.COLOR_BGR2RGB,
    "rgba8": cv2.COLOR_RGBA2RGB,
    "bgra8": cv2.COLOR_BGRA2RGB,
    "8UC4": cv2.COLOR_BGRA2RGB,
    "mono8": cv2.COLOR_GRAY2RGB,
    "8UC1": cv2.COLOR_GRAY2RGB,
    "mono16": cv2.COLOR_GRAY2RGB,
    "bayer_rggb8": cv2.COLOR_BayerRGGB2RGB,
    "bayer_bggr8": cv2.COLOR_BayerBGGR2RGB,
    "bayer_gbrg8": cv2.COLOR_BayerGBRG2RGB,
    "bayer_grbg8": cv2.COLOR_BayerGRBG2RGB,
}
"""OpenCV's conversion of each encoding but rgb8. A Bayer pattern is named by its first two rows, from the left."""
MIN_BAYER_SIDE = 4
"""Smallest side of a Bayer image [px]: the pattern is interpolated between neighbours."""
PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8"
"""First bytes of the two compressed formats that are read."""
JPEG_FRAMES = {0xC0, 0xC1, 0xC2, 0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF}
"""Markers of JPEG segments that state the size (ITU-T T.81, table B.1)."""
JPEG_WITHOUT_LENGTH = {0x01, *range(0xD0, 0xD9)}
"""Markers of JPEG segments without content."""


def decode_image(message: CompressedImage | RawImage) -> UInt8[np.ndarray, "height width 3"]:
    """Return the RGB image of a message; of 16 bits the upper 8.

    Raises:
        RecordingError: the data cannot be decoded, the encoding is not one of `RAW_TYPES`, or the image is larger than
            `MAX_PIXELS`.
    """
    return _decompressed(message) if isinstance(message, CompressedImage) else _from_raw(message)


def _decompressed(message: CompressedImage) -> UInt8[np.ndarray, "height width 3"]:
    data = message.data
    size = _stated_size(data)
    undecodable = f"cannot be decoded as {(message.format or 'png')[:MAX_SHOWN]} ({len(data)} bytes)"
    if size is None:
        raise RecordingError(f"{undecodable}; png and jpeg are read")
    refuse_size(*size)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB)
    except cv2.error as failure:
        raise RecordingError(undecodable) from failure
    if image is None:
        raise RecordingError(undecodable)
    return image


def _from_raw(message: RawImage) -> UInt8[np.ndarray, "height width 3"]:
    encoding = message.encoding
    if encoding not in RAW_TYPES:
        raise RecordingError(f"has encoding '{encoding[:MAX_SHOWN]}'; {', '.join(RAW_TYPES)} are read")
    refuse_size(message.width, message.height)
    value, channels = RAW_TYPES[encoding]
    row = message.width * channels * np.dtype(value).itemsize
    step = message.step or row
    if step < row or len(message.data) < step * message.height:
        raise RecordingError(
            f"has {len(message.data)} bytes; {message.width}x{message.height} at {step} a row need more"
        )
    padded = np.frombuffer(message.data, np.uint8, count=step * message.height).reshape(message.height, step)
    return _to_rgb(np.ascontiguousarray(padded[:, :row]).view(value), encoding, channels)


def _to_rgb(
    rows: Shaped[np.ndarray, "height _values"], encoding: str, channels: int
) -> UInt8[np.ndarray, "height width 3"]:
    pixels = rows.reshape(len(rows), -1, channels) if channels > 1 else rows
    if pixels.dtype != np.uint8:
        pixels = (pixels >> 8).astype(np.uint8)
    if encoding == "rgb8":
        return pixels.copy()
    refuse_small_bayer(encoding, pixels.shape[1], pixels.shape[0])
    return cv2.cvtColor(pixels, TO_RGB[encoding])


def refuse_other_size(image: UInt8[np.ndarray, "height width 3"], calibration: CameraCalibration, topic: str) -> None:
    """Refuse an image of another size than its calibration.

    Raises:
        RecordingError: the sizes differ.
    """
    height, width = image.shape[:2]
    if (width, height) != (calibration.width, calibration.height):
        raise RecordingError(
            f"{topic} is {width}x{height} and its calibration {calibration.width}x{calibration.height}"
        )


def refuse_size(width: int, height: int) -> None:
    """Refuse an image without pixels, or with more than `MAX_PIXELS`.

    Raises:
        RecordingError: it is of that size.
    """
    if width < 1 or height < 1 or width * height > MAX_PIXELS:
        raise RecordingError(f"is {width}x{height}; images from 1 to {MAX_PIXELS} pixels are read")


def refuse_small_bayer(encoding: str, width: int, height: int) -> None:
    """Refuse a Bayer image of less than `MIN_BAYER_SIDE` rows or columns; other encodings have no such limit.

    Raises:
        RecordingError: it is smaller.
    """
    if encoding.startswith("bayer") and min(width, height) < MIN_BAYER_SIDE:
        raise RecordingError(f"is {width}x{height}; a Bayer image has at least {MIN_BAYER_SIDE} rows and columns")


def _stated_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height that the header of a png or jpeg states; None where it is neither."""
    if data[:8] == PNG and data[12:16] == b"IHDR" and len(data) >= 24:
        width, height = struct.unpack_from(">II", data, 16)
        return width, height
    return _jpeg_size(data) if data[:2] == JPEG else None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height from the first frame header of a jpeg (ITU-T T.81, B.2.2); None where it has none."""
    place = 2
    while place + 9 <= len(data):
        if data[place] != 0xFF:
            return None
        marker = data[place + 1]
        if marker in JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", data, place + 5)
            return width, height
        if marker == 0xFF:
            place += 1
        elif marker in JPEG_WITHOUT_LENGTH:
            place += 2
        else:
            place += 2 + struct.unpack_from(">H", data, place + 2)[0]
    return None
