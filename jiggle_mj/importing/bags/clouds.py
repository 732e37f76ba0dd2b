"""Points of a bag: PointCloud2 messages, and depth images as clouds without identities.

Layout of PointCloud2: sensor_msgs/PointCloud2 and PointField. Points stay in the frame of their message: `importer`
moves them to the world.
"""

from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Int

from ...camera import CameraCalibration
from ...errors import RecordingError
from .bag_paths import listed
from .images import depth_image
from .settings import DepthSettings

FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""Numbers of sensor_msgs/PointField to numpy's types."""
ID_FIELDS = ("track_id", "id", "point_id", "ids", "index", "label")
"""Usual names of the field that numbers material points, the first that is there."""
MAX_POINTS = 20_000
"""Points of a cloud that are read: above any tracked sheet; a camera's whole cloud must be cut to the tissue."""


def cloud_points(message: Any, id_field: str | None) -> tuple[Float[np.ndarray, "m 3"], Int[np.ndarray, " m"] | None]:
    """Return positions in the message's frame [m] and the numbers of the material points; NaN for unseen points.

    A cloud without numbers has its unseen points left out.

    Args:
        message: a `sensor_msgs/PointCloud2`.
        id_field: field of the numbers; empty for none; None to look for `ID_FIELDS`.

    Raises:
        RecordingError: no x, y, z, no such field, too many points, numbers that repeat, or data that are too short.
    """
    columns = _columns(message)
    missing = [name for name in ("x", "y", "z", *([id_field] if id_field else ())) if name not in columns]
    if missing:
        raise RecordingError(f"lacks the fields {', '.join(missing)}; it has {', '.join(columns) or 'none'}")
    positions = np.column_stack([columns[name].astype(float) for name in "xyz"])
    unseen = ~np.isfinite(positions).all(axis=1)
    positions[unseen] = np.nan
    name = next((name for name in ID_FIELDS if name in columns), "") if id_field is None else id_field
    if not name:
        return _bounded(positions[~unseen]), None
    numbers = columns[name].astype(float)
    if not (
        np.isfinite(numbers).all() and (numbers == np.round(numbers)).all() and np.abs(numbers).max(initial=0) < 2**31
    ):
        raise RecordingError(f"has numbers in '{name}' that are not whole numbers of 32 bits")
    if len(np.unique(numbers)) != len(numbers):
        raise RecordingError(
            f"has the same number in '{name}' more than once; name another field, or \"\" for none, with [points] id"
        )
    return _bounded(positions), numbers.astype(np.int64)


def depth_points(message: Any, calibration: CameraCalibration, settings: DepthSettings) -> Float[np.ndarray, "m 3"]:
    """Return the points of a depth image in its optical frame [m], one for each cube of the settings' spacing.

    Raises:
        RecordingError: another size than the calibration's or the mask's, no depth in range, or too many points.
    """
    depth = depth_image(message)
    height, width = depth.shape
    if (width, height) != (calibration.width, calibration.height):
        raise RecordingError(f"is {width}x{height} and its calibration {calibration.width}x{calibration.height}")
    if calibration.D.any():
        raise RecordingError("is not rectified (its camera_info has distortion); record the rectified depth")
    used = np.isfinite(depth) & (depth >= settings.near) & (depth <= settings.far)
    if settings.mask is not None:
        mask = cv2.imread(str(settings.mask), cv2.IMREAD_GRAYSCALE)
        if mask is None or mask.shape != depth.shape:
            raise RecordingError(f"needs a mask of {width}x{height}; {settings.mask} is no such image")
        used &= mask > 0
    v, u = np.nonzero(used)
    if not len(v):
        raise RecordingError(f"has no pixel with a depth from {settings.near:g} to {settings.far:g} m")
    K, z = calibration.K, depth[v, u]
    points = np.column_stack([(u - K[0, 2]) * z / K[0, 0], (v - K[1, 2]) * z / K[1, 1], z])
    _, cube = np.unique(np.floor(points / settings.spacing).astype(np.int64), axis=0, return_inverse=True)
    cube = cube.ravel()
    counts = np.bincount(cube)
    return _bounded(np.column_stack([np.bincount(cube, points[:, k]) / counts for k in range(3)]))


def _columns(message: Any) -> dict[str, np.ndarray]:
    """Return the fields of a cloud by name, in the machine's byte order."""
    height, width, stride = int(message.height), int(message.width), int(message.point_step)
    step = int(message.row_step) or width * stride
    data = np.ascontiguousarray(message.data, np.uint8)
    if height * width == 0:
        raise RecordingError("is an empty cloud")
    known = [field for field in message.fields if int(field.datatype) in FIELD_TYPES and int(field.count) <= 1]
    names = [str(field.name) for field in known]
    if len(set(names)) < len(names) or "" in names:
        raise RecordingError(f"has fields without a name, or with one name: {listed(names)}")
    formats = [np.dtype(("<", ">")[bool(message.is_bigendian)] + FIELD_TYPES[int(field.datatype)]) for field in known]
    ends = [int(field.offset) + form.itemsize for field, form in zip(known, formats, strict=True)]
    if stride == 0 or max(ends, default=0) > stride or step < width * stride:
        raise RecordingError(
            f"has fields outside its points of {stride} bytes, or rows of {step} bytes for {width} points"
        )
    if data.size < step * (height - 1) + width * stride:
        raise RecordingError(f"has {data.size} bytes; {height} rows of {width} points of {stride} bytes need more")
    layout = np.dtype(
        {
            "names": names,
            "formats": formats,
            "offsets": [int(field.offset) for field in known],
            "itemsize": stride,
        }
    )
    rows = np.lib.stride_tricks.as_strided(data, (height, width * stride), (step, 1), writeable=False)
    table = np.ascontiguousarray(rows).reshape(-1).view(layout)
    return {name: table[name] for name in names}


def _bounded(positions: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"]:
    if len(positions) > MAX_POINTS:
        raise RecordingError(
            f"has {len(positions)} points; up to {MAX_POINTS} are read. Cut the cloud to the tissue (a mask, a "
            "range, a larger spacing)"
        )
    return positions
