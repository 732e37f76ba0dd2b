"""Who chooses the next action: a policy looks at the estimator, and says what the tool does.

Its actions are a generator that goes on when the estimator has taken the observation of the action before. Ends when
the policy is done, and then says why.
"""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jiggle_mj.actions import Action, Grasp, Move
from jiggle_mj.errors import ActionError

from ..estimator import Estimator

STEP = 5e-3
"""Gamma: longest way of the tip from one look at the tissue to the next, with tissue in the jaws [m]."""
INTERRUPTED = "it was interrupted"
"""How a policy has ended that was told to stop."""


@dataclass(frozen=True, kw_only=True)
class Decision:
    """One action that was planned."""

    action: Action
    plan_s: float
    """Wall time of the plan [s]."""
    why: str
    """In words."""

    @property
    def does(self) -> str:
        """The action in words."""
        match self.action:
            case Grasp(point=place):
                return f"grasp at {in_mm(place)}"
            case Move(to=place):
                return f"move to {in_mm(place)}"
            case other:
                return type(other).__name__.lower()


def in_mm(place: Float[np.ndarray, " 3"]) -> str:
    """A place in words."""
    return f"({', '.join(str(round(1e3 * float(part))) for part in place)}) mm"


class Policy(ABC):
    """Plans action after action."""

    def __init__(self) -> None:
        """Nothing planned yet."""
        self.decisions: list[Decision] = []
        self.ended = "it was stopped"
        """Why there are no more actions, once there are none."""

    @abstractmethod
    def plan(self, estimator: Estimator) -> tuple[Action, str] | str:
        """The next action, with words that say why; or, where there is none, why not.

        Args:
            estimator: after the latest observation.
        """

    def refused(self, error: ActionError) -> bool:
        """Hear that the last action could not be carried out, and say whether to go on; by default it is the end.

        Args:
            error: why not.
        """
        self.ended = f"an action could not be carried out: {error}"
        return False

    def actions(
        self, estimator: Estimator, *, steps: int, stop: Callable[[], bool] = lambda: False
    ) -> Iterator[Action]:
        """At most `steps` actions, and none once `stop` says so.

        An interrupted plan (Ctrl-C) is the end of them too, and what was seen is kept.
        """
        for _ in range(steps):
            if stop():
                self.ended = INTERRUPTED
                return
            began = time.perf_counter()
            try:
                planned = self.plan(estimator)
            except KeyboardInterrupt:
                planned = INTERRUPTED
            if isinstance(planned, str):
                self.ended = planned
                return
            action, why = planned
            self.decisions.append(Decision(action=action, plan_s=time.perf_counter() - began, why=why))
            yield action
        self.ended = f"all {steps} steps are done"
