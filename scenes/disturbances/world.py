"""Disturbances of what surrounds the sheet: weight, bed, friction, drag."""

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from ..scene.disturbance import TissueDisturbance
from ..scene.section import number
from ..tissue.simulation import Simulation


def _tilted(tilt_deg: float, azimuth_deg: float) -> Float[np.ndarray, " 3"]:
    """The upright direction, tilted towards an azimuth."""
    tilt, azimuth = math.radians(tilt_deg), math.radians(azimuth_deg)
    return np.array([math.sin(tilt) * math.cos(azimuth), math.sin(tilt) * math.sin(azimuth), math.cos(tilt)])


@dataclass(frozen=True, kw_only=True)
class Gravity(TissueDisturbance[Simulation]):
    """Another weight, or a table that leans."""

    magnitude: float = number(0.0, at_least=0, at_most=10)
    """Times the weight; 0 is none."""
    tilt_deg: float = number(0.0, unit="degrees", at_least=0, at_most=90)
    azimuth_deg: float = number(0.0, unit="degrees", at_least=-360, at_most=360)
    """Where a tilted weight pulls to, counter-clockwise from x."""

    def begin(self, simulation: Simulation) -> None:
        """Turn gravity."""
        g = np.linalg.norm(simulation.model.opt.gravity)
        simulation.model.opt.gravity[:] = -self.magnitude * g * _tilted(self.tilt_deg, self.azimuth_deg + 180)


@dataclass(frozen=True, kw_only=True)
class Friction(TissueDisturbance[Simulation]):
    """Another friction between tissue and bed."""

    magnitude: float = number(2.0, at_least=0, at_most=10)
    """Coulomb coefficient."""

    def begin(self, simulation: Simulation) -> None:
        """Of tissue and bed alike, since MuJoCo takes the larger of the two."""
        model = simulation.model
        least = 1e-5
        """MuJoCo's least."""
        model.flex_friction[:, 0] = max(self.magnitude, least)
        model.geom_friction[_bed(model), 0] = max(self.magnitude, least)


@dataclass(frozen=True, kw_only=True)
class Bed(TissueDisturbance[Simulation]):
    """A bed that is higher, leans, or gives way."""

    magnitude: float = number(2e-3, unit="m", at_least=-0.05, at_most=0.05)
    """How much higher it is in the middle of the sheet."""
    tilt_deg: float = number(0.0, unit="degrees", at_least=0, at_most=45)
    azimuth_deg: float = number(0.0, unit="degrees", at_least=-360, at_most=360)
    """Which way its normal leans, counter-clockwise from x."""
    softness: float = number(1.0, at_least=1, at_most=1e4)
    """How many times less stiff its contact is."""

    def begin(self, simulation: Simulation) -> None:
        """Move the plane, and soften its contact with the sheet."""
        model = simulation.model
        bed = _bed(model)
        model.geom_sameframe[bed] = 0  # else MuJoCo takes the body's place for the geom's
        model.geom_pos[bed, 2] += self.magnitude
        mujoco.mju_quatZ2Vec(model.geom_quat[bed], _tilted(self.tilt_deg, self.azimuth_deg))
        share = np.array([1 / self.softness, 1 / math.sqrt(self.softness)])
        model.geom_solref[bed] *= share
        model.flex_solref[0] *= share


@dataclass(frozen=True, kw_only=True)
class ViscousDrag(TissueDisturbance[Simulation]):
    """A liquid around the sheet."""

    magnitude: float = number(1.0, unit="Pa s", at_least=0, at_most=100)
    """Its viscosity, as each vertex feels it: MuJoCo takes it for a box of 2.4 mm."""

    def begin(self, simulation: Simulation) -> None:
        """Fill the world."""
        simulation.model.opt.viscosity = self.magnitude


def _bed(model: mujoco.MjModel) -> int:
    """Its id, -1 where there is none."""
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "bed")
