"""When the jaws are closed, from the messages of a gripper, by a rule that the user states.

A Bool says it itself (true is closed) unless a rule is given; a number or a joint needs a rule, because which angle
holds tissue depends on the gripper. A String that holds the JSON of /tool/grasp is read as that.
"""

import operator
import re
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Self

import numpy as np

from ...errors import OptionError, RecordingError
from ...recording.schemas import parse_grasp

COMPARISONS = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
}
"""What a rule may compare by."""
JOINT_FIELDS = ("position", "velocity", "effort")
"""Fields of a JointState that a rule may use."""
SHORT_HOLD = 100_000_000
"""Time below which a grasp is likely noise around the rule's limit [ns]: nobody pulls tissue that quickly."""
ALWAYS = "always"
"""Rule of a bag that shows nothing but one grasp."""


@dataclass(frozen=True, kw_only=True)
class ClosedRule:
    """A comparison that is true while the jaws are closed, such as `jaw.position < 0.1`."""

    joint: str
    """Name of the joint; any word for a message of one number."""
    field: str
    """One of `JOINT_FIELDS`."""
    comparison: str
    """One of `COMPARISONS`, or `ALWAYS`."""
    limit: float
    """Value on the right side, in the unit of the message."""

    @classmethod
    def parse(cls, text: str) -> Self:
        """Return the rule in a text: `NAME<LIMIT`, `NAME.effort>LIMIT`, or `always`.

        Raises:
            OptionError: the text is no such rule.
        """
        if text.strip() == ALWAYS:
            return cls(joint="", field="position", comparison=ALWAYS, limit=0.0)
        match = re.fullmatch(r"\s*([^<>=\s]+?)(?:\.(position|velocity|effort))?\s*(<=|>=|==|<|>)\s*(\S+)\s*", text)
        limit = _number(match[4]) if match else np.nan
        if match is None or not np.isfinite(limit):
            raise OptionError(
                "closed must be a comparison such as 'jaw<0.1', 'jaw.effort>0.2' or 'data==false', or the word "
                f"'{ALWAYS}'; got '{text[:200]}'."
            )
        return cls(joint=match[1], field=match[2] or "position", comparison=match[3], limit=limit)

    def __str__(self) -> str:
        if self.comparison == ALWAYS:
            return "always closed"
        return f"closed where {self.joint}.{self.field} {self.comparison} {self.limit:g}"

    def holds(self, value: float) -> bool:
        """Return whether the jaws are closed at a value."""
        return self.comparison == ALWAYS or bool(COMPARISONS[self.comparison](value, self.limit))


@dataclass(frozen=True, kw_only=True)
class JawState:
    """The jaws from one time on."""

    time: int
    """Since when [ns]."""
    closed: bool
    """Whether the jaws hold the tissue."""
    grasp: int = 0
    """Number of the current or last grasp, from 1; 0 before the first."""
    radius: float | None = None
    """Radius of the grip where the message says it [m]."""
    held_tracks: tuple[int, ...] = ()
    """Track ids of the held points where the message says them."""
    by_points: bool = False
    """Whether the tool's pose is only where the held points were seen."""


def jaw_value(message: Any, rule: ClosedRule | None, topic: str) -> float | bool | dict[str, Any]:
    """Return what one message says: a flag, a number to compare, or the fields of a /tool/grasp message.

    Raises:
        RecordingError: a JointState without a rule, or without the rule's joint; a number that is not finite.
    """
    if hasattr(message, "data"):
        data = message.data
        if isinstance(data, str):
            return parse_grasp(data.encode())
        value = bool(data) if isinstance(data, bool | np.bool_) else float(data)
    else:
        names = list(message.name)
        value_of = {name: float(value) for name, value in zip(names, message.position, strict=False)}
        if rule is None or rule.comparison == ALWAYS:
            shown = ", ".join(f"{name} = {value:.4g}" for name, value in list(value_of.items())[:8])
            if rule is None:
                raise RecordingError(
                    f"{topic} is a JointState ({shown}); say when the jaws are closed, for example --closed "
                    f"'{names[-1] if names else 'jaw'}<0.1' with the joint and the limit of your gripper."
                )
            return True
        values = list(getattr(message, rule.field))
        if rule.joint not in names or len(values) != len(names):
            raise RecordingError(
                f"{topic} has no {rule.field} of the joint '{rule.joint}' that --closed names; its joints are: "
                f"{', '.join(names[:12]) or 'none'}."
            )
        value = float(values[names.index(rule.joint)])
    if not isinstance(value, bool) and not np.isfinite(value):
        raise RecordingError(f"{topic} holds {value}, which is neither open nor closed")
    return value


def jaw_states(
    stamps: Sequence[int], values: Sequence[Any], rule: ClosedRule | None, topic: str
) -> tuple[list[JawState], int]:
    """Return the states of the jaws, one for each change, and how many grasps are shorter than `SHORT_HOLD`.

    Args:
        stamps: times of the messages, increasing [ns].
        values: what each message says: results of `jaw_value`.
        rule: the rule for numbers.
        topic: name of the topic, for the message.

    Raises:
        RecordingError: numbers without a rule, or a rule for messages that are no numbers.
    """
    if rule is None and "open" in topic.lower() and values and isinstance(values[0], bool):
        raise RecordingError(
            f"the name of {topic} says open, not closed; give --closed 'data==false' if true means open, else "
            "--closed 'data==true'."
        )
    if values and rule is not None:
        _refuse_rule(values[0], rule, topic)
    if values and isinstance(values[0], dict):
        return [JawState(time=time, **value) for time, value in zip(stamps, values, strict=True)], 0
    numbers = [float(value) for value in values]
    if rule is None and not all(isinstance(value, bool) for value in values):
        low, high = min(numbers), max(numbers)
        raise RecordingError(
            f"{topic} holds numbers from {low:.4g} to {high:.4g}; say when the jaws are closed, for example "
            f"--closed 'data<{(low + high) / 2:.3g}'."
        )
    closed = [bool(value) if rule is None else rule.holds(value) for value in numbers]
    changes = [k for k in range(len(closed)) if k == 0 or closed[k] != closed[k - 1]]
    states: list[JawState] = []
    for k in changes:
        grasp = (states[-1].grasp if states else 0) + closed[k]
        states.append(JawState(time=stamps[k], closed=closed[k], grasp=grasp))
    n_short = sum(after.time - state.time < SHORT_HOLD for state, after in pairwise(states) if state.closed)
    return states, n_short


def _refuse_rule(value: Any, rule: ClosedRule, topic: str) -> None:
    """Refuse a rule for messages that say themselves whether the jaws are closed, but one that is their opposite.

    Raises:
        RecordingError: such a rule.
    """
    if isinstance(value, dict):
        raise RecordingError(f"{topic} says itself when the jaws are closed; leave --closed out.")
    if isinstance(value, bool) and rule.comparison != ALWAYS and (rule.comparison != "==" or rule.limit not in (0, 1)):
        raise RecordingError(
            f"{topic} is a Bool, and --closed compares numbers: leave it out where true means closed, or give --closed "
            "'data==false'."
        )


def state_at(states: Sequence[JawState], time: int) -> JawState:
    """Return the latest state at a time [ns]; before the first message the jaws count as open."""
    place = bisect_right(states, time, key=lambda state: state.time)
    return states[place - 1] if place else JawState(time=time, closed=False)


def _number(text: str) -> float:
    """Return the number in a text, with true as 1 and false as 0; NaN where it is none."""
    try:
        return float({"true": "1", "false": "0"}.get(text.lower(), text))
    except ValueError:
        return np.nan
