"""Disturbances of what holds the sheet: anchors that moved, yield, creep or break, what they stand on, and the jaws."""

from dataclasses import dataclass

import numpy as np

from ..scene.disturbance import TissueDisturbance, meet_sheet
from ..scene.section import number, vector
from ..tissue.simulation import Simulation
from ..tissue.springs import Springs


@dataclass(frozen=True, kw_only=True)
class AnchorShift(TissueDisturbance[Simulation]):
    """All anchors lie beside where the sheet lay at rest, and pull at it from the start."""

    magnitude: float = number(2e-3, unit="m", at_least=0, at_most=0.05)
    direction: tuple[float, float, float] = vector((0.0, 0.0, -1.0), length=3, direction=True)
    """Which way, world; its length does not count. A sheet that nothing else holds follows a shift along the bed."""

    def begin(self, simulation: Simulation) -> None:
        """Move the springs' ends; a weld has none."""
        way, springs = np.array(self.direction), simulation.anchors.attachments
        springs.anchor = springs.anchor + self.magnitude * way / np.linalg.norm(way)
        simulation.anchors.write()


@dataclass(frozen=True, kw_only=True)
class AnchorYield(TissueDisturbance[Simulation]):
    """Anchors come after once their springs are stretched too far."""

    magnitude: float = number(2e-3, unit="m", above=0, at_most=1)
    """How far a spring stretches at most."""

    def begin(self, simulation: Simulation) -> None:
        """Set the springs' limit."""
        springs = simulation.anchors.attachments
        springs.yields_at = np.minimum(springs.yields_at, self.magnitude)


@dataclass(frozen=True, kw_only=True)
class AnchorCreep(TissueDisturbance[Simulation]):
    """Anchors come after slowly."""

    magnitude: float = number(0.5, unit="1/s", above=0, at_most=100)
    """Share of a spring's stretch by which its anchor moves in a second."""

    def begin(self, simulation: Simulation) -> None:
        """Let the springs creep."""
        springs = simulation.anchors.attachments
        springs.creep = np.maximum(springs.creep, self.magnitude)


@dataclass(frozen=True, kw_only=True)
class AnchorBreak(TissueDisturbance[Simulation]):
    """Attachments, welds among them, break under load."""

    magnitude: float = number(8e-3, unit="N", above=0, at_most=100)
    """What one carries at most."""

    def begin(self, simulation: Simulation) -> None:
        """Set the springs' and welds' limit."""
        anchors = simulation.anchors
        anchors.attachments.breaks_at = np.minimum(anchors.attachments.breaks_at, self.magnitude)
        anchors.welds_break_at = np.minimum(anchors.welds_break_at, self.magnitude)


@dataclass(frozen=True, kw_only=True)
class Substrate(TissueDisturbance[Simulation]):
    """What the anchors stand on gives way: a load moves its own anchor and those around it."""

    magnitude: float = number(1.0, unit="N/m", above=0, at_most=1e6)
    """How stiff it is under a load that is spread as wide as `reach`."""
    reach: float = number(0.01, unit="m", above=0, at_most=1)
    """Distance at which a neighbour moves by exp(-1/2) as much."""

    def begin(self, simulation: Simulation) -> None:
        """Follow the loads."""
        springs, place = simulation.anchors.attachments, simulation.tissue.sheet.vertices
        apart = np.linalg.norm(place[:, None] - place, axis=2)
        spread = np.exp(-0.5 * (apart / self.reach) ** 2)
        spread = spread / spread.sum(axis=1, keepdims=True) / self.magnitude
        sunk = np.zeros((len(place), 3))

        def sink() -> None:
            nonlocal sunk
            moved = simulation.anchors.moved
            pull = springs.force(moved)[:, None] * springs.direction(moved)
            further = FOLLOWING * (spread @ pull - sunk)
            sunk = sunk + further
            springs.anchor = springs.anchor + further
            simulation.anchors.write()

        simulation.rules.append(sink)


@dataclass(frozen=True, kw_only=True)
class Adhesion(TissueDisturbance[Simulation]):
    """The wet sheet sticks to the bed where nothing attaches it, until it is peeled off."""

    magnitude: float = number(0.1, unit="J/m^2", above=0, at_most=100)
    """What peeling takes; a film of water, twice its surface tension."""
    reach: float = number(2e-3, unit="m", above=0, at_most=0.1)
    """How far a spot lifts off before it lets go."""

    def begin(self, simulation: Simulation) -> None:
        """Hold every vertex by its share of the area; what came off does not stick again."""
        anchors, sheet = simulation.anchors, simulation.tissue.sheet
        stiffness = 2 * self.magnitude * sheet.vertex_areas() / self.reach**2
        stuck = Springs(stiffness=stiffness, anchor=anchors.moved, breaks_at=stiffness * self.reach)
        anchors.others.append(stuck)
        anchors.write()


@dataclass(frozen=True, kw_only=True)
class PointPull(TissueDisturbance[Simulation]):
    """Something out of sight, a tendon say, pulls at one spot of the sheet towards a point."""

    magnitude: float = number(5.0, unit="N/m", above=0, at_most=1e4)
    """Stiffness, shared by the vertices of the spot."""
    at: tuple[float, float] = vector((0.02, 0.02), length=2, unit="m")
    """The middle of the spot, tissue coordinates."""
    radius: float = number(6e-3, unit="m", above=0, at_most=1)
    """Of the spot."""
    towards: tuple[float, float, float] = vector((0.01, 0.0, -0.002), length=3, unit="m")
    """Where the pull would end, from where the spot lies at rest."""

    def check(self, size: tuple[float, float]) -> None:
        """Refuse a spot off the sheet."""
        meet_sheet(size, self.at, self.radius, what="point_pull.at")

    def begin(self, simulation: Simulation) -> None:
        """Add the springs."""
        place = simulation.tissue.sheet.vertices
        distance = np.linalg.norm(place - np.array(self.at), axis=1)
        spot = (distance <= self.radius) | (distance == distance.min())
        anchors = simulation.anchors
        anchors.others.append(
            Springs(
                stiffness=np.where(spot, self.magnitude / spot.sum(), 0.0),
                anchor=np.broadcast_to(np.array(self.towards), (len(place), 3)),
            )
        )
        anchors.write()


@dataclass(frozen=True, kw_only=True)
class GraspSlip(TissueDisturbance[Simulation]):
    """What is held slips out of the jaws."""

    magnitude: float = number(0.02, unit="N", above=0, at_most=100)
    """What the jaws hold of each vertex at most."""

    def begin(self, simulation: Simulation) -> None:
        """Loosen the jaws."""
        simulation.jaws.slips_at = self.magnitude


FOLLOWING = 0.3
"""Share of the way to where its loads move it that the substrate goes in a step: all of it at once would overshoot."""
