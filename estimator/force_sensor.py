"""The force of the tool on the tissue, from what its sensor reports.

The offset that it shows while the jaws are open is subtracted in the grasp that follows. Its noise is as stated, or as
the scatter with open jaws shows it where that is more, or where none is stated.
"""

import jax.numpy as jnp
import numpy as np

from jiggle_mj.force_scatter import ForceScatter
from jiggle_mj.observation import Observation

from .filters.evidence import MeasuredPull


class ForceSensor:
    """Follows the offset of the sensor over the frames of a recording."""

    def __init__(self) -> None:
        self._scatter = ForceScatter()

    def look(self, observation: Observation) -> MeasuredPull | None:
        """Return the force in an observation; None with open jaws, and where none was reported."""
        force = observation.force
        if not observation.tool.closed:
            if force is not None:
                self._scatter.add(force.on_tool)
            return None
        self._scatter.close()
        if force is None:
            return None
        sd, measured = force.sd, self._scatter.sd
        if sd is None or self._scatter.exceeds(sd):
            sd = np.nan if measured is None else measured
        return MeasuredPull(
            index=jnp.asarray(observation.index),
            pull=jnp.asarray(self._scatter.offset - force.on_tool),
            covariance=jnp.asarray(sd**2 * np.eye(3)),
            offset_sd=jnp.asarray(sd * self._scatter.offset_share**0.5),
            offset_number=jnp.asarray(self._scatter.offset_number),
        )
