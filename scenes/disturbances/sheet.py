"""Disturbances of the material: its stiffness, damping, rest state, creep and yield."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from ..scene.disturbance import TissueDisturbance, check_spot_on_sheet
from ..scene.section import integer, number, vector
from ..tissue.elements import Elements
from ..tissue.simulation import Simulation

N_WAVES = 64
"""Number of plane waves in the field of a heterogeneous stiffness."""
UNREACHED_STRAIN = 1e3
"""Yield strain before the yield begins; no tissue reaches it."""


@dataclass(frozen=True, kw_only=True)
class MaterialDamping(TissueDisturbance[Simulation]):
    """The tissue resists fast deformation, and lags behind the tool."""

    magnitude: float = number(0.5, unit="s", at_least=0, at_most=100)
    """Rayleigh damping: viscous stress over the rate of elastic stress [s]."""

    def begin(self, simulation: Simulation) -> None:
        """Set the damping of the shell."""
        simulation.model.flex_damping[:] = self.magnitude


@dataclass(frozen=True, kw_only=True)
class Stretch(TissueDisturbance[Simulation]):
    """Another membrane stiffness at the same bending stiffness."""

    magnitude: float = number(2.0, above=0, at_most=100)
    """Factor on the stiffness."""

    def begin(self, simulation: Simulation) -> None:
        """Scale the stiffness of all elements."""
        simulation.model.flex_stiffness[:] *= self.magnitude


@dataclass(frozen=True, kw_only=True)
class Poisson(TissueDisturbance[Simulation]):
    """Another Poisson's ratio at the same Young's modulus and bending stiffness."""

    magnitude: float = number(0.2, at_least=0, below=0.5)
    """Poisson's ratio."""

    def begin(self, simulation: Simulation) -> None:
        """Add the difference between the energies of the two isotropic sheets."""
        tissue = simulation.scene.tissue
        change = _plane_stress(self.magnitude) - _plane_stress(tissue.poisson)
        Elements(simulation).add(tissue.young * tissue.thickness * change)


@dataclass(frozen=True, kw_only=True)
class Bending(TissueDisturbance[Simulation]):
    """Another bending stiffness."""

    magnitude: float = number(20.0, above=0, at_most=1000)
    """Factor on the stiffness."""

    def begin(self, simulation: Simulation) -> None:
        """Scale the stiffness of all hinges."""
        simulation.model.flex_bending[:] *= self.magnitude


@dataclass(frozen=True, kw_only=True)
class Inclusion(TissueDisturbance[Simulation]):
    """A stiff or soft spot."""

    magnitude: float = number(10.0, above=0, at_most=1000)
    """Factor on the membrane stiffness."""
    centre: tuple[float, float] = vector((-0.025, -0.025), length=2, unit="m")
    """Centre in tissue coordinates [m]."""
    radius: float = number(0.012, unit="m", above=0, at_most=1)
    """Radius [m]."""

    def check(self, size: tuple[float, float]) -> None:
        """Refuse a spot off the sheet."""
        check_spot_on_sheet(size, self.centre, self.radius, key="inclusion.centre")

    def begin(self, simulation: Simulation) -> None:
        """Scale the stiffness of the elements whose centroid lies in the spot, or of the nearest one."""
        elements = Elements(simulation)
        distance = np.linalg.norm(elements.centres - np.array(self.centre), axis=1)
        inside = (distance <= self.radius) | (distance == distance.min())
        elements.stiffness[inside] *= self.magnitude


@dataclass(frozen=True, kw_only=True)
class Heterogeneity(TissueDisturbance[Simulation]):
    """A stiffness that varies smoothly over the sheet."""

    magnitude: float = number(0.5, at_least=0, at_most=3)
    """Standard deviation of the stiffness's logarithm."""
    length: float = number(0.02, unit="m", above=0, at_most=1)
    """Correlation length [m]; wavelengths are about five times as long."""
    seed: int = integer(0, at_least=0, at_most=2**32 - 1)
    """Seed of the field."""

    def begin(self, simulation: Simulation) -> None:
        """Scale each element by the exponential of a sum of plane waves with a Gaussian spectrum."""
        elements, rng = Elements(simulation), np.random.default_rng(self.seed)
        wave = rng.standard_normal((N_WAVES, 2)) / self.length
        phase = rng.uniform(0, 2 * np.pi, N_WAVES)
        field = np.sqrt(2 / N_WAVES) * np.cos(elements.centres @ wave.T + phase).sum(axis=1)
        elements.stiffness[:] *= np.exp(self.magnitude * field)[:, None]


@dataclass(frozen=True, kw_only=True)
class Anisotropy(TissueDisturbance[Simulation]):
    """Fibres make the tissue stiffer along one direction."""

    magnitude: float = number(3.0, at_least=0, at_most=100)
    """Stiffness that the fibres add along themselves, over the tissue's own Young's modulus."""
    direction_deg: float = number(0.0, unit="degrees", at_least=-360, at_most=360)
    """Direction of the fibres, counter-clockwise from x [degrees]."""

    def begin(self, simulation: Simulation) -> None:
        """Add the energy density m E t e^2 / 2, with e the strain along the fibres."""
        tissue, angle = simulation.scene.tissue, math.radians(self.direction_deg)
        c, s = math.cos(angle), math.sin(angle)
        along = np.array([c**2, s**2, 2 * c * s])
        Elements(simulation).add(self.magnitude * tissue.young * tissue.thickness * np.outer(along, along))


@dataclass(frozen=True, kw_only=True)
class PreStrain(TissueDisturbance[Simulation]):
    """The sheet is stretched at rest: its own rest lengths are shorter."""

    magnitude: float = number(0.03, at_least=-0.3, at_most=0.3)
    """Share by which the rest lengths are shorter."""
    uniaxial: float = number(0.0, at_least=0, at_most=1)
    """0 is equal in all directions, 1 is along `direction_deg` only."""
    direction_deg: float = number(0.0, unit="degrees", at_least=-360, at_most=360)
    """Direction, counter-clockwise from x [degrees]."""

    def begin(self, simulation: Simulation) -> None:
        """Shorten each edge according to its direction."""
        model, place = simulation.model, simulation.tissue.sheet.vertices
        edge = place[model.flex_edge[:, 1]] - place[model.flex_edge[:, 0]]
        angle = math.radians(self.direction_deg)
        cosine = edge @ np.array([math.cos(angle), math.sin(angle)]) / np.linalg.norm(edge, axis=1)
        model.flexedge_length0[:] *= 1 - self.magnitude * (1 - self.uniaxial * (1 - cosine**2))


@dataclass(frozen=True, kw_only=True)
class StrainStiffening(TissueDisturbance[Simulation]):
    """The tissue becomes stiffer as it is stretched, as collagen does."""

    magnitude: float = number(400.0, at_least=0, at_most=1e5)
    """Relative increase of the stiffness over the squared Green strain."""

    def begin(self, simulation: Simulation) -> None:
        """Scale each element's stiffness by its own strain after each step; changes by other disturbances remain."""
        elements = Elements(simulation)
        factor = np.ones(len(elements.stiffness))

        def stiffen() -> None:
            nonlocal factor
            new_factor = 1 + self.magnitude * elements.squared_strain()
            elements.stiffness[:] *= (new_factor / factor)[:, None]
            factor = new_factor

        simulation.step_hooks.append(stiffen)


@dataclass(frozen=True, kw_only=True)
class TissueCreep(TissueDisturbance[Simulation]):
    """Stretched tissue slowly grows longer."""

    magnitude: float = number(0.3, unit="1/s", above=0, at_most=100)
    """Rate at which an edge's rest length follows its length, as a share of the elongation per second [1/s]."""

    def begin(self, simulation: Simulation) -> None:
        """Let the rest lengths follow after each step."""
        simulation.step_hooks.append(self._flow(simulation))

    def _flow(self, simulation: Simulation) -> Callable[[], None]:
        model, data = simulation.model, simulation.data
        share = -math.expm1(-self.magnitude * model.opt.timestep)

        def flow() -> None:
            model.flexedge_length0[:] += share * (data.flexedge_length - model.flexedge_length0)

        return flow


@dataclass(frozen=True, kw_only=True)
class TissueYield(TissueDisturbance[Simulation]):
    """Tissue that is stretched or bent too far keeps its shape."""

    magnitude: float = number(0.05, at_least=0.03, at_most=10)
    """Strain at which it yields. At 0.02 MuJoCo's plastic flow becomes unstable when the sheet is pushed back."""

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Have MuJoCo store the plastic state, with a limit that no strain reaches yet."""
        spec.flexes[0].stressyield = [UNREACHED_STRAIN, UNREACHED_STRAIN]

    def begin(self, simulation: Simulation) -> None:
        """Set the yield strain."""
        simulation.model.flex_yield[:] = self.magnitude


def _plane_stress(poisson: float) -> Float[np.ndarray, "3 3"]:
    """Return the stiffness of an isotropic sheet with a Young's modulus of 1, over (E_xx, E_yy, E_xy)."""
    return np.array([[1, poisson, 0], [poisson, 1, 0], [0, 0, 2 * (1 - poisson)]]) / (1 - poisson**2)
