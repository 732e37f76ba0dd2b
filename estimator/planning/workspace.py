"""Where the tip may be: within reach, and nowhere where any part of the tool would touch the bed."""

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
    """Of one sheet and one tool."""

    low: Float[np.ndarray, " 3"]
    """Lower corner of the tip's reach, at the resting sheet [m]."""
    high: Float[np.ndarray, " 3"]
    """Upper corner [m]."""
    bed: float
    """Height of the bed, on which the sheet rests with half its thickness [m]."""
    tweezer: ToolKinematics | None
    """If None, nothing but the tip is known of the tool."""

    @classmethod
    def around(cls, estimator: Estimator, limits: Limits, tweezer: ToolKinematics | None = None) -> "Workspace":
        """The resting sheet, and the limits beside and above it."""
        rest = estimator.sheet.rest
        bottom, top = rest.min(axis=0), rest.max(axis=0)
        beside = np.array([limits.beside, limits.beside, 0.0])
        high = np.array([*(top + beside)[:2], max(limits.ceiling, top[2])])
        bed = float(bottom[2]) - 0.5 * estimator.declaration.thickness
        return cls(low=bottom - beside, high=high, bed=bed, tweezer=tweezer)

    def reached(self, tips: Float[np.ndarray, "k 3"], tool: ToolState) -> Bool[np.ndarray, " k"]:
        """Which tips are within reach and leave the tool, turned as it is now, clear of the bed."""
        inside: Bool[np.ndarray, " k"] = np.all((self.low <= tips) & (tips <= self.high), axis=1)
        if self.tweezer is None:
            return inside
        clear = clearances(self.tweezer, jnp.asarray(tips), jnp.asarray(tool.quat_wxyz))
        return inside & (np.asarray(clear) >= self.bed)
