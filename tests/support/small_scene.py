"""A small scene for tests that need no file, and a disturbance that makes a simulation unstable."""

from dataclasses import dataclass

from jiggle_mj.scenes.scene.attachments import Disc
from jiggle_mj.scenes.scene.disturbance import TissueDisturbance
from jiggle_mj.scenes.scene.scene import Scene, TissueConfig
from jiggle_mj.scenes.scene.section import number
from jiggle_mj.scenes.tissue.simulation import MAX_SPEED, Simulation

SCENE = Scene(
    name="small",
    tissue=TissueConfig(size=(0.05, 0.05), spacing=6e-3),
    attachments=(Disc(centre=(0.0, 0.0), radius=9e-3, stiffness=1.0),),
)


@dataclass(frozen=True, kw_only=True)
class Explosion(TissueDisturbance[Simulation]):
    """The whole sheet moves faster than a stable state may, so that the simulation raises a SimulationError.

    It is in no registry: give it to a scene, as in `replace(SCENE, disturbances=(Explosion(),))`.
    """

    magnitude: float = number(100.0 * MAX_SPEED, unit="m/s", above=MAX_SPEED)
    """Speed of every vertex along each axis [m/s]."""

    def begin(self, simulation: Simulation) -> None:
        """Set the speed of every vertex."""
        simulation.data.qvel[simulation.model.jnt_dofadr[simulation.tissue.joints]] = self.magnitude
