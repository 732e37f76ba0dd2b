"""Effects that the declared model of a sheet may lack; `effect.py` says how to add one."""

from .effect import Effect
from .force_scale import FORCE_SCALE
from .foundation import FOUNDATION
from .history_dependent import HISTORY_DEPENDENT
from .mechanical import MECHANICAL
from .sensing import SENSING
from .swing import SWING
from .yielding import YIELDING

LIBRARY: tuple[Effect, ...] = (
    *MECHANICAL,
    *FOUNDATION,
    *HISTORY_DEPENDENT,
    *SENSING,
    *YIELDING,
    *FORCE_SCALE,
    *SWING,
)
"""All effects that are tested by default. They act on the model in this order; `swing` is last, because it acts at the
time that the latencies before it have set."""

__all__ = ["LIBRARY", "Effect"]
