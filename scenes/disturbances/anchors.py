"""Disturbances of what holds or pulls the sheet: attachments, their substrate, adhesion, a hidden pull, the jaws."""

from dataclasses import dataclass

import numpy as np

from ..scene.disturbance import TissueDisturbance, check_spot_on_sheet
from ..scene.section import number, vector
from ..tissue.simulation import Simulation
from ..tissue.springs import Springs

SUBSTRATE_RELAXATION = 0.3
"""Share of its remaining displacement that the substrate moves in one step; the whole of it would overshoot."""


@dataclass(frozen=True, kw_only=True)
class AnchorShift(TissueDisturbance[Simulation]):
    """All anchors are displaced from the sheet's rest position, and pull at it from the start."""

    magnitude: float = number(2e-3, unit="m", at_least=0, at_most=0.05)
    """Length of the displacement [m]."""
    direction: tuple[float, float, float] = vector((0.0, 0.0, -1.0), length=3, direction=True)
    """Direction of the displacement, world; its length does not count. A sheet that nothing else holds follows a shift
    along the bed."""

    def begin(self, simulation: Simulation) -> None:
        """Move the anchors of the springs; a weld has none."""
        direction, springs = np.array(self.direction), simulation.anchors.attachments
        springs.anchor = springs.anchor + self.magnitude * direction / np.linalg.norm(direction)
        simulation.anchors.write()


@dataclass(frozen=True, kw_only=True)
class AnchorYield(TissueDisturbance[Simulation]):
    """Anchors follow the tissue once their springs are stretched too far."""

    magnitude: float = number(2e-3, unit="m", above=0, at_most=1)
    """Largest elongation of a spring [m]."""

    def begin(self, simulation: Simulation) -> None:
        """Lower the elongation at which the springs yield."""
        springs = simulation.anchors.attachments
        springs.yields_at = np.minimum(springs.yields_at, self.magnitude)


@dataclass(frozen=True, kw_only=True)
class AnchorCreep(TissueDisturbance[Simulation]):
    """Anchors follow the tissue slowly."""

    magnitude: float = number(0.5, unit="1/s", above=0, at_most=100)
    """Rate at which an anchor follows, as a share of its spring's elongation per second [1/s]."""

    def begin(self, simulation: Simulation) -> None:
        """Raise the creep rate of the springs."""
        springs = simulation.anchors.attachments
        springs.creep = np.maximum(springs.creep, self.magnitude)


@dataclass(frozen=True, kw_only=True)
class AnchorBreak(TissueDisturbance[Simulation]):
    """Attachments, welds among them, break under load."""

    magnitude: float = number(8e-3, unit="N", above=0, at_most=100)
    """Largest force of one attachment [N]."""

    def begin(self, simulation: Simulation) -> None:
        """Lower the force at which springs and welds break."""
        anchors = simulation.anchors
        anchors.attachments.breaks_at = np.minimum(anchors.attachments.breaks_at, self.magnitude)
        anchors.welds_break_at = np.minimum(anchors.welds_break_at, self.magnitude)


@dataclass(frozen=True, kw_only=True)
class Substrate(TissueDisturbance[Simulation]):
    """The substrate under the anchors is soft: an attachment load moves its own anchor and those around it."""

    magnitude: float = number(1.0, unit="N/m", above=0, at_most=1e6)
    """Stiffness under a load that is spread as wide as `reach` [N/m]."""
    reach: float = number(0.01, unit="m", above=0, at_most=1)
    """Distance at which an anchor moves by exp(-1/2) times as much [m]."""

    def begin(self, simulation: Simulation) -> None:
        """Move the anchors with the attachment loads after each step."""
        springs, vertices = simulation.anchors.attachments, simulation.tissue.sheet.vertices
        distance = np.linalg.norm(vertices[:, None] - vertices, axis=2)
        kernel = np.exp(-0.5 * (distance / self.reach) ** 2)
        compliance = kernel / kernel.sum(axis=1, keepdims=True) / self.magnitude
        substrate_shift = np.zeros((len(vertices), 3))

        def shift_anchors() -> None:
            nonlocal substrate_shift
            moved = simulation.anchors.displacement
            load = springs.force(moved)[:, None] * springs.direction(moved)
            step = SUBSTRATE_RELAXATION * (compliance @ load - substrate_shift)
            substrate_shift = substrate_shift + step
            springs.anchor = springs.anchor + step
            simulation.anchors.write()

        simulation.step_hooks.append(shift_anchors)


@dataclass(frozen=True, kw_only=True)
class Adhesion(TissueDisturbance[Simulation]):
    """The wet sheet sticks to the bed until it is peeled off."""

    magnitude: float = number(0.1, unit="J/m^2", above=0, at_most=100)
    """Peeling energy per area [J/m^2]; for a film of water it is twice the surface tension."""
    reach: float = number(2e-3, unit="m", above=0, at_most=0.1)
    """Distance from the bed at which a spot comes off [m]."""

    def begin(self, simulation: Simulation) -> None:
        """Add a spring to every vertex by its share of the area; what came off does not stick again."""
        anchors, sheet = simulation.anchors, simulation.tissue.sheet
        stiffness = 2 * self.magnitude * sheet.vertex_areas() / self.reach**2
        film = Springs(stiffness=stiffness, anchor=anchors.displacement, breaks_at=stiffness * self.reach)
        anchors.extra_layers.append(film)
        anchors.write()


@dataclass(frozen=True, kw_only=True)
class PointPull(TissueDisturbance[Simulation]):
    """Something hidden, such as a tendon, pulls at one spot of the sheet towards a point."""

    magnitude: float = number(5.0, unit="N/m", above=0, at_most=1e4)
    """Stiffness of the pull, shared by the vertices of the spot [N/m]."""
    at: tuple[float, float] = vector((0.02, 0.02), length=2, unit="m")
    """Centre of the spot in tissue coordinates [m]."""
    radius: float = number(6e-3, unit="m", above=0, at_most=1)
    """Radius of the spot [m]."""
    towards: tuple[float, float, float] = vector((0.01, 0.0, -0.002), length=3, unit="m")
    """Point towards which it pulls, minus the rest position of the spot [m]."""

    def check(self, size: tuple[float, float]) -> None:
        """Refuse a spot off the sheet."""
        check_spot_on_sheet(size, self.at, self.radius, key="point_pull.at")

    def begin(self, simulation: Simulation) -> None:
        """Add springs at the vertices of the spot, or at the nearest vertex."""
        vertices = simulation.tissue.sheet.vertices
        distance = np.linalg.norm(vertices - np.array(self.at), axis=1)
        spot = (distance <= self.radius) | (distance == distance.min())
        anchors = simulation.anchors
        anchors.extra_layers.append(
            Springs(
                stiffness=np.where(spot, self.magnitude / spot.sum(), 0.0),
                anchor=np.broadcast_to(np.array(self.towards), (len(vertices), 3)),
            )
        )
        anchors.write()


@dataclass(frozen=True, kw_only=True)
class GraspSlip(TissueDisturbance[Simulation]):
    """Vertices slip out of the jaws under load."""

    magnitude: float = number(0.02, unit="N", above=0, at_most=100)
    """Largest grip force on each vertex [N]."""

    def begin(self, simulation: Simulation) -> None:
        """Set the grip force at which a vertex slips."""
        simulation.jaws.slips_at = self.magnitude
