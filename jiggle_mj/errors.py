"""Errors of data and environment, one class for each kind that a caller may handle.

Wrong arguments raise `ValueError`; every class here is a `JiggleError`, which the command line prints as one line.
"""

import numpy as np
from jaxtyping import Bool

MAX_SHOWN = 200
"""Most characters of a wrong input that an error quotes."""


class JiggleError(Exception):
    """Base of the errors that a user can correct: the message says what was given, what is allowed, what to do."""

    def __str__(self) -> str:
        """Return the message on one line, as what it quotes may hold line breaks and control characters."""
        text = super().__str__()
        return text if text.isprintable() else "".join(each if each.isprintable() else " " for each in text)


class SceneError(JiggleError):
    """A scene file is missing, malformed or describes something impossible."""


class RecordingError(JiggleError):
    """A recording or a folder of measured data is missing, malformed, foreign or holds truth."""


class ObservationError(RecordingError, ValueError):
    """A part of an observation, a camera or a declared mesh has the wrong type, shape or range."""


class PerceptionError(JiggleError):
    """The images cannot be used: no tissue in view, cameras swapped, sizes that differ."""


class MaskError(PerceptionError):
    """The built-in segmentation by colour is not sure which pixels are tissue."""

    def __init__(self, message: str, mask: Bool[np.ndarray, "height width"]) -> None:
        """Keep what was taken for tissue beside the message."""
        super().__init__(message)
        self.mask = mask
        """Pixels of the rectified left image that were taken for tissue."""

    def __reduce__(self) -> tuple[type["MaskError"], tuple[str, Bool[np.ndarray, "height width"]]]:
        """Return how to make it again in another process."""
        return MaskError, (str(self), self.mask)


class MeshError(JiggleError):
    """A mesh is degenerate, inverted or in several pieces."""


class ActionError(JiggleError, ValueError):
    """An action is impossible: a number that is not finite, a grasp off the tissue, a release of nothing."""


class RenderError(JiggleError):
    """No offscreen OpenGL on this machine."""


class EnvironmentFault(JiggleError):
    """The machine or its environment variables do not let JAX start; `jiggle-mj doctor` says what to do."""


class SimulationError(JiggleError):
    """The reference simulation became unstable; the message names the dumped state."""


class OutputError(JiggleError):
    """An output path already holds results or cannot be written."""


class OptionError(JiggleError, ValueError):
    """An option or argument is out of its range, or contradicts another."""


class ClusterError(JiggleError):
    """The requested cluster cannot be used: Dask is not installed, or nothing answers at the address."""
