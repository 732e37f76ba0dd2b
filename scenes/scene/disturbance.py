"""Base classes of disturbances: changes of the tissue or of the sensing that the estimator is not informed of.

Each base is generic in what it changes: a `TissueDisturbance[Simulation]` changes the simulation, a
`SensingDisturbance[Observer]` changes the observer. Both are type variables here, because `tissue/simulation.py` and
`sensing/observer.py` import scenes, and scenes hold disturbances. To add a disturbance:

1. Write the class in the file of `disturbances/` that fits: `world.py` (gravity, bed, surroundings), `sheet.py`
   (material), `anchors.py` (attachments, grip), `reports.py` (tool, camera pose, timing) or `images.py` (pixels). Its
   name in snake case is the name in scene files. Its fields are the keys, each with unit, default and range.
2. Add the class to `DISTURBANCES` in `disturbances/registry.py`; also to `MATERIAL` there if it changes the elastic
   constants.
3. Add one row for the magnitude and one for each further key to the table of `docs/DISTURBANCES.md`.
4. Test it in `tests/scenes/disturbances/`: a closed form where there is one, and for a disturbance of the tissue its
   measured displacement in `DISPLACEMENT`.
5. If the estimator is to find it, give its effect in `estimator/effects/` the same name.
"""

import re
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Generic, TypeVar

import mujoco
import numpy as np

from jiggle_mj.errors import SceneError

from .section import Section, number

SimulationT = TypeVar("SimulationT", contravariant=True)
"""`tissue.simulation.Simulation`; each disturbance of the tissue names it."""
ObserverT = TypeVar("ObserverT", contravariant=True)
"""`sensing.observer.Observer`; each disturbance of the sensing names it."""


@dataclass(frozen=True, kw_only=True)
class Disturbance(Section):
    """One disturbance; `magnitude` is the key that the command line sets."""

    section: ClassVar[str] = "disturbances"
    magnitude: float
    """Size of the disturbance, in the unit that its subclass states."""
    start: float = number(0.0, unit="s", at_least=0, at_most=1e6)
    """Simulated time at which it begins [s]; one that starts at 0 acts before the sheet first comes to rest."""

    @classmethod
    def kind(cls) -> str:
        """Return its name in scene files, reports and the estimator's effects, such as tool_bias."""
        return re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).lower()

    def check(self, size: tuple[float, float]) -> None:  # most act everywhere
        """Refuse a disturbance that misses a sheet of this size [m].

        Raises:
            SceneError: it lies off the sheet.
        """


class TissueDisturbance(Disturbance, ABC, Generic[SimulationT]):
    """A disturbance of the sheet, of its surroundings, or of what holds it."""

    def prepare(self, spec: mujoco.MjSpec) -> None:  # most need nothing
        """Change what must be known when the scene is compiled."""

    @abstractmethod
    def begin(self, simulation: SimulationT) -> None:
        """Change the model, or add a hook that runs after each step."""


class SensingDisturbance(Disturbance, ABC, Generic[ObserverT]):
    """A disturbance of the camera, of the tracker or of the tool's report."""

    needs: ClassVar[tuple[str, ...]] = ()
    """Kinds of sensing that it can disturb; empty means all."""

    @abstractmethod
    def begin(self, observer: ObserverT) -> None:
        """Change what is seen or reported from now on."""


def check_spot_on_sheet(size: tuple[float, float], centre: tuple[float, float], radius: float, *, key: str) -> None:
    """Refuse a round spot that does not reach a sheet of this size [m]; `key` names its centre in the message.

    Raises:
        SceneError: the centre is farther from the sheet than the radius.
    """
    gap = np.linalg.norm(np.maximum(np.abs(centre) - np.array(size) / 2, 0))
    if gap > radius:
        raise SceneError(
            f"{key} = {list(centre)}: {1e3 * gap:.1f} mm off the sheet, which reaches to +-{size[0] / 2:g} m and "
            f"+-{size[1] / 2:g} m; the radius is {1e3 * radius:.1f} mm. Move it closer or widen the radius."
        )
