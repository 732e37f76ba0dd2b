"""The force of the tool on the tissue, from what its sensor reports.

What the sensor shows while the jaws are open is its offset and the tool's own weight. Their mean is subtracted in the
grasp that follows, and their scatter is the noise where none is stated.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jiggle_mj.observation import Observation

from .filters.evidence import MeasuredPull

MIN_OPEN = 5
"""Frames with open jaws from which the noise is measured, as that of points is."""


class ForceSensor:
    """Follows the offset of the sensor over the frames of a recording."""

    def __init__(self) -> None:
        self._open, self._offset = list[Float[np.ndarray, " 3"]](), np.zeros(3)
        self._offset_share, self._offset_number, self._squares, self._degrees = 0.0, 0, 0.0, 0

    def look(self, observation: Observation) -> MeasuredPull | None:
        """Return the force in an observation; None with open jaws, and where none was reported."""
        force = observation.force
        if not observation.tool.closed:
            if force is not None:
                self._open.append(force.on_tool)
            return None
        if self._open:
            values = np.array(self._open)
            self._offset, self._offset_share = values.mean(axis=0), 1 / len(values)
            self._offset_number += 1
            self._squares += float(np.sum((values - self._offset) ** 2))
            self._degrees += 3 * (len(values) - 1)
            self._open = []
        if force is None:
            return None
        sd = self._measured_sd if force.sd is None else force.sd
        return MeasuredPull(
            index=jnp.asarray(observation.index),
            pull=jnp.asarray(self._offset - force.on_tool),
            covariance=jnp.asarray(sd**2 * np.eye(3)),
            offset_sd=jnp.asarray(sd * self._offset_share**0.5),
            offset_number=jnp.asarray(self._offset_number),
        )

    @property
    def _measured_sd(self) -> float:
        """Return the standard deviation of a component by frames with open jaws [N]; NaN for too few."""
        enough = self._degrees >= 3 * (MIN_OPEN - 1) and self._squares > 0
        return (self._squares / self._degrees) ** 0.5 if enough else np.nan
