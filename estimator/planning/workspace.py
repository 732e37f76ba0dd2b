"""Workspace of the tip: within reach, and with all of the tool above the bed."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jiggle_mj.limits import Limits
from jiggle_mj.observation import ToolState

from ..estimator import Estimator
from .tool_kinematics import ToolKinematics, clearances


@dataclass(frozen=True, kw_only=True)
class Workspace:
    """Workspace of one tool over one sheet."""

    low: Float[np.ndarray, " 3"]
    """Lower corner of the tip's reach, at the resting sheet [m]."""
    high: Float[np.ndarray, " 3"]
    """Upper corner [m]."""
    bed: float
    """Height of the bed, half a thickness below the resting sheet's middle surface [m]."""
    tweezer: ToolKinematics | None
    """The tool; if None, only the tip is kept within reach."""

    @classmethod
    def around(cls, estimator: Estimator, limits: Limits, tweezer: ToolKinematics | None = None) -> "Workspace":
        """Return the workspace around the resting sheet, extended by the limits beside and above it.

        Args:
            estimator: after its sheet is known.
            limits: say how far the tip may go beside and above the sheet.
            tweezer: the tool; None if only the tip is known.
        """
        rest = estimator.sheet.rest
        bottom, top = rest.min(axis=0), rest.max(axis=0)
        beside = np.array([limits.beside, limits.beside, 0.0])
        high = np.array([*(top + beside)[:2], max(limits.ceiling, top[2])])
        bed = float(bottom[2]) - 0.5 * estimator.declaration.thickness
        return cls(low=bottom - beside, high=high, bed=bed, tweezer=tweezer)

    def reached(self, tips: Float[np.ndarray, "k 3"], tool: ToolState) -> Bool[np.ndarray, " k"]:
        """Return which tips [m] are within reach, with the tool in its current orientation clear of the bed."""
        inside: Bool[np.ndarray, " k"] = np.all((self.low <= tips) & (tips <= self.high), axis=1)
        if self.tweezer is None:
            return inside
        clear = clearances(self.tweezer, jnp.asarray(tips), jnp.asarray(tool.quat_wxyz))
        return inside & (np.asarray(clear) >= self.bed)
