"""The messages of a recording: Foxglove's protobuf schemas and one JSON schema, built from arrays and parsed.

Schemas: https://docs.foxglove.dev/docs/sdk/schemas. Orientations are wxyz here; Foxglove's fields are named, so no
order is assumed. Knows nothing of files or of which messages belong together: see `mcap_files`, `pairing`.
"""

from typing import Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration as CalibrationMessage
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.timestamp_pb2 import Timestamp
from jaxtyping import Float, UInt8

from ..camera import CameraCalibration, matrix_from_quaternion, rounded_quaternion
from ..errors import MAX_SHOWN, ObservationError, RecordingError
from ..observation import IDENTITY_WXYZ, ToolState
from ..toml_kinds import flag, integer, positive
from .images import MAX_PIXELS
from .json_values import entry, parse_object
from .stored_arrays import MAX_LENGTH_M
from .topics import GRASP

WORLD = "world"
"""Name of the world frame."""
CAMERA_FRAMES = {"left": "camera_left_optical", "right": "camera_right_optical"}
"""Name of each camera's raw optical frame."""
FAST_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]
"""zlib level 1: a third of the time of the default for a tenth more bytes; the MCAP chunk is compressed as well."""
DISTORTION_COEFFICIENTS = (0, 4, 5, 8)
"""Lengths of D that `plumb_bob` (up to 5) and `rational_polynomial` (8) have."""
UNIT_LENGTH = 0.01
"""Largest difference of a quaternion's length from 1: a robot's rounding."""
MAX_POINTS = 2_000_000
"""Most points of a cloud: twice those of a depth camera; the estimator takes far fewer."""
MAX_POINT_BYTES = 1 << 12
"""Most bytes of a point; a scanner's has fewer than 100."""
MAX_DISTORTION = 1e4
"""Largest distortion coefficient; those of real lenses are below 100."""
MAX_FOCAL_PX = 1e6
"""Largest focal length and principal point [px]; beyond it the view is narrower than the noise of its direction."""
NS_PER_S = 1_000_000_000
"""Nanoseconds in a second."""


GRASP_SCHEMA: dict[str, object] = {
    "title": "jiggle_mj.Grasp",
    "type": "object",
    "properties": {
        "closed": {"type": "boolean", "description": "whether the jaws hold the tissue"},
        "grasp": {"type": "integer", "description": "number of the current or last grasp, from 1; 0 before the first"},
        "radius": {"type": "number", "description": "tissue within this distance of the tip is held [m]"},
        "held_tracks": {"type": "array", "items": {"type": "integer"}, "description": "track ids known to be held"},
        "by_points": {
            "type": "boolean",
            "description": "whether the pose is where the held points were seen",
        },
    },
    "required": ["closed", "grasp", "radius"],
}

FIELD_TYPES: dict[str, "PackedElementField.NumericType.ValueType"] = {
    "<f8": PackedElementField.FLOAT64,
    "<f4": PackedElementField.FLOAT32,
    "<i4": PackedElementField.INT32,
    "<u4": PackedElementField.UINT32,
    "<i2": PackedElementField.INT16,
    "<u2": PackedElementField.UINT16,
    "|i1": PackedElementField.INT8,
    "|u1": PackedElementField.UINT8,
}
"""numpy's little-endian types to the types of PointCloud."""
FIELD_FORMATS = {number: name for name, number in FIELD_TYPES.items()}
"""The types of PointCloud to numpy's."""


def timestamp(time: int) -> Timestamp:
    """Return the protobuf timestamp of a time [ns]."""
    seconds, nanos = divmod(int(time), NS_PER_S)
    return Timestamp(seconds=seconds, nanos=nanos)


def stamp_of(message: Any) -> int:
    """Return a message's own time [ns]; 0 where it has none."""
    return message.timestamp.seconds * NS_PER_S + message.timestamp.nanos


def image_message(time: int, image: UInt8[np.ndarray, "height width 3"], side: str) -> CompressedImage:
    """Return a lossless png of an RGB image of the `left` or `right` camera."""
    encoded, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), FAST_PNG)
    if not encoded:
        raise ValueError(f"an image of shape {image.shape} cannot be written as png.")
    return CompressedImage(timestamp=timestamp(time), frame_id=CAMERA_FRAMES[side], data=data.tobytes(), format="png")


def calibration_message(calibration: CameraCalibration, side: str) -> CalibrationMessage:
    """Return the message of one camera's calibration, at time 0.

    Raises:
        ValueError: D has a length that no distortion model has.
    """
    n_coefficients = len(calibration.D)
    if n_coefficients not in DISTORTION_COEFFICIENTS:
        raise ValueError(f"CameraCalibration.D must have 0, 4, 5 or 8 coefficients; got {n_coefficients}.")
    return CalibrationMessage(
        timestamp=timestamp(0),
        frame_id=CAMERA_FRAMES[side],
        width=calibration.width,
        height=calibration.height,
        distortion_model="rational_polynomial" if n_coefficients == 8 else "plumb_bob",
        D=calibration.D.tolist(),
        K=calibration.K.ravel().tolist(),
        R=calibration.R.ravel().tolist(),
        P=calibration.P.ravel().tolist(),
    )


def parse_calibration(message: CalibrationMessage, topic: str) -> CameraCalibration:
    """Return the calibration in a message.

    Raises:
        RecordingError: uncalibrated, a fisheye model, or matrices of the wrong length.
    """
    if message.distortion_model not in ("", "plumb_bob", "rational_polynomial"):
        model = message.distortion_model[:MAX_SHOWN]
        raise RecordingError(f"{topic} has distortion model '{model}'; plumb_bob and rational_polynomial are read.")
    K, R, P = (np.array(values, float) for values in (message.K, message.R, message.P))
    R = R if R.any() else np.eye(3).ravel()
    if (len(K), len(R), len(P)) != (9, 9, 12) or not (K[0] > 0 and P[0] > 0):
        raise RecordingError(
            f"{topic} is not calibrated: it needs K of 9, P of 12 numbers and fx > 0; "
            f"got {len(K)}, {len(P)} and K[0] = {K[0] if len(K) else None}."
        )
    D = np.array(message.D, float)
    if len(D) not in DISTORTION_COEFFICIENTS:
        raise RecordingError(f"{topic} has {len(D)} distortion coefficients; 0, 4, 5 or 8 are read.")
    if not np.isfinite(np.concatenate([K, R, P, D])).all():
        raise RecordingError(f"{topic} holds numbers that are not finite.")
    if (np.abs(D) > MAX_DISTORTION).any() or (np.abs(np.concatenate([K, P])) > MAX_FOCAL_PX).any():
        raise RecordingError(
            f"{topic} holds numbers beyond those of a camera: D up to {MAX_DISTORTION:g}, K and P up to "
            f"{MAX_FOCAL_PX:g} px are read."
        )
    if not (K[4] > 0 and P[5] > 0 and K[8] == 1 and P[10] == 1):
        raise RecordingError(f"{topic} has no pinhole matrices: K[4], P[5] must be above 0, K[8] and P[10] must be 1.")
    if not 0 < message.width * message.height <= MAX_PIXELS:
        raise RecordingError(
            f"{topic} is of a camera of {message.width}x{message.height}; 1 to {MAX_PIXELS} pixels are read."
        )
    try:
        return CameraCalibration(
            width=message.width,
            height=message.height,
            K=K.reshape(3, 3),
            P=P.reshape(3, 4),
            D=D,
            R=R.reshape(3, 3),
        )
    except ObservationError as failure:
        raise RecordingError(f"{topic}: {failure}") from failure


def frame_transform(parent: str, child: str, T_parent_child: Float[np.ndarray, "4 4"]) -> FrameTransform:
    """Return the message of a child frame's pose in its parent, at time 0."""
    message = FrameTransform(timestamp=timestamp(0), parent_frame_id=parent, child_frame_id=child)
    _fill(message.translation, "xyz", T_parent_child[:3, 3])
    _fill(message.rotation, "wxyz", rounded_quaternion(T_parent_child[:3, :3]))
    return message


def parse_transform(message: FrameTransform | Pose) -> Float[np.ndarray, "4 4"]:
    """Return the matrix of a transform or pose; an unset rotation is the identity.

    Raises:
        RecordingError: numbers that are not finite, or a quaternion that is not of unit length.
    """
    translation = message.translation if isinstance(message, FrameTransform) else message.position
    rotation = message.rotation if isinstance(message, FrameTransform) else message.orientation
    position = np.array([translation.x, translation.y, translation.z])
    quat_wxyz = np.array([rotation.w, rotation.x, rotation.y, rotation.z])
    if not quat_wxyz.any():
        quat_wxyz = IDENTITY_WXYZ
    refuse_bad_pose(position, quat_wxyz)
    T = np.eye(4)
    T[:3, :3] = matrix_from_quaternion(quat_wxyz)
    T[:3, 3] = position
    return T


def refuse_bad_pose(position: Float[np.ndarray, " 3"], quat_wxyz: Float[np.ndarray, " 4"]) -> None:
    """Refuse a malformed pose.

    Raises:
        RecordingError: NaN or infinity, a position beyond `MAX_LENGTH_M`, or a quaternion whose length differs from 1
            by more than `UNIT_LENGTH`.
    """
    if np.isfinite(position).all() and (np.abs(position) > MAX_LENGTH_M).any():
        raise RecordingError(f"the pose's position {position.tolist()} is beyond {MAX_LENGTH_M:g} m")
    if not (np.isfinite(position).all() and np.isfinite(quat_wxyz).all()):
        raise RecordingError(f"NaN in the pose: position {position.tolist()}, quaternion wxyz {quat_wxyz.tolist()}")
    if (np.abs(quat_wxyz) > 1 + UNIT_LENGTH).any() or abs(np.linalg.norm(quat_wxyz) - 1) > UNIT_LENGTH:
        raise RecordingError(f"the pose's quaternion wxyz {quat_wxyz.tolist()} is not of unit length")


def pose_message(time: int, tool: ToolState) -> PoseInFrame:
    """Return the message of the tip's pose in the world at a time [ns]."""
    message = PoseInFrame(timestamp=timestamp(time), frame_id=WORLD)
    fill_pose(message.pose, tool.position, tool.quat_wxyz)
    return message


def grasp_json(tool: ToolState) -> dict[str, object]:
    """Return the message of the jaws' state, which follows `GRASP_SCHEMA`."""
    message: dict[str, object] = {
        "closed": bool(tool.closed),
        "grasp": int(tool.grasp),
        "radius": float(tool.radius),
        "held_tracks": [int(track) for track in tool.held_tracks],
    }
    return message | {"by_points": True} if tool.by_points else message


def parse_grasp(data: bytes) -> dict[str, Any]:
    """Return the fields of a grasp message.

    Raises:
        RecordingError: not JSON, or a field missing or of the wrong kind.
    """
    try:
        value = parse_object(data, GRASP)
        return {
            "closed": entry(value, "closed", flag, GRASP),
            "grasp": entry(value, "grasp", _grasp_number, GRASP),
            "radius": entry(value, "radius", positive, GRASP),
            "held_tracks": entry(value, "held_tracks", _tracks, GRASP, ()),
            "by_points": entry(value, "by_points", flag, GRASP, False),
        }
    except RecordingError as failure:
        raise RecordingError(
            f"{GRASP} must be JSON {{closed, grasp, radius}}, and held_tracks and by_points where they are known; "
            f"{failure}"
        ) from failure


def _grasp_number(value: Any) -> int:
    """Return the number of a grasp."""
    grasp = integer(value)
    if grasp < 0:
        raise TypeError("a whole number from 0")
    return grasp


def _tracks(value: Any) -> tuple[int, ...]:
    """Return a list of track ids."""
    if not isinstance(value, list) or len(value) > MAX_POINTS:
        raise TypeError("a list of whole numbers")
    return tuple(integer(track) for track in value)


def point_cloud(time: int, columns: dict[str, np.ndarray], *, frame_id: str = WORLD) -> PointCloud:
    """Return a PointCloud with the named columns of shape (m,) in their own types (bool as uint8, int as int32)."""
    typed = {name: _packable(name, column) for name, column in columns.items()}
    table = np.zeros(len(next(iter(typed.values()))), dtype=[(name, column.dtype) for name, column in typed.items()])
    for name, column in typed.items():
        table[name] = column
    message = PointCloud(
        timestamp=timestamp(time), frame_id=frame_id, point_stride=table.dtype.itemsize, data=table.tobytes()
    )
    fill_pose(message.pose, np.zeros(3))
    for name, (dtype, offset, *_) in (table.dtype.fields or {}).items():
        message.fields.add(name=name, offset=offset, type=FIELD_TYPES[dtype.str])
    return message


def parse_points(message: PointCloud, topic: str) -> dict[str, np.ndarray]:
    """Return the columns of a PointCloud; its own pose is not applied.

    Raises:
        RecordingError: no x, y, z, a field outside its point, or data whose length is not a multiple of a point's.
    """
    known = {f.name: (FIELD_FORMATS[f.type], f.offset) for f in message.fields if f.type in FIELD_FORMATS}
    missing = [name for name in "xyz" if name not in known]
    if missing:
        names = str(sorted(f.name for f in message.fields))[:MAX_SHOWN]
        raise RecordingError(f"{topic} lacks the fields {missing}; it has {names}.")
    stride = message.point_stride
    ends = [offset + np.dtype(form).itemsize for form, offset in known.values()]
    if stride > MAX_POINT_BYTES or len(message.data) > MAX_POINTS * stride:
        raise RecordingError(
            f"{topic} has {len(message.data)} bytes of data for points of {stride} bytes; at most {MAX_POINTS} points "
            f"of {MAX_POINT_BYTES} bytes are read."
        )
    if stride == 0 or max(ends) > stride or len(message.data) % stride:
        raise RecordingError(f"{topic} has {len(message.data)} bytes of data for points of {stride} bytes.")
    layout = np.dtype(
        {
            "names": list(known),
            "formats": [form for form, _ in known.values()],
            "offsets": [offset for _, offset in known.values()],
            "itemsize": stride,
        }
    )
    table = np.frombuffer(message.data, layout) if message.data else np.empty(0, layout)
    return {name: table[name].copy() for name in known}


def fill_pose(
    pose: Pose, position: Float[np.ndarray, " 3"], quat_wxyz: Float[np.ndarray, " 4"] = IDENTITY_WXYZ
) -> None:
    """Set every field of a pose, zeros included: a viewer treats an unset part as a missing one."""
    _fill(pose.position, "xyz", position)
    _fill(pose.orientation, "wxyz", quat_wxyz)


def _packable(name: str, column: np.ndarray) -> np.ndarray:
    column = np.asarray(column)
    if column.dtype == bool:
        return column.astype("u1")
    if np.issubdtype(column.dtype, np.integer) and column.dtype.str not in FIELD_TYPES:
        limits = np.iinfo(np.int32)
        if column.size and (column.min() < limits.min or column.max() > limits.max):
            raise ValueError(f"PointCloud column {name} must fit 32 bits; got {column.min()}..{column.max()}.")
        return column.astype("<i4")
    return column if column.dtype.str in FIELD_TYPES else column.astype("<f8")


def _fill(message: Any, names: str, values: np.ndarray) -> None:
    for name, value in zip(names, values, strict=True):
        setattr(message, name, float(value))
