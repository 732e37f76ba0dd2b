"""Disturbances of the tool's report, the camera's pose, tracked points, and the timing of frames."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..scene.disturbance import SensingDisturbance, TissueDisturbance
from ..scene.section import number, vector
from ..sensing.observer import Observer
from ..tissue.simulation import Simulation


@dataclass(frozen=True, kw_only=True)
class ToolBias(SensingDisturbance[Observer]):
    """The reported tip is displaced from the true one."""

    magnitude: float = number(2e-3, unit="m", at_least=0, at_most=0.1)
    """Length of the displacement [m]."""
    direction: tuple[float, float, float] = vector((1.0, 0.0, 0.0), length=3, direction=True)
    """Direction from the true to the reported tip, world; its length does not count."""

    def begin(self, observer: Observer) -> None:
        """Displace the report."""
        direction = np.array(self.direction)
        observer.faults.tool_offset = self.magnitude * direction / np.linalg.norm(direction)


@dataclass(frozen=True, kw_only=True)
class ToolScale(SensingDisturbance[Observer]):
    """The robot reports the tool's displacement since the jaws closed with a wrong scale."""

    magnitude: float = number(1.05, above=0, at_most=10)
    """Reported over true displacement."""

    def begin(self, observer: Observer) -> None:
        """Scale the report."""
        observer.faults.tool_scale = self.magnitude


@dataclass(frozen=True, kw_only=True)
class ToolTurn(SensingDisturbance[Observer]):
    """The robot's axes are rotated against the camera's, and with them the displacement since the jaws closed."""

    magnitude: float = number(3.0, unit="degrees", at_least=-180, at_most=180)
    """Angle of the rotation [degrees]."""
    about: tuple[float, float, float] = vector((0.0, 1.0, 0.0), length=3, direction=True)
    """Axis of the rotation, world; its length does not count."""

    def begin(self, observer: Observer) -> None:
        """Rotate the report."""
        axis = np.array(self.about) / np.linalg.norm(self.about)
        observer.faults.tool_rotation = Rotation.from_rotvec(self.magnitude * axis, degrees=True).as_matrix()


@dataclass(frozen=True, kw_only=True)
class ToolLatency(SensingDisturbance[Observer]):
    """The tool's pose is reported late."""

    magnitude: float = number(0.2, unit="s", at_least=0, at_most=10)
    """Delay [s]."""

    def begin(self, observer: Observer) -> None:
        """Delay the report."""
        observer.faults.tool_delay = self.magnitude
        observer.keep_history(self.magnitude)


@dataclass(frozen=True, kw_only=True)
class ImageLatency(SensingDisturbance[Observer]):
    """Images and points arrive late."""

    magnitude: float = number(0.2, unit="s", at_least=0, at_most=10)
    """Delay [s]."""

    def begin(self, observer: Observer) -> None:
        """Delay images and points."""
        observer.faults.image_delay = self.magnitude
        observer.keep_history(self.magnitude)


@dataclass(frozen=True, kw_only=True)
class FrameDrop(SensingDisturbance[Observer]):
    """Frames are lost."""

    magnitude: float = number(0.2, at_least=0, at_most=0.9)
    """Share of frames that are lost."""

    def begin(self, observer: Observer) -> None:
        """Lose frames at random."""
        observer.faults.drop_probability = self.magnitude


@dataclass(frozen=True, kw_only=True)
class FrameRepeat(SensingDisturbance[Observer]):
    """Frames show the frame before again."""

    magnitude: float = number(0.2, at_least=0, at_most=0.9)
    """Share of frames that are repeated."""

    def begin(self, observer: Observer) -> None:
        """Repeat frames at random."""
        observer.faults.repeat_probability = self.magnitude


@dataclass(frozen=True, kw_only=True)
class CameraBias(SensingDisturbance[Observer]):
    """The camera pair is displaced or tilted against its calibration."""

    magnitude: float = number(2e-3, unit="m", at_least=0, at_most=0.1)
    """Length of the displacement [m]."""
    azimuth_deg: float = number(0.0, unit="degrees", at_least=-360, at_most=360)
    """Direction of the displacement in the image [degrees]: 0 right, 90 down."""
    pitch_deg: float = number(0.0, unit="degrees", at_least=-30, at_most=30)
    """Rotation about the image's horizontal axis [degrees]."""

    def begin(self, observer: Observer) -> None:
        """Move the pair, not its calibration."""
        T = _pose(_sideways(self.magnitude, self.azimuth_deg), rotation_deg=(self.pitch_deg, 0.0, 0.0))
        observer.faults.camera_motions.append(lambda _: T)


@dataclass(frozen=True, kw_only=True)
class CameraDrift(SensingDisturbance[Observer]):
    """The camera pair moves and rolls slowly."""

    magnitude: float = number(2e-4, unit="m/s", at_least=0, at_most=0.1)
    """Speed [m/s]."""
    azimuth_deg: float = number(0.0, unit="degrees", at_least=-360, at_most=360)
    """Direction of motion in the image [degrees]: 0 right, 90 down."""
    roll_deg: float = number(0.05, unit="degrees/s", at_least=-10, at_most=10)
    """Rotation rate about the optical axis [degrees/s]."""

    def begin(self, observer: Observer) -> None:
        """Let the pair move from now on."""

        def motion(time: float) -> Float[np.ndarray, "4 4"]:
            age = max(time - self.start, 0.0)
            return _pose(
                _sideways(self.magnitude * age, self.azimuth_deg), rotation_deg=(0.0, 0.0, self.roll_deg * age)
            )

        observer.faults.camera_motions.append(motion)


@dataclass(frozen=True, kw_only=True)
class DepthScale(SensingDisturbance[Observer]):
    """The pair's baseline differs from its calibration: all distances from the camera are wrong by one factor."""

    magnitude: float = number(1.03, above=0.2, at_most=5)
    """Measured over true distance."""

    def begin(self, observer: Observer) -> None:
        """Move the right camera, not its calibration."""
        observer.faults.depth_scale = self.magnitude


@dataclass(frozen=True, kw_only=True)
class PointSlip(SensingDisturbance[Observer]):
    """Tracked points slide over the tissue."""

    needs: ClassVar[tuple[str, ...]] = ("points", "particles")
    magnitude: float = number(1e-4, unit="m/s", at_least=0, at_most=0.1)
    """Speed [m/s]."""
    azimuth_deg: float = number(0.0, unit="degrees", at_least=-360, at_most=360)
    """Direction over the sheet, counter-clockwise from x [degrees]."""

    def begin(self, observer: Observer) -> None:
        """Let the points slide from now on."""
        observer.faults.track_velocity = _sideways(self.magnitude, self.azimuth_deg)[:2]


@dataclass(frozen=True, kw_only=True)
class Inertia(TissueDisturbance[Simulation]):
    """Frames are taken while the sheet still moves."""

    magnitude: float = number(0.04, unit="s", above=0, at_most=8)
    """Time from the tool's stop to the frame, unless the sheet comes to rest before [s]."""

    def begin(self, simulation: Simulation) -> None:
        """Shorten the wait after a move."""
        simulation.max_steps_after_move = max(round(self.magnitude / simulation.model.opt.timestep), 1)


def _sideways(length: float, azimuth_deg: float) -> Float[np.ndarray, " 3"]:
    """Return a vector in the x-y plane."""
    azimuth = math.radians(azimuth_deg)
    return length * np.array([math.cos(azimuth), math.sin(azimuth), 0.0])


def _pose(shift: Float[np.ndarray, " 3"], *, rotation_deg: tuple[float, float, float]) -> Float[np.ndarray, "4 4"]:
    """Return the pose of a rotation by a rotation vector followed by a shift [m]."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(rotation_deg, degrees=True).as_matrix(), shift
    return T
