"""Bags as robots write them: messages of ROS 1 or ROS 2 by their field names, written with rosbags."""

from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from jiggle_mj.camera import CameraCalibration, StereoCamera, rounded_quaternion

Kind = Literal["ros1", "mcap", "sqlite3", "mcap-zstd", "sqlite3-message", "sqlite3-file"]
EPOCH = 1_732_800_000_000_000_000
"""Time 0 on the robot's clock [ns]."""
POINT_TYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


class RobotBag:
    """A bag that is written message by message; `path` is what a user would import."""

    def __init__(self, path: Path, kind: Kind = "mcap") -> None:
        self.ros1 = kind == "ros1"
        self.path = path.with_suffix(".bag") if self.ros1 else path
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        if self.ros1:
            transforms = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(transforms, "tf2_msgs/msg/TFMessage"))
            self.writer: Any = Writer1(self.path)
        else:
            plugin = StoragePlugin.MCAP if kind.startswith("mcap") else StoragePlugin.SQLITE3
            self.writer = Writer2(self.path, version=9, storage_plugin=plugin)
            mode = {
                "mcap-zstd": CompressionMode.STORAGE,
                "sqlite3-message": CompressionMode.MESSAGE,
                "sqlite3-file": CompressionMode.FILE,
            }.get(kind)
            if mode is not None:
                self.writer.set_compression(mode, CompressionFormat.ZSTD)
        self.connections: dict[str, Any] = {}

    def __enter__(self) -> "RobotBag":
        self.writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.writer.close()

    def make(self, kind: str, **values: Any) -> Any:
        """Return a message whose fields are the given ones, and empty or 0 otherwise."""
        package, name = kind.split("/")
        full = f"{package}/msg/{name}"
        made = {}
        for field, description in self.store.fielddefs[full][1]:
            lower = field.lower()
            made[field] = values.pop(lower) if lower in values else self._empty(description)
        assert not values, f"{kind} has no {values}"
        return self.store.types[full](**made)

    def header(self, time: int | None, frame: str = "world") -> Any:
        """Return a header of a time from the start [ns]; None for a stamp of 0."""
        seconds, nanos = divmod(0 if time is None else EPOCH + time, 1_000_000_000)
        stamp = self.make("builtin_interfaces/Time", sec=seconds, nanosec=nanos)
        return self.make("std_msgs/Header", stamp=stamp, frame_id=frame)

    def write(self, topic: str, time: int, kind: str, message: Any = None, **values: Any) -> None:
        """Write a message that is received at a time from the start [ns]."""
        package, name = kind.split("/")
        full = f"{package}/msg/{name}"
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, full, typestore=self.store)
        message = self.make(kind, **values) if message is None else message
        data = self.store.serialize_ros1(message, full) if self.ros1 else self.store.serialize_cdr(message, full)
        self.writer.write(self.connections[topic], EPOCH + time, data)

    def image(self, topic: str, time: int, encoding: str, pixels: np.ndarray, **changes: Any) -> None:
        """Write an Image from pixels in their own layout."""
        rows = np.ascontiguousarray(pixels)
        header = changes.pop("header", None) or self.header(
            time, "left_optical" if "left" in topic else "right_optical"
        )
        values = {
            "header": header,
            "height": rows.shape[0],
            "width": rows.shape[1],
            "encoding": encoding,
            "is_bigendian": 0,
            "step": rows[0].nbytes,
            "data": rows.view(np.uint8).ravel(),
        }
        self.write(topic, time, "sensor_msgs/Image", **(values | changes))

    def compressed(self, topic: str, time: int, rgb: np.ndarray) -> None:
        """Write a CompressedImage, a png."""
        data = cv2.imencode(".png", rgb[..., ::-1])[1].ravel()
        header = self.header(time, "left_optical" if "left" in topic else "right_optical")
        self.write(topic, time, "sensor_msgs/CompressedImage", header=header, format="rgb8; png", data=data)

    def info(self, topic: str, time: int, calibration: CameraCalibration, **changes: Any) -> None:
        """Write a CameraInfo."""
        values = {
            "header": self.header(time, "left_optical" if "left" in topic else "right_optical"),
            "height": calibration.height,
            "width": calibration.width,
            "distortion_model": "plumb_bob",
            "d": calibration.D.astype(float),
            "k": calibration.K.ravel(),
            "r": calibration.R.ravel(),
            "p": calibration.P.ravel(),
            "roi": self.make("sensor_msgs/RegionOfInterest"),
        }
        self.write(topic, time, "sensor_msgs/CameraInfo", **(values | changes))

    def transform(self, parent: str, child: str, time: int | None, T: np.ndarray) -> Any:
        """Return a TransformStamped."""
        w, x, y, z = rounded_quaternion(T[:3, :3]).tolist()
        return self.make(
            "geometry_msgs/TransformStamped",
            header=self.header(time, parent),
            child_frame_id=child,
            transform=self.make(
                "geometry_msgs/Transform",
                translation=self._vector("Vector3", T[:3, 3]),
                rotation=self.make("geometry_msgs/Quaternion", w=w, x=x, y=y, z=z),
            ),
        )

    def tf(self, topic: str, time: int, *transforms: Any) -> None:
        """Write a TFMessage."""
        self.write(topic, time, "tf2_msgs/TFMessage", transforms=list(transforms))

    def pose(self, topic: str, time: int, position: Any, quat_wxyz: Any = (1, 0, 0, 0), **changes: Any) -> None:
        """Write a PoseStamped."""
        w, x, y, z = (float(each) for each in quat_wxyz)
        pose = self.make(
            "geometry_msgs/Pose",
            position=self._vector("Point", position),
            orientation=self.make("geometry_msgs/Quaternion", w=w, x=x, y=y, z=z),
        )
        values = {"header": self.header(time), "pose": pose} | changes
        self.write(topic, time, "geometry_msgs/PoseStamped", **values)

    def joint(self, topic: str, time: int, **positions: float) -> None:
        """Write a JointState of positions by joint."""
        values = np.array(list(positions.values()), float)
        self.write(
            topic,
            time,
            "sensor_msgs/JointState",
            header=self.header(time, ""),
            name=list(positions),
            position=values,
        )

    def wrench(self, topic: str, time: int, force: Any, torque: Any = (0, 0, 0)) -> None:
        """Write a WrenchStamped."""
        wrench = self.make(
            "geometry_msgs/Wrench", force=self._vector("Vector3", force), torque=self._vector("Vector3", torque)
        )
        self.write(topic, time, "geometry_msgs/WrenchStamped", header=self.header(time, "sensor"), wrench=wrench)

    def cloud(self, topic: str, time: int, table: np.ndarray, frame: str = "world", **changes: Any) -> None:
        """Write a PointCloud2 from a structured array, its padding included."""
        fields = [
            self.make("sensor_msgs/PointField", name=name, offset=offset, datatype=POINT_TYPES[dtype.str[1:]], count=1)
            for name, (dtype, offset, *_) in table.dtype.fields.items()
        ]
        values = {
            "header": self.header(time, frame),
            "height": 1,
            "width": len(table),
            "fields": fields,
            "point_step": table.dtype.itemsize,
            "row_step": table.nbytes,
            "data": np.frombuffer(table.tobytes(), np.uint8),
            "is_dense": False,
        }
        self.write(topic, time, "sensor_msgs/PointCloud2", **(values | changes))

    def cameras(self, camera: StereoCamera, time: int = 0) -> None:
        """Write both CameraInfo and the transforms of the optical frames, latched on /tf_static."""
        self.info("/left/camera_info", time, camera.left)
        self.info("/right/camera_info", time, camera.right)
        T_left_right = np.eye(4)
        T_left_right[0, 3] = camera.baseline
        self.tf(
            "/tf_static",
            time,
            self.transform("world", "left_optical", time, camera.T_world_camera),
            self.transform("left_optical", "right_optical", time, T_left_right),
        )

    def _vector(self, name: str, values: Any) -> Any:
        x, y, z = (float(each) for each in values)
        return self.make(f"geometry_msgs/{name}", x=x, y=y, z=z)

    def _empty(self, description: Any) -> Any:
        kind, detail = description
        if kind == 1:
            return "" if detail[0] == "string" else False if detail[0] == "bool" else 0
        if kind == 2:
            return self.make(detail.replace("/msg/", "/"))
        element = detail[0][1]
        if detail[0][0] == 1 and element[0] != "string":
            numpy_type = {"float64": np.float64, "float32": np.float32, "uint8": np.uint8, "octet": np.uint8}.get(
                element[0], np.int64
            )
            return np.zeros(detail[1] if kind == 3 else 0, numpy_type)
        return []


def rotated(degrees: float) -> np.ndarray:
    """Return a pose that is rotated about z."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    return T


STEP = 100_000_000
"""Time from frame to frame of `small_bag` [ns]."""


def small_camera() -> StereoCamera:
    """Return a camera of 32x24 pixels that looks down from 0.1 m."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = 0.1
    return StereoCamera.rectified(width=32, height=24, focal=40.0, baseline=0.005, T_world_camera=T)


def small_image(seed: int) -> np.ndarray:
    """Return an RGB image of noise."""
    return np.random.default_rng(seed).integers(0, 256, (24, 32, 3), dtype=np.uint8)


def write_tool(bag: RobotBag, n: int = 4, *, every: int = STEP, frame: str = "world") -> None:
    """Write poses along x, 1 mm per `STEP`, and a Bool that closes at the second frame."""
    for time in range(0, n * STEP, every):
        bag.pose("/tool/pose", time, [1e-3 * time / STEP, 0.02, 0.0], header=bag.header(time, frame))
    for index in range(n):
        bag.write("/gripper/closed", index * STEP, "std_msgs/Bool", data=index > 0)


def write_images(bag: RobotBag, n: int = 4, *, late: int = 0) -> None:
    """Write stereo pairs, the right images later by a time [ns]."""
    for index in range(n):
        bag.image("/left/image_raw", index * STEP, "rgb8", small_image(2 * index))
        bag.image("/right/image_raw", index * STEP + late, "rgb8", small_image(2 * index + 1))


def small_bag(path: Path, kind: Kind = "mcap", *, n: int = 4, late: int = 0) -> Path:
    """Write a bag of stereo pairs, camera, tool and gripper, and return its path."""
    with RobotBag(path, kind) as bag:
        bag.cameras(small_camera())
        write_tool(bag, n)
        write_images(bag, n, late=late)
    return bag.path


def points_table(n: int = 6, *, shift: float = 0.0) -> np.ndarray:
    """Return points with numbers, in a layout with padding and the fields out of order."""
    layout = np.dtype(
        {
            "names": ["id", "z", "x", "y"],
            "formats": ["<u4", "<f4", "<f8", "<f4"],
            "offsets": [2, 8, 16, 28],
            "itemsize": 40,
        }
    )
    table = np.zeros(n, layout)
    table["id"] = 10 + np.arange(n)[::-1]
    table["x"], table["y"], table["z"] = np.arange(n) + shift, 0.5, 0.25
    return table
