"""What a disturbance is: something that happens to the tissue or to the sensing, and the estimator is not told of it.

A subclass names its magnitude with unit, default and range, and changes the simulation or the observer when its time
has come.
"""

import re
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Generic, TypeVar

import mujoco
import numpy as np

from jiggle_mj.errors import SceneError

from .section import Section, number

Simulation, Observer = TypeVar("Simulation", contravariant=True), TypeVar("Observer", contravariant=True)
"""`tissue.simulation.Simulation` and `sensing.observer.Observer`, which hold scenes: the kinds of disturbances name
them, so that this file needs neither."""


@dataclass(frozen=True, kw_only=True)
class Disturbance(Section):
    """One effect; `magnitude` is what the command line sets."""

    section: ClassVar[str] = "disturbances"
    magnitude: float
    start: float = number(0.0, unit="s", at_least=0, at_most=1e6)
    """When it begins; at 0 it is there before the sheet first comes to rest."""

    @classmethod
    def kind(cls) -> str:
        """Return what scene files, reports and the estimator's effects call it, such as tool_bias."""
        return re.sub(r"(?<!^)(?=[A-Z])", "_", cls.__name__).lower()

    def check(self, size: tuple[float, float]) -> None:  # most act everywhere
        """Refuse what would miss a sheet of this size [m].

        Raises:
            SceneError: it lies beside the sheet.
        """


class TissueDisturbance(Disturbance, ABC, Generic[Simulation]):
    """Of the sheet, what it lies on, what holds it."""

    def prepare(self, spec: mujoco.MjSpec) -> None:  # most need nothing
        """Change what must be known when the scene is compiled."""

    @abstractmethod
    def begin(self, simulation: Simulation) -> None:
        """Change the model, or add a rule to be followed after each step."""


class SensingDisturbance(Disturbance, ABC, Generic[Observer]):
    """Of the camera, the tracker or the tool's report."""

    needs: ClassVar[tuple[str, ...]] = ()
    """The kinds of sensing that it can disturb; none named, all."""

    @abstractmethod
    def begin(self, observer: Observer) -> None:
        """Change what is seen or reported from now on."""


def meet_sheet(size: tuple[float, float], place: tuple[float, float], radius: float, *, what: str) -> None:
    """Refuse a spot that does not reach a sheet of this size.

    Raises:
        SceneError: it lies further off than its radius.
    """
    off = np.linalg.norm(np.maximum(np.abs(place) - np.array(size) / 2, 0))
    if off > radius:
        raise SceneError(
            f"{what} = {list(place)}: {1e3 * off:.1f} mm off the sheet, which reaches to +-{size[0] / 2:g} m and "
            f"+-{size[1] / 2:g} m; the radius is {1e3 * radius:.1f} mm."
        )
