"""What the sensor of the tool's force shows while the jaws are open: its offset, with the tool's weight, and its noise.

Nothing pulls at open jaws. The mean is the offset of the grasp that follows, and the scatter about it is the noise.
"""

import numpy as np
from jaxtyping import Float

MIN_OPEN = 5
"""Frames with open jaws from which the noise is measured, as that of points is."""
MAX_RATIO = 1.5
"""Ratio of measured to stated standard deviation up to which the statement holds: from `MIN_OPEN` frames the measured
one errs by 0.2."""


class ForceScatter:
    """Follows the force over frames with open jaws, in stretches between grasps."""

    def __init__(self) -> None:
        self.offset: Float[np.ndarray, " 3"] = np.zeros(3)
        """Mean of the latest stretch [N]; 0 before any."""
        self.offset_share = 0.0
        """Variance of that mean over that of one force [1]."""
        self.offset_number = 0
        """How many stretches there were: frames of the same number share the error of the offset."""
        self._open, self._squares, self._degrees = list[Float[np.ndarray, " 3"]](), 0.0, 0

    def add(self, on_tool: Float[np.ndarray, " 3"]) -> None:
        """Take the force of a frame with open jaws [N]."""
        self._open.append(on_tool)

    def close(self) -> None:
        """Take note that the jaws are closed, which ends the stretch."""
        if self._open:
            values = np.array(self._open)
            self.offset, self.offset_share = values.mean(axis=0), 1 / len(values)
            self.offset_number += 1
            self._squares += float(np.sum((values - self.offset) ** 2))
            self._degrees += 3 * (len(values) - 1)
            self._open = []

    @property
    def sd(self) -> float | None:
        """Return the standard deviation of a component [N]; None for too few frames, or where nothing changes."""
        enough = self._degrees >= 3 * (MIN_OPEN - 1) and self._squares > 0
        return (self._squares / self._degrees) ** 0.5 if enough else None

    def exceeds(self, stated: float) -> bool:
        """Return whether the scatter is larger than a stated standard deviation explains [N]."""
        return self.sd is not None and self.sd > MAX_RATIO * stated
