"""What a sheet's model may lack: the library of effects."""

from .effect import Effect
from .history_dependent import MEMORY
from .mechanical import MECHANICAL
from .sensing import SENSING
from .swing import SWING

LIBRARY: tuple[Effect, ...] = (*MECHANICAL, *MEMORY, *SENSING, *SWING)
"""All that are looked for, unless something else is asked. What swings is the sheet as late as it is seen: the last."""

__all__ = ["LIBRARY", "Effect"]
