"""Policies: choose the next action of the tool from the estimate.

A policy's actions are a generator. It continues once the estimator has been updated by the observation of the last
action. It ends when the policy is done, and `Policy.ended` then says why.
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
"""Gamma: largest displacement of the tip between two observations, with tissue in the jaws [m]."""
INTERRUPTED = "it was interrupted"
"""`Policy.ended` of a policy that was interrupted."""


@dataclass(frozen=True, kw_only=True)
class Decision:
    """One planned action."""

    action: Action
    plan_s: float
    """Wall time of the plan [s]."""
    why: str
    """Reason for the action, for a person to read."""

    @property
    def does(self) -> str:
        """Return the action in words."""
        match self.action:
            case Grasp(point=position):
                return f"grasp at {in_mm(position)}"
            case Move(to=position):
                return f"move to {in_mm(position)}"
            case action:
                return type(action).__name__.lower()


def in_mm(position: Float[np.ndarray, " 3"]) -> str:
    """Return a position [m] in words, in whole millimetres."""
    return f"({', '.join(str(round(1e3 * float(part))) for part in position)}) mm"


class Policy(ABC):
    """Base of all policies, which plan one action after the other."""

    def __init__(self) -> None:
        """Start without decisions."""
        self.decisions: list[Decision] = []
        self.ended = "it was stopped"
        """Why there are no more actions, once there are none."""

    @abstractmethod
    def plan(self, estimator: Estimator) -> tuple[Action, str] | str:
        """Return the next action and the reason for it; or, where there is none, the reason for that.

        Args:
            estimator: after the latest observation.
        """

    def refused(self, error: ActionError) -> bool:
        """Return whether to go on, after the last action could not be carried out; by default not.

        Args:
            error: why the action was refused.
        """
        self.ended = f"an action could not be carried out: {error}"
        return False

    def actions(
        self, estimator: Estimator, *, steps: int, stop: Callable[[], bool] = lambda: False
    ) -> Iterator[Action]:
        """Yield at most `steps` actions, and none once `stop` returns true.

        An interrupted plan (Ctrl-C) ends them too; the results so far are kept.
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
