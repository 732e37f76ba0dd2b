"""Disturbances of the sheet's surroundings: gravity, bed, friction, drag."""

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from ..scene.disturbance import TissueDisturbance
from ..scene.section import number
from ..tissue.simulation import Simulation

MIN_FRICTION = 1e-5
"""Smallest friction coefficient that MuJoCo accepts."""


def _tilted(tilt_deg: float, azimuth_deg: float) -> Float[np.ndarray, " 3"]:
    """Return the vertical unit vector, tilted towards an azimuth."""
    tilt, azimuth = math.radians(tilt_deg), math.radians(azimuth_deg)
    return np.array([math.sin(tilt) * math.cos(azimuth), math.sin(tilt) * math.sin(azimuth), math.cos(tilt)])


@dataclass(frozen=True, kw_only=True)
class Gravity(TissueDisturbance[Simulation]):
    """Another weight, or a tilted table."""

    magnitude: float = number(0.0, at_least=0, at_most=10)
    """Factor on the weight; 0 is none."""
    tilt_deg: float = number(0.0, unit="degrees", at_least=0, at_most=90)
    """Angle of the weight from the vertical [degrees]."""
    azimuth_deg: float = number(0.0, unit="degrees", at_least=-360, at_most=360)
    """Direction in which a tilted weight pulls, counter-clockwise from x [degrees]."""

    def begin(self, simulation: Simulation) -> None:
        """Scale and tilt gravity."""
        g = np.linalg.norm(simulation.model.opt.gravity)
        simulation.model.opt.gravity[:] = -self.magnitude * g * _tilted(self.tilt_deg, self.azimuth_deg + 180)


@dataclass(frozen=True, kw_only=True)
class Friction(TissueDisturbance[Simulation]):
    """Another friction between tissue and bed."""

    magnitude: float = number(2.0, at_least=0, at_most=10)
    """Coulomb coefficient."""

    def begin(self, simulation: Simulation) -> None:
        """Set the friction of both tissue and bed, because MuJoCo takes the larger one."""
        model = simulation.model
        model.flex_friction[:, 0] = max(self.magnitude, MIN_FRICTION)
        model.geom_friction[_bed(model), 0] = max(self.magnitude, MIN_FRICTION)


@dataclass(frozen=True, kw_only=True)
class Bed(TissueDisturbance[Simulation]):
    """A bed that is higher, tilted or soft."""

    magnitude: float = number(2e-3, unit="m", at_least=-0.05, at_most=0.05)
    """Rise of the bed in the middle of the sheet [m]."""
    tilt_deg: float = number(0.0, unit="degrees", at_least=0, at_most=45)
    """Angle of its normal from the vertical [degrees]."""
    azimuth_deg: float = number(0.0, unit="degrees", at_least=-360, at_most=360)
    """Direction in which its normal tilts, counter-clockwise from x [degrees]."""
    softness: float = number(1.0, at_least=1, at_most=1e4)
    """Factor by which its contact is less stiff."""

    def begin(self, simulation: Simulation) -> None:
        """Move and tilt the plane, and soften its contact with the sheet."""
        model = simulation.model
        bed = _bed(model)
        model.geom_sameframe[bed] = 0  # otherwise MuJoCo uses the body's position for the geom
        model.geom_pos[bed, 2] += self.magnitude
        mujoco.mju_quatZ2Vec(model.geom_quat[bed], _tilted(self.tilt_deg, self.azimuth_deg))
        factor = np.array([1 / self.softness, 1 / math.sqrt(self.softness)])
        model.geom_solref[bed] *= factor
        model.flex_solref[0] *= factor


@dataclass(frozen=True, kw_only=True)
class ViscousDrag(TissueDisturbance[Simulation]):
    """A liquid around the sheet."""

    magnitude: float = number(1.0, unit="Pa s", at_least=0, at_most=100)
    """Viscosity [Pa s]; MuJoCo computes the drag of a box of 2.4 mm for each vertex."""

    def begin(self, simulation: Simulation) -> None:
        """Set the viscosity of the medium."""
        simulation.model.opt.viscosity = self.magnitude


def _bed(model: mujoco.MjModel) -> int:
    """Return the id of the bed's geom; -1 without a bed."""
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "bed")
