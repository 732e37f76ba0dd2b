"""What a sheet's model may lack: the library of effects."""

from jiggle_mj.estimator.effects.effect import Effect
from jiggle_mj.estimator.effects.mechanical import MECHANICAL
from jiggle_mj.estimator.effects.memory import MEMORY
from jiggle_mj.estimator.effects.sensing import SENSING

LIBRARY: tuple[Effect, ...] = (*MECHANICAL, *MEMORY, *SENSING)
"""All that are looked for, unless something else is asked."""

__all__ = ["LIBRARY", "Effect"]
