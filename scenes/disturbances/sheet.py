"""Disturbances of the tissue itself: its stiffness from place to place and with direction, its rest state, its flow."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from ..scene.disturbance import TissueDisturbance, meet_sheet
from ..scene.section import integer, number, vector
from ..tissue.elements import Elements
from ..tissue.simulation import Simulation


@dataclass(frozen=True, kw_only=True)
class MaterialDamping(TissueDisturbance[Simulation]):
    """The tissue resists fast stretching, and lags behind."""

    magnitude: float = number(0.5, unit="s", at_least=0, at_most=100)
    """Rayleigh damping: viscous stress per elastic stress rate."""

    def begin(self, simulation: Simulation) -> None:
        """Of the shell."""
        simulation.model.flex_damping[:] = self.magnitude


@dataclass(frozen=True, kw_only=True)
class Stretch(TissueDisturbance[Simulation]):
    """Another membrane stiffness, bending left alone."""

    magnitude: float = number(2.0, above=0, at_most=100)
    """Times the stiffness."""

    def begin(self, simulation: Simulation) -> None:
        """Of all elements."""
        simulation.model.flex_stiffness[:] *= self.magnitude


@dataclass(frozen=True, kw_only=True)
class Poisson(TissueDisturbance[Simulation]):
    """Narrows more or less than is said as it is stretched, Young's modulus and bending left alone."""

    magnitude: float = number(0.2, at_least=0, below=0.5)
    """Poisson's ratio."""

    def begin(self, simulation: Simulation) -> None:
        """Add the difference between the two isotropic sheets' energies."""
        tissue = simulation.scene.tissue
        change = _plane_stress(self.magnitude) - _plane_stress(tissue.poisson)
        Elements(simulation).add(tissue.young * tissue.thickness * change)


@dataclass(frozen=True, kw_only=True)
class Bending(TissueDisturbance[Simulation]):
    """Another bending stiffness."""

    magnitude: float = number(20.0, above=0, at_most=1000)
    """Times the stiffness."""

    def begin(self, simulation: Simulation) -> None:
        """Of all hinges."""
        simulation.model.flex_bending[:] *= self.magnitude


@dataclass(frozen=True, kw_only=True)
class Inclusion(TissueDisturbance[Simulation]):
    """A stiff or soft spot."""

    magnitude: float = number(10.0, above=0, at_most=1000)
    """Times the membrane stiffness."""
    centre: tuple[float, float] = vector((-0.025, -0.025), length=2, unit="m")
    """Tissue coordinates."""
    radius: float = number(0.012, unit="m", above=0, at_most=1)

    def check(self, size: tuple[float, float]) -> None:
        """Refuse a spot off the sheet."""
        meet_sheet(size, self.centre, self.radius, what="inclusion.centre")

    def begin(self, simulation: Simulation) -> None:
        """Of the elements whose middle lies in it, or the nearest."""
        elements = Elements(simulation)
        distance = np.linalg.norm(elements.centres - np.array(self.centre), axis=1)
        inside = (distance <= self.radius) | (distance == distance.min())
        elements.stiffness[inside] *= self.magnitude


@dataclass(frozen=True, kw_only=True)
class Heterogeneity(TissueDisturbance[Simulation]):
    """A stiffness that varies smoothly from place to place."""

    magnitude: float = number(0.5, at_least=0, at_most=3)
    """Standard deviation of the stiffness's logarithm."""
    length: float = number(0.02, unit="m", above=0, at_most=1)
    """Wavelengths are about five times this."""
    seed: int = integer(0, at_least=0, at_most=2**32 - 1)
    """Draws the field."""

    def begin(self, simulation: Simulation) -> None:
        """A sum of plane waves with a Gaussian spectrum."""
        elements, draw = Elements(simulation), np.random.default_rng(self.seed)
        wave = draw.standard_normal((WAVES, 2)) / self.length
        phase = draw.uniform(0, 2 * np.pi, WAVES)
        field = np.sqrt(2 / WAVES) * np.cos(elements.centres @ wave.T + phase).sum(axis=1)
        elements.stiffness[:] *= np.exp(self.magnitude * field)[:, None]


@dataclass(frozen=True, kw_only=True)
class Anisotropy(TissueDisturbance[Simulation]):
    """Fibres: stiffer along one direction."""

    magnitude: float = number(3.0, at_least=0, at_most=100)
    """What the fibres add along themselves, over the tissue's own Young's modulus."""
    direction_deg: float = number(0.0, unit="degrees", at_least=-360, at_most=360)
    """Of the fibres, counter-clockwise from x."""

    def begin(self, simulation: Simulation) -> None:
        """Add the energy of the strain along them, E t m / 2 an area."""
        tissue, turn = simulation.scene.tissue, math.radians(self.direction_deg)
        c, s = math.cos(turn), math.sin(turn)
        along = np.array([c**2, s**2, 2 * c * s])
        Elements(simulation).add(self.magnitude * tissue.young * tissue.thickness * np.outer(along, along))


@dataclass(frozen=True, kw_only=True)
class PreStrain(TissueDisturbance[Simulation]):
    """The sheet is stretched where it lies: its own rest lengths are shorter."""

    magnitude: float = number(0.03, at_least=-0.3, at_most=0.3)
    """By which share."""
    uniaxial: float = number(0.0, at_least=0, at_most=1)
    """0 in all directions alike, 1 along `direction_deg` alone."""
    direction_deg: float = number(0.0, unit="degrees", at_least=-360, at_most=360)
    """Counter-clockwise from x."""

    def begin(self, simulation: Simulation) -> None:
        """Shorten each edge by what its direction asks."""
        model, place = simulation.model, simulation.tissue.sheet.vertices
        edge = place[model.flex_edge[:, 1]] - place[model.flex_edge[:, 0]]
        turn = math.radians(self.direction_deg)
        cosine = edge @ np.array([math.cos(turn), math.sin(turn)]) / np.linalg.norm(edge, axis=1)
        model.flexedge_length0[:] *= 1 - self.magnitude * (1 - self.uniaxial * (1 - cosine**2))


@dataclass(frozen=True, kw_only=True)
class StrainStiffening(TissueDisturbance[Simulation]):
    """Collagen: the more the tissue is stretched the stiffer it is."""

    magnitude: float = number(400.0, at_least=0, at_most=1e5)
    """Stiffness rises by this times the squared strain."""

    def begin(self, simulation: Simulation) -> None:
        """Scale each element's stiffness by its own strain, step after step, whatever else changes it."""
        elements = Elements(simulation)
        before = np.ones(len(elements.stiffness))

        def stiffen() -> None:
            nonlocal before
            now = 1 + self.magnitude * elements.squared_strain()
            elements.stiffness[:] *= (now / before)[:, None]
            before = now

        simulation.rules.append(stiffen)


@dataclass(frozen=True, kw_only=True)
class TissueCreep(TissueDisturbance[Simulation]):
    """Stretched tissue grows longer slowly."""

    magnitude: float = number(0.3, unit="1/s", above=0, at_most=100)
    """Share of its elongation by which an edge's rest length follows in a second."""

    def begin(self, simulation: Simulation) -> None:
        """Let the rest lengths follow."""
        simulation.rules.append(self._flow(simulation))

    def _flow(self, simulation: Simulation) -> Callable[[], None]:
        model, data = simulation.model, simulation.data
        share = -math.expm1(-self.magnitude * model.opt.timestep)

        def flow() -> None:
            model.flexedge_length0[:] += share * (data.flexedge_length - model.flexedge_length0)

        return flow


@dataclass(frozen=True, kw_only=True)
class TissueYield(TissueDisturbance[Simulation]):
    """Tissue that is stretched or bent too far stays so."""

    magnitude: float = number(0.05, at_least=0.03, at_most=10)
    """Strain at which it yields. At 0.02 MuJoCo's plastic flow runs away when the sheet is pushed back."""

    def prepare(self, spec: mujoco.MjSpec) -> None:
        """Have MuJoCo keep the plastic state, with a limit that nothing reaches yet."""
        spec.flexes[0].stressyield = [NEVER, NEVER]

    def begin(self, simulation: Simulation) -> None:
        """Set the limit."""
        simulation.model.flex_yield[:] = self.magnitude


WAVES = 64
NEVER = 1e3
"""A strain."""


def _plane_stress(poisson: float) -> Float[np.ndarray, "3 3"]:
    """Of an isotropic sheet with a Young's modulus of 1, over (E_xx, E_yy, E_xy)."""
    return np.array([[1, poisson, 0], [poisson, 1, 0], [0, 0, 2 * (1 - poisson)]]) / (1 - poisson**2)
