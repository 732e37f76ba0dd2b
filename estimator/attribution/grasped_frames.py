"""A recording's frames with closed jaws, as arrays for fits over all of them at once."""

from dataclasses import dataclass, replace
from functools import cached_property

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..effects.frame_history import FrameRecord


class FramePull(eqx.Module):
    """The force of the tool on the tissue, as it was measured in a frame."""

    force: Float[Array, " 3"]
    """The force in the world [N]; zero where none was measured."""
    weight: Float[Array, ""]
    """Inverse standard deviation of each component [1/N]; zero where none was measured."""
    offset_sd: Float[Array, ""]
    """Standard deviation of each component of what the frames of a grasp err by alike [N]: the sensor's offset, and the
    noise of where the jaws closed."""
    offset_number: Int[Array, ""]
    """Number of that offset: frames of the same number err by it alike."""


class ClosedFrame(eqx.Module):
    """One frame with closed jaws."""

    y: Float[Array, "n 3"]
    """Observed positions, of any value where not `visible` [m]."""
    visible: Bool[Array, " n"]
    """Whether each particle is observed."""
    precision: Float[Array, "n 3 3"]
    """Inverse covariance of the white noise, zero where not observed [1/m^2]."""
    held: Bool[Array, " n"]
    """Whether each particle is in the jaws."""
    force_unknown: Bool[Array, " n"]
    """Particles near the grip, whose forces are not used."""
    rotated: Float[Array, "n 3"]
    """Positions of the held particles when the jaws closed, rotated about the tip as the tool has rotated since [m]."""
    displacement: Float[Array, " 3"]
    """Displacement of the tool since then, as reported [m]."""
    by_points: Bool[Array, ""]
    """Whether the tool's report is derived from the observed positions of the held particles."""
    held_sd: Float[Array, ""]
    """Standard deviation of the mean position of what is held, by the noise of observed positions [m]."""
    pull: FramePull | None = None
    """Force of the tool; None where no frame of the recording has one."""

    @property
    def counted(self) -> Bool[Array, " n"]:
        """Return which particles are observed and not held."""
        return self.visible & ~self.held

    def noise_variance(self, fields: Float[np.ndarray, "n modes"]) -> Float[np.ndarray, " n"]:
        """Return the variance of a coordinate of each particle by white noise and the fields of smooth noise [m^2]."""
        return 1 / np.maximum(np.asarray(self.precision)[:, 0, 0], 1.0) + np.sum(fields**2, axis=1)


@dataclass(frozen=True, kw_only=True)
class Timed(FrameRecord):
    """A frame with its place in the recording."""

    frame: ClosedFrame
    index: int
    """Index in the recording."""
    part: int
    """Number of the part that is held out as a whole: the grasp, or a third of the only one."""

    @cached_property
    def counted(self) -> Bool[np.ndarray, " n"]:
        """Return which particles are observed and not held."""
        return np.asarray(self.frame.counted)

    def observing(self, y: Float[Array, "n 3"]) -> "Timed":
        """Return the frame with other observed positions [m]."""
        return replace(self, frame=replace(self.frame, y=y))
