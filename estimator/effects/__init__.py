"""What a sheet's model may lack: the library of effects."""

from jiggle_mj.estimator.effects.effect import Effect
from jiggle_mj.estimator.effects.mechanical import MECHANICAL
from jiggle_mj.estimator.effects.memory import MEMORY
from jiggle_mj.estimator.effects.sensing import SENSING
from jiggle_mj.estimator.effects.swing import SWING

LIBRARY: tuple[Effect, ...] = (*MECHANICAL, *MEMORY, *SENSING, *SWING)
"""All that are looked for, unless something else is asked. What swings is the sheet as late as it is seen: the last."""

__all__ = ["LIBRARY", "Effect"]
