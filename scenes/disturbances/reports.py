"""Disturbances of timing and place: the tool's report, the camera's pose, frames that are late, lost or repeated."""

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
    """The tip is not where the robot says."""

    magnitude: float = number(2e-3, unit="m", at_least=0, at_most=0.1)
    direction: tuple[float, float, float] = vector((1.0, 0.0, 0.0), length=3, direction=True)
    """From the true to the reported tip, world; its length does not count."""

    def begin(self, observer: Observer) -> None:
        """Move the report."""
        way = np.array(self.direction)
        observer.faults.tool_offset = self.magnitude * way / np.linalg.norm(way)


@dataclass(frozen=True, kw_only=True)
class ToolScale(SensingDisturbance[Observer]):
    """The tool moves by another amount than the robot says, since the jaws closed."""

    magnitude: float = number(1.05, above=0, at_most=10)
    """Reported over true way."""

    def begin(self, observer: Observer) -> None:
        """Stretch the report."""
        observer.faults.tool_scale = self.magnitude


@dataclass(frozen=True, kw_only=True)
class ToolTurn(SensingDisturbance[Observer]):
    """The robot's axes are turned against the camera's, and with them the way that it reports since the jaws closed."""

    magnitude: float = number(3.0, unit="degrees", at_least=-180, at_most=180)
    about: tuple[float, float, float] = vector((0.0, 1.0, 0.0), length=3, direction=True)
    """The axis of the turn, world; its length does not count."""

    def begin(self, observer: Observer) -> None:
        """Turn the report."""
        axis = np.array(self.about) / np.linalg.norm(self.about)
        observer.faults.tool_turn = Rotation.from_rotvec(self.magnitude * axis, degrees=True).as_matrix()


@dataclass(frozen=True, kw_only=True)
class ToolLatency(SensingDisturbance[Observer]):
    """The tool's pose is old when it is reported."""

    magnitude: float = number(0.2, unit="s", at_least=0, at_most=10)

    def begin(self, observer: Observer) -> None:
        """Delay the report."""
        observer.faults.tool_delay = self.magnitude
        observer.remember(self.magnitude)


@dataclass(frozen=True, kw_only=True)
class ImageLatency(SensingDisturbance[Observer]):
    """What is seen is old when it comes."""

    magnitude: float = number(0.2, unit="s", at_least=0, at_most=10)

    def begin(self, observer: Observer) -> None:
        """Delay images and points."""
        observer.faults.image_delay = self.magnitude
        observer.remember(self.magnitude)


@dataclass(frozen=True, kw_only=True)
class FrameDrop(SensingDisturbance[Observer]):
    """Frames are lost."""

    magnitude: float = number(0.2, at_least=0, at_most=0.9)
    """Share of them."""

    def begin(self, observer: Observer) -> None:
        """Lose them at random."""
        observer.faults.lost = self.magnitude


@dataclass(frozen=True, kw_only=True)
class FrameRepeat(SensingDisturbance[Observer]):
    """Frames show once more what the one before showed."""

    magnitude: float = number(0.2, at_least=0, at_most=0.9)
    """Share of them."""

    def begin(self, observer: Observer) -> None:
        """Repeat at random."""
        observer.faults.repeated = self.magnitude


@dataclass(frozen=True, kw_only=True)
class CameraBias(SensingDisturbance[Observer]):
    """The camera pair stands beside where it was calibrated, or looks beside."""

    magnitude: float = number(2e-3, unit="m", at_least=0, at_most=0.1)
    azimuth_deg: float = number(0.0, unit="degrees", at_least=-360, at_most=360)
    """Which way in the image: 0 right, 90 down."""
    pitch_deg: float = number(0.0, unit="degrees", at_least=-30, at_most=30)
    """Turn about the image's horizontal axis."""

    def begin(self, observer: Observer) -> None:
        """Move the pair, not its calibration."""
        T = _pose(_sideways(self.magnitude, self.azimuth_deg), turn_deg=(self.pitch_deg, 0.0, 0.0))
        observer.faults.rig.append(lambda _: T)


@dataclass(frozen=True, kw_only=True)
class CameraDrift(SensingDisturbance[Observer]):
    """The camera pair slides and rolls slowly."""

    magnitude: float = number(2e-4, unit="m/s", at_least=0, at_most=0.1)
    azimuth_deg: float = number(0.0, unit="degrees", at_least=-360, at_most=360)
    """Which way in the image: 0 right, 90 down."""
    roll_deg: float = number(0.05, unit="degrees/s", at_least=-10, at_most=10)
    """About the line of sight."""

    def begin(self, observer: Observer) -> None:
        """Let the pair move from now on."""

        def moved(time: float) -> Float[np.ndarray, "4 4"]:
            age = max(time - self.start, 0.0)
            return _pose(_sideways(self.magnitude * age, self.azimuth_deg), turn_deg=(0.0, 0.0, self.roll_deg * age))

        observer.faults.rig.append(moved)


@dataclass(frozen=True, kw_only=True)
class DepthScale(SensingDisturbance[Observer]):
    """The pair's baseline is not what its calibration says: all distances from the camera are wrong by one factor."""

    magnitude: float = number(1.03, above=0.2, at_most=5)
    """Measured over true."""

    def begin(self, observer: Observer) -> None:
        """Move the right camera, not its calibration."""
        observer.faults.depth_scale = self.magnitude


@dataclass(frozen=True, kw_only=True)
class PointSlip(SensingDisturbance[Observer]):
    """Tracked points slide over the tissue."""

    needs: ClassVar[tuple[str, ...]] = ("points", "particles")
    magnitude: float = number(1e-4, unit="m/s", at_least=0, at_most=0.1)
    azimuth_deg: float = number(0.0, unit="degrees", at_least=-360, at_most=360)
    """Which way over the sheet, counter-clockwise from x."""

    def begin(self, observer: Observer) -> None:
        """Let them slide."""
        observer.faults.slip = _sideways(self.magnitude, self.azimuth_deg)[:2]


@dataclass(frozen=True, kw_only=True)
class Inertia(TissueDisturbance[Simulation]):
    """Frames are taken while the sheet still moves."""

    magnitude: float = number(0.04, unit="s", above=0, at_most=8)
    """How long after the tool stopped, unless the sheet comes to rest before."""

    def begin(self, simulation: Simulation) -> None:
        """Wait no longer."""
        simulation.patience = max(round(self.magnitude / simulation.model.opt.timestep), 1)


def _sideways(length: float, azimuth_deg: float) -> Float[np.ndarray, " 3"]:
    """A vector in the x-y plane."""
    azimuth = math.radians(azimuth_deg)
    return length * np.array([math.cos(azimuth), math.sin(azimuth), 0.0])


def _pose(shift: Float[np.ndarray, " 3"], *, turn_deg: tuple[float, float, float]) -> Float[np.ndarray, "4 4"]:
    """A shift [m] after small turns about x, y and z."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix(), shift
    return T
