"""ROS images as RGB, and depth images in metres.

ROS names a Bayer pattern by the colours of the first two pixels of the first two rows (`bayer_rggb8` begins with red,
green); OpenCV names the same pattern by the second row's second and third pixel, so the two names differ. Encodings:
sensor_msgs/image_encodings.hpp.
"""

from typing import Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from jaxtyping import Float, UInt8

from ...errors import RecordingError
from ...recording.images import RAW_TYPES, TO_RGB, decode_image, refuse_size, refuse_small_bayer

COLOURS = {name: (channels, TO_RGB.get(name)) for name, (value, channels) in RAW_TYPES.items() if value == "u1"} | {
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
}
"""Encodings of 8 bits: bytes of a pixel, and OpenCV's conversion to RGB, None for none: a recording's, and YUV."""
DEEP = {
    "mono16": "mono8",
    "rgb16": "rgb8",
    "bgr16": "bgr8",
    "rgba16": "rgba8",
    "bgra16": "bgra8",
    **{f"16UC{channels}": f"8UC{channels}" for channels in (1, 3, 4)},
    **{f"bayer_{pattern}16": f"bayer_{pattern}8" for pattern in ("rggb", "bggr", "gbrg", "grbg")},
}
"""Encodings of 16 bits, and those of 8 bits that their upper bytes have."""
DEPTHS = {"16UC1": ("u2", 1e-3), "mono16": ("u2", 1e-3), "32FC1": ("f4", 1.0)}
"""Encodings of depth: numpy's type, and metres in one unit (REP-118)."""
MAX_SHALLOW = 4095
"""Largest value of an image of 12 bits: in 16 bits it would be read as black."""


def rgb_image(message: Any) -> UInt8[np.ndarray, "height width 3"]:
    """Return the RGB image of a `sensor_msgs/Image` or `sensor_msgs/CompressedImage`.

    Raises:
        RecordingError: the encoding is not read, or the data are shorter than the header says, or cannot be decoded.
    """
    if not hasattr(message, "encoding"):
        if "compressedDepth" in message.format:
            raise RecordingError("is a compressed depth image; record the depth as sensor_msgs/Image")
        packed = CompressedImage(data=np.asarray(message.data, np.uint8).tobytes(), format=message.format[:40])
        image, pattern = decode_image(packed), message.format.partition(";")[0].strip()
        if pattern.startswith("bayer_") and pattern in TO_RGB and (image == image[..., :1]).all():
            refuse_small_bayer(pattern, image.shape[1], image.shape[0])
            return cv2.cvtColor(np.ascontiguousarray(image[..., 0]), TO_RGB[pattern])
        return image
    encoding = DEEP.get(message.encoding, message.encoding)
    if encoding not in COLOURS:
        raise RecordingError(f"has encoding '{message.encoding[:40]}'; {', '.join([*COLOURS, *DEEP])} are read")
    size, conversion = COLOURS[encoding]
    if message.encoding in DEEP:
        deep = _pixels(message, np.dtype("u2"), size)
        if deep.max() <= MAX_SHALLOW:
            raise RecordingError(f"has 16-bit pixels of at most {deep.max()}: not scaled to 16 bits; record 8 bits")
        pixels = (deep >> 8).astype(np.uint8)
    else:
        pixels = _pixels(message, np.dtype("u1"), size)
    if conversion is None:
        return np.ascontiguousarray(pixels)
    refuse_small_bayer(encoding, pixels.shape[1], pixels.shape[0])
    return cv2.cvtColor(pixels[..., 0] if size == 1 else pixels, conversion)


def depth_image(message: Any) -> Float[np.ndarray, "height width"]:
    """Return a depth image [m], NaN where nothing was measured.

    Raises:
        RecordingError: the encoding is not one of `DEPTHS`, or the data are shorter than the header says.
    """
    if message.encoding not in DEPTHS:
        raise RecordingError(f"has encoding '{message.encoding[:40]}'; depth is read as {', '.join(DEPTHS)}")
    kind, metres = DEPTHS[message.encoding]
    depth = _pixels(message, np.dtype(kind), 1)[..., 0].astype(float) * metres
    depth[~(np.isfinite(depth) & (depth > 0))] = np.nan
    return depth


def _pixels(message: Any, dtype: np.dtype, channels: int) -> np.ndarray:
    """Return the pixels of shape (height, width, channels) in the machine's byte order, without the rows' padding."""
    height, width, row = int(message.height), int(message.width), int(message.width) * channels * dtype.itemsize
    data, step = np.ascontiguousarray(message.data, np.uint8), int(message.step) or row
    refuse_size(width, height)
    if step < row or data.size < step * (height - 1) + row:
        raise RecordingError(
            f"has {data.size} bytes; {width}x{height} {message.encoding[:40]} at {step} a row need more"
        )
    rows = np.lib.stride_tricks.as_strided(data, (height, row), (step, 1), writeable=False)
    order = ">" if message.is_bigendian else "<"
    packed = np.ascontiguousarray(rows).view(dtype.newbyteorder(order)).astype(dtype)
    return packed.reshape(height, width, channels)
