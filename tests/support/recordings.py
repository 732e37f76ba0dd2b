"""A camera, observations, a robot's bag and a truth, from which tests make recordings."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from jiggle_mj.camera import StereoCamera
from jiggle_mj.observation import (
    Declaration,
    DeclaredMesh,
    MeasuredPoints,
    Observation,
    StereoPair,
    ToolReport,
    ToolState,
)
from jiggle_mj.recording.frames import camera_transforms
from jiggle_mj.recording.mcap_files import McapOutput
from jiggle_mj.recording.reader import Recording
from jiggle_mj.recording.schemas import (
    GRASP_SCHEMA,
    calibration_message,
    grasp_json,
    image_message,
    point_cloud,
    pose_message,
)
from jiggle_mj.recording.topics import GRASP, LEFT, LEFT_INFO, POINTS, POSE, RIGHT, RIGHT_INFO, TF
from jiggle_mj.recording.writer import RecordingWriter
from jiggle_mj.truth import Truth, TruthFrame

MS = 1_000_000
"""One millisecond [ns]."""
ROUNDING = 1e-14
"""Absolute tolerance of numbers near 1: a rotation goes through a quaternion and back, a few roundings."""
QUATERNION_ROUNDING = 2e-12
"""A recorded rotation is a quaternion rounded to twelve decimals (`QUATERNION_DECIMALS`)."""


def camera(**changes) -> StereoCamera:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", [2.2, 0.3, -0.1]).as_matrix()
    T[:3, 3] = [0.01, -0.05, 0.09]
    settings = {"width": 32, "height": 24, "focal": 40.0, "baseline": 0.005, "T_world_camera": T}
    return StereoCamera.rectified(**(settings | changes))


def tool(*, x: float = 0.1, held: tuple[int, ...] = ()) -> ToolState:
    quat_wxyz = Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).as_quat(scalar_first=True)
    return ToolState(
        position=np.array([x, -1 / 3, 0.07]), quat_wxyz=quat_wxyz, closed=True, grasp=2, radius=0.003, held_tracks=held
    )


def malformed(state: ToolState, **changes: object) -> ToolState:
    """A state that `ToolState` itself would refuse, as a broken robot may report it."""
    broken = replace(state)
    for name, value in changes.items():
        object.__setattr__(broken, name, value)
    return broken


def image(seed: int, *, height: int = 24, width: int = 32) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def observations(n: int = 3) -> list[Observation]:
    generator = np.random.default_rng(7)
    result = []
    for index in range(n):
        positions = generator.normal(size=(5, 3))
        positions[index % 5] = np.nan
        result.append(
            Observation(
                index=index,
                time=index * 125 * MS + (index > 0),
                tool=replace(tool(x=0.1 + index, held=(3, 1)), by_points=index == 1),
                reports=tuple(
                    ToolReport(time=index * 125 * MS - late * MS, position=generator.normal(size=3))
                    for late in ((80, 40) if index == 2 else ())
                ),
                images=StereoPair(left=image(2 * index), right=image(2 * index + 1)),
                points=MeasuredPoints(positions=positions, track_id=np.array([4, 2, 0, 9, -1]), sd=1 / 3e4),
            )
        )
    return result


def declared_mesh() -> DeclaredMesh:
    return DeclaredMesh(
        vertices=np.array([[0, 0, 0], [1, 0, 0], [0, 1, 1 / 3]]),
        faces=np.array([[0, 1, 2]]),
        track_id=np.array([4, -1, 2]),
        held=np.array([False, True, False]),
    )


def write(path: Path, seen: list[Observation], **changes) -> Path:
    settings = {"camera": camera(), "declaration": Declaration(), "metadata": {"seed": "3"}} | changes
    with RecordingWriter(path, **settings) as writer:
        for observation in seen:
            writer.write(observation)
    return path


def assert_same(actual: Observation, expected: Observation) -> None:
    """Compare tool, reports, images and points bit by bit."""
    assert (actual.index, actual.time) == (expected.index, expected.time)
    for f in fields(ToolState):
        np.testing.assert_array_equal(getattr(actual.tool, f.name), getattr(expected.tool, f.name))
    assert [report.time for report in actual.reports] == [report.time for report in expected.reports]
    for report, same in zip(actual.reports, expected.reports, strict=True):
        np.testing.assert_array_equal(report.position, same.position)
    for side in ("left", "right"):
        np.testing.assert_array_equal(getattr(actual.images, side), getattr(expected.images, side))
    np.testing.assert_array_equal(actual.points.positions, expected.points.positions)
    np.testing.assert_array_equal(actual.points.track_id, expected.points.track_id)
    assert actual.points.sd == expected.points.sd


class Bag:
    """A robot's bag, written message by message, correct or not."""

    def __init__(self, path: Path, *, cameras: StereoCamera | None = None):
        self.output = McapOutput(path)
        if cameras is not None:
            self.output.message(LEFT_INFO, 0, calibration_message(cameras.left, "left"))
            self.output.message(RIGHT_INFO, 0, calibration_message(cameras.right, "right"))
            self.output.message(TF, 0, camera_transforms(cameras))

    def tool(self, time: int, state: ToolState | None = None) -> None:
        self.output.message(POSE, time, pose_message(time, state or tool()))
        self.output.json(GRASP, time, grasp_json(state or tool()), schema=GRASP_SCHEMA)

    def image(self, topic: str, time: int, pixels: np.ndarray) -> None:
        self.output.message(topic, time, image_message(time, pixels, "left" if topic == LEFT else "right"))

    def pair(self, time: int) -> None:
        self.image(LEFT, time, image(1))
        self.image(RIGHT, time, image(2))

    def points(self, time: int, **columns) -> None:
        self.output.message(POINTS, time, point_cloud(time, {axis: np.arange(3.0) for axis in "xyz"} | columns))


def read_all(path: Path, **settings) -> tuple[list[Observation], list[tuple[int, str]]]:
    recording = Recording.open(path, **settings)
    seen = list(recording)
    return seen, recording.skipped


def truth() -> Truth:
    generator = np.random.default_rng(0)
    frames = tuple(
        TruthFrame(
            index=index,
            time=index * 10,
            positions=generator.normal(size=(4, 3)),
            stiffness=np.array([0, np.inf, np.nan, 1 / 3]),
            tip=np.array([np.nan, index, 1 / 3]),
            load=np.array([0, 1 / 3, np.nan, 2.0]) if index else None,
        )
        for index in (0, 2, 5)
    )
    return Truth(
        rest=generator.normal(size=(4, 3)),
        faces=np.array([[0, 1, 2], [1, 3, 2]]),
        attached=np.array([False, True, True, True]),
        frames=frames,
        scene="arc",
        details={"disturbances": ["gravity"], "nested": {"k": 1.5}},
    )
